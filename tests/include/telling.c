/* Keeps a state that tells whole from torn: each step writes its number all over three pages of each array.
 *
 *     telling STEPS [wait]    0 steps: only look; -1: for ever. With "wait" each commit is waited for, and "safe N" printed. */
#include "failover.h"

enum { WORDS = 512, PAGES = 24, LARGE = 40 };

static uint64_t number;
static struct {
    char before[5];
    unsigned char bytes[PAGES * 4096 + 5]; /* neither begins nor ends with a page */
} few;
static unsigned char *large; /* followed by the kernel, where it can, but for both ends: there the number stands alone */

#ifdef DISK_LOG
void disk_log_safe(uint64_t commit);
#else
static void disk_log_safe(uint64_t commit) { (void)commit; }
#endif

static void stamp(unsigned char *array, uint64_t page)
{
    for (int word = 0; word < WORDS; word++)
        memcpy(array + page * 4096 + (size_t)word * 8, &number, 8);
}

static void step(void)
{
    number++;
    for (uint64_t factor = 1; factor <= 19; factor += 6) {
        stamp(few.bytes, number * factor % PAGES);
        stamp(large + 8, number * factor % LARGE);
    }
    memcpy(large, &number, 8);
    memcpy(large + 8 + LARGE * 4096, &number, 8);
}

static void tell_resumed(const failover_resumption *resumed, void *context)
{
    printf("resumed %llu %llu\n%s", (unsigned long long)*(uint64_t *)context, (unsigned long long)resumed->generation, resumed->notes);
}

int main(int count, char **words)
{
    long steps = count > 1 ? atol(words[1]) : 0;
    bool waits = count > 2;
    large = (unsigned char *)calloc(LARGE + 1, 4096);
    if (large == NULL)
        return 3;
    setvbuf(stdout, NULL, _IOLBF, 0);
    failover_region(&number, sizeof number, "number");
    failover_region(few.bytes, sizeof few.bytes, "few");
    failover_region(large + 24, 8 + LARGE * 4096 + 8, "large");
    large += 24;
    failover_on_resume(tell_resumed, &number);
    if (failover_open("telling") < 0) {
        bool is_touched = number != 0;
        for (size_t index = 0; index < LARGE * 4096; index++)
            is_touched |= large[index] != 0 || few.bytes[index % sizeof few.bytes] != 0;
        printf("%s\n%s", failover_error(), is_touched ? "touched\n" : "");
        return 1;
    }
    printf("began %llu\n", (unsigned long long)number);
    for (; steps != 0; steps--) {
        step();
        if (failover_commit() < 0 && errno != EAGAIN)
            printf("%s\n", failover_error());
        if (waits && failover_wait(20000) == 0) {
            disk_log_safe(number);
            printf("safe %llu\n", (unsigned long long)number);
        } else if (waits) {
            printf("%s\n", failover_error());
        }
    }
    return failover_close() == 0 ? 0 : 2;
}
