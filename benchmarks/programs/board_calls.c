/* What a put and a get of an item cost in C, beside bare copies of shared memory: nanoseconds a call, one line a batch.
 *
 *     board_calls SIZE BATCHES CALLS
 *
 * Each line: what, and ns a call. "like RTDB" does what CAMBADA's RTDB does in DB_put and DB_get (two banks, a time stamp by gettimeofday(2),
 * no check): the copy alone, its look-up by tables left out. */
#include "failover_board.h"

#include <sys/time.h>

static unsigned char value[65536];
static size_t size;
static fb_item *own;

static struct {
    int bank;
    struct timeval stamps[2];
    unsigned char banks[2][65536];
} *bare;

static void board_put(void)
{
    if (fb_put(own, value) != 0)
        exit(2);
}

static void board_get(void)
{
    if (fb_get(own, FB_OWN, value, NULL) < 0)
        exit(2);
}

static void board_get_by_name(void)
{
    if (fb_get(own, FB_ROBOT("robot2"), value, NULL) < 0)
        exit(2);
}

/* Keep the compiler from leaving a copy out. */
#define DONE __asm__ volatile("" ::: "memory")

static void copy_in(void)
{
    memcpy(bare->banks[0], value, size);
    DONE;
}

static void copy_out(void)
{
    memcpy(value, bare->banks[0], size);
    DONE;
}

static void rtdb_put(void)
{
    int bank = !bare->bank;
    memcpy(bare->banks[bank], value, size);
    gettimeofday(&bare->stamps[bank], NULL);
    bare->bank = bank;
    DONE;
}

static volatile int life;

static void rtdb_get(void)
{
    struct timeval now;
    memcpy(value, bare->banks[bare->bank], size);
    gettimeofday(&now, NULL);
    life = (int)((now.tv_sec - bare->stamps[bare->bank].tv_sec) * 1000 + (now.tv_usec - bare->stamps[bare->bank].tv_usec) / 1000);
}

static volatile int64_t instant;

static void clock_alone(void) { instant = fb_clock_(CLOCK_BOOTTIME); }

static void measure(const char *what, void (*call)(void), long batches, long calls)
{
    for (long turn = 0; turn < calls; turn++)
        call();
    for (long batch = 0; batch < batches; batch++) {
        int64_t begin = fb_clock_(CLOCK_MONOTONIC);
        for (long turn = 0; turn < calls; turn++)
            call();
        printf("%s\t%.2f\n", what, (double)(fb_clock_(CLOCK_MONOTONIC) - begin) / (double)calls);
    }
}

int main(int count, char **words)
{
    if (count < 4)
        return 1;
    size = (size_t)atoi(words[1]);
    const long batches = atol(words[2]), calls = atol(words[3]);
    fb_board *board = fb_open(NULL);
    own = board == NULL ? NULL : fb_find(board, "value", size, 0);
    bare = mmap(NULL, sizeof *bare, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (own == NULL || (void *)bare == MAP_FAILED) {
        fprintf(stderr, "%s\n", fb_error());
        return 1;
    }
    measure("put", board_put, batches, calls);
    measure("get", board_get, batches, calls);
    measure("get of a robot by its name", board_get_by_name, batches, calls);
    measure("put: memcpy", copy_in, batches, calls);
    measure("get: memcpy", copy_out, batches, calls);
    measure("put: like RTDB", rtdb_put, batches, calls);
    measure("get: like RTDB", rtdb_get, batches, calls);
    measure("clock_gettime", clock_alone, batches, calls);
    fb_close(board);
    return 0;
}
