/* Does one thing in several threads as fast as it can, until the go file is there, and must not notice that it is looked at.
 *
 * races GO mappings: maps, fills, protects, moves and unmaps memory; what was written must be there.
 * races GO signals: sends queued signals to threads; each must be handled once, with its value.
 * races GO forks: has children that end with a status of their own, by fork and posix_spawn, while other threads map memory.
 * races GO execs [TURN]: executes itself, the first thread or another one, with other threads running.
 */
#include "tracee.h"
#include <pthread.h>
#include <spawn.h>

#define WORKERS 3

static const char *go, *self;
static volatile int over;
static volatile uint64_t sent[WORKERS], handled[WORKERS], sum_sent[WORKERS], sum_handled[WORKERS];
static __thread int own = -1;

static void map_and_unmap(uint64_t seed) {
    size_t count = 1 + seed % 7;
    unsigned char *start = map_pages(count, PROT_READ | PROT_WRITE, 0);
    fill(start, count * PAGE, seed);
    if (seed & 8) mprotect(start, PAGE, PROT_READ);
    expect_filled("a mapping", start, count * PAGE, seed);
    unsigned char *moved = mremap(start, count * PAGE, (count + 3) * PAGE, MREMAP_MAYMOVE);
    if (moved == MAP_FAILED) { /* two mappings by now: they do not move as one */
        munmap(start, count * PAGE);
        return;
    }
    expect_filled("a mapping that was moved", moved, count * PAGE, seed);
    munmap(moved, (count + 3) * PAGE);
}

static void take(int number, siginfo_t *about, void *context) {
    (void)number;
    (void)context;
    if (own < 0) return;
    handled[own]++;
    sum_handled[own] += (uint64_t)about->si_value.sival_int;
}

static void send_to_itself(uint64_t seed) {
    siginfo_t about = {.si_code = SI_QUEUE, .si_value.sival_int = (int)(seed & 0xFFFFFF)};
    if (syscall(SYS_rt_tgsigqueueinfo, getpid(), gettid(), SIGRTMIN, &about)) return; /* the queue is full */
    sent[own]++;
    sum_sent[own] += seed & 0xFFFFFF;
}

static void have_child(uint64_t seed) {
    if (own > 0) {
        map_and_unmap(seed);
        return;
    }
    int status = 0, wanted = (int)(seed % 200);
    char number[16];
    char *arguments[] = {(char *)self, "status", number, NULL};
    snprintf(number, sizeof number, "%d", wanted);
    pid_t child = 0;
    if (seed % 5 == 0) {
        if (posix_spawn(&child, self, NULL, NULL, arguments, NULL)) cannot("spawn a child");
    } else {
        child = fork();
        if (child == 0) _exit(wanted);
    }
    EXPECT(waitpid(child, &status, 0) == child, "waitpid: %s", strerror(errno));
    EXPECT(WIFEXITED(status) && WEXITSTATUS(status) == wanted, "a child ended with %x, not %d", status, wanted);
    usleep((useconds_t)(seed >> 32) % 10000); /* a program with children is refused */
}

static void (*act)(uint64_t);

static void *work(void *number) {
    own = (int)(intptr_t)number;
    for (uint64_t turn = 0; !over; turn++) {
        uint64_t seed = mix(turn * WORKERS + (uint64_t)own);
        act(seed);
        if (seed % 4 == 0) usleep((useconds_t)(seed >> 32) % 500); /* so that it leaves a processor to who captures it */
    }
    return NULL;
}

static void *execute_next(void *turn) {
    char number[32];
    snprintf(number, sizeof number, "%ld", (long)(intptr_t)turn + 1);
    execl(self, self, go, "execs", number, NULL);
    cannot("execute itself");
}

static void *idle(void *unused) {
    for (;;) usleep(1000);
    return unused;
}

static int execute_itself(long turn) {
    pthread_t thread;
    if (turn == 0) ready();
    if (is_told(go)) return finish();
    for (int number = 0; number < WORKERS; number++)
        if (pthread_create(&thread, NULL, idle, NULL)) cannot("start a thread");
    usleep((useconds_t)(mix((uint64_t)turn) % (turn % 8 ? 50000 : 500000)));
    if (turn % 2) execute_next((void *)turn);
    if (pthread_create(&thread, NULL, execute_next, (void *)turn)) cannot("start a thread");
    for (;;) pause();
}

int main(int count, char **arguments) {
    static char path[PAGE];
    pthread_t workers[WORKERS];
    if (count > 2 && !strcmp(arguments[1], "status")) return atoi(arguments[2]);
    go = arguments[1];
    self = path;
    if (readlink("/proc/self/exe", path, sizeof path - 1) < 0) cannot("find itself");
    if (!strcmp(arguments[2], "execs")) return execute_itself(count > 3 ? atol(arguments[3]) : 0);
    act = !strcmp(arguments[2], "mappings") ? map_and_unmap : !strcmp(arguments[2], "signals") ? send_to_itself : have_child;
    struct sigaction action = {.sa_sigaction = take, .sa_flags = SA_SIGINFO | SA_RESTART};
    sigaction(SIGRTMIN, &action, NULL);
    for (intptr_t number = 0; number < WORKERS; number++)
        if (pthread_create(&workers[number], NULL, work, (void *)number)) cannot("start a thread");
    ready();
    wait_for_go(go);
    over = 1;
    for (int number = 0; number < WORKERS; number++) {
        pthread_join(workers[number], NULL);
        EXPECT_EQUAL("signals handled", handled[number], sent[number]);
        EXPECT_EQUAL("their values", sum_handled[number], sum_sent[number]);
    }
    return finish();
}
