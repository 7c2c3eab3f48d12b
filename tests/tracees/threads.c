/* Four kinds of threads, each waiting in another way, each with marks of its own; all must find everything as it was.
 *
 * Second argument: nothing, or "many" for sixty more threads that hold a condition variable each other's way.
 */
#include "tracee.h"

#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/rseq.h>

#ifndef SYS_ioprio_get
#error "no ioprio_get"
#endif

#define EXTRA 60

static const char *go;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER, complaint = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static int turn, wanted_turns, waiting;
static __thread uint64_t own[64];

struct marks {
    char name[16];
    sigset_t blocked, pending;
    stack_t altstack;
    void *robust, *clear_tid, *pointer;
    size_t robust_length;
    int policy, nice, io_priority, slack, death_signal, has_rseq;
    pid_t tid;
    cpu_set_t processors;
    uint64_t own_sum;
};

static void look(struct marks *marks) {
    memset(marks, 0, sizeof *marks);
    prctl(PR_GET_NAME, marks->name);
    pthread_sigmask(SIG_SETMASK, NULL, &marks->blocked);
    sigpending(&marks->pending);
    sigaltstack(NULL, &marks->altstack);
    syscall(SYS_get_robust_list, 0, &marks->robust, &marks->robust_length);
    prctl(PR_GET_TID_ADDRESS, &marks->clear_tid);
    marks->pointer = __builtin_thread_pointer();
    marks->policy = sched_getscheduler(0);
    marks->nice = getpriority(PRIO_PROCESS, 0);
    marks->io_priority = syscall(SYS_ioprio_get, 1, 0);
    marks->slack = prctl(PR_GET_TIMERSLACK);
    prctl(PR_GET_PDEATHSIG, &marks->death_signal);
    marks->tid = syscall(SYS_gettid);
    sched_getaffinity(0, sizeof marks->processors, &marks->processors);
    char *area = (char *)__builtin_thread_pointer() + __rseq_offset;
    marks->has_rseq = __rseq_size && syscall(SYS_rseq, area, 32, 0, 0x53053053) == -1 && errno == EBUSY;
    for (size_t index = 0; index < 64; index++) marks->own_sum += own[index];
}

static void compare(const struct marks *before, const struct marks *after) {
    const char *name = before->name;
    pthread_mutex_lock(&complaint);
    EXPECT(!strcmp(before->name, after->name), "%s: name is %s", name, after->name);
    EXPECT(!memcmp(&before->blocked, &after->blocked, 8), "%s: blocked signals", name);
    EXPECT(!memcmp(&before->pending, &after->pending, 8), "%s: pending signals", name);
    EXPECT(before->altstack.ss_sp == after->altstack.ss_sp && before->altstack.ss_size == after->altstack.ss_size &&
               before->altstack.ss_flags == after->altstack.ss_flags, "%s: alternate stack", name);
    EXPECT(before->robust == after->robust && before->robust_length == after->robust_length, "%s: robust list", name);
    EXPECT(before->clear_tid == after->clear_tid, "%s: clear-on-exit address", name);
    EXPECT(before->pointer == after->pointer, "%s: thread pointer", name);
    EXPECT(before->policy == after->policy, "%s: policy %d, was %d", name, after->policy, before->policy);
    EXPECT(before->nice == after->nice, "%s: nice %d, was %d", name, after->nice, before->nice);
    EXPECT(before->io_priority == after->io_priority, "%s: I/O priority", name);
    EXPECT(before->slack == after->slack, "%s: timer slack %d, was %d", name, after->slack, before->slack);
    EXPECT(before->death_signal == after->death_signal, "%s: signal at the parent's death %d, was %d", name, after->death_signal,
           before->death_signal);
    EXPECT(before->tid == after->tid, "%s: tid %d, was %d", name, after->tid, before->tid);
    EXPECT(CPU_EQUAL(&before->processors, &after->processors), "%s: processors", name);
    EXPECT(before->has_rseq == after->has_rseq, "%s: rseq", name);
    EXPECT(before->own_sum == after->own_sum, "%s: thread-local storage", name);
    pthread_mutex_unlock(&complaint);
}

static void announce(void) {
    pthread_mutex_lock(&lock);
    waiting++;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
}

/* Different in each of them: `number` says how. */
static void become(int number) {
    char name[16];
    sigset_t set;
    snprintf(name, sizeof name, "worker %d", number);
    prctl(PR_SET_NAME, name);
    sigemptyset(&set);
    sigaddset(&set, SIGRTMIN + number % 20);
    sigaddset(&set, SIGUSR2);
    pthread_sigmask(SIG_BLOCK, &set, NULL);
    pthread_sigqueue(pthread_self(), SIGUSR2, (union sigval){.sival_int = number});
    stack_t stack = {.ss_sp = malloc(65536), .ss_size = 65536};
    sigaltstack(&stack, NULL);
    setpriority(PRIO_PROCESS, 0, number % 5);
    if (number % 3 == 1) sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){0});
    syscall(SYS_ioprio_set, 1, 0, 2 << 13 | number % 8);
    prctl(PR_SET_TIMERSLACK, 60000 + number);
    static const int harmless[] = {0, SIGURG, SIGWINCH, SIGCHLD};
    prctl(PR_SET_PDEATHSIG, harmless[number % 4]);
    cpu_set_t one;
    sched_getaffinity(0, sizeof one, &one);
    for (int cpu = 0; cpu < CPU_SETSIZE; cpu++)
        if (CPU_ISSET(cpu, &one) && CPU_COUNT(&one) > 1 && number % 2) {
            CPU_CLR(cpu, &one);
            break;
        }
    sched_setaffinity(0, sizeof one, &one);
    fill(own, sizeof own, number);
}

static void nap(int number) {
    (void)number;
    wait_for_go(go);
}

static void wait_on_condition(int number) {
    (void)number;
    pthread_mutex_lock(&lock);
    while (!turn) pthread_cond_wait(&changed, &lock);
    pthread_mutex_unlock(&lock);
}

static void wait_on_condition_timed(int number) {
    (void)number;
    struct timespec until;
    while (!is_told(go)) {
        pthread_mutex_lock(&lock);
        clock_gettime(CLOCK_REALTIME, &until);
        until.tv_nsec += 3000000;
        if (until.tv_nsec >= SECOND) until.tv_nsec -= SECOND, until.tv_sec++;
        int result = pthread_cond_timedwait(&changed, &lock, &until);
        if (result && result != ETIMEDOUT) differs("timed wait returned %d", result);
        pthread_mutex_unlock(&lock);
    }
}

static void poll_for_it(int number) {
    (void)number;
    while (!is_told(go))
        if (poll(NULL, 0, 3) != 0) differs("poll ended early: %s", strerror(errno));
}

static uint32_t word;
static void wait_on_futex(int number) {
    (void)number;
    while (!is_told(go)) {
        struct timespec limit = {0, 3000000};
        if (syscall(SYS_futex, &word, FUTEX_WAIT, 0, &limit, NULL, 0) == 0 || errno != ETIMEDOUT)
            differs("futex ended early: %s", strerror(errno));
    }
}

#define LAP (1ul << 22)

/* Registers that nobody may lose: spins with numbers in the vector and general registers, and does each lap again: not all of
 * them at the end, which would take as long as the program has lived. */
static void compute(int number) {
    do {
        double sum = number, other = number * 0.5;
        uint64_t whole = number;
        unsigned long rounds = 0;
        for (; rounds % 4096 || (rounds < LAP && !is_told(go)); rounds++) {
            sum = sum * 0.999 + other;
            other = other + 1.0 - 1.0;
            whole = mix(whole ^ 5) | 1;
        }
        double sum_again = number;
        uint64_t whole_again = number;
        for (unsigned long round = 0; round < rounds; round++) {
            sum_again = sum_again * 0.999 + number * 0.5;
            whole_again = mix(whole_again ^ 5) | 1;
        }
        EXPECT(sum == sum_again && whole == whole_again, "worker %d computed something else", number);
    } while (!is_told(go));
}

static void (*const ways[])(int) = {nap, wait_on_condition, wait_on_condition_timed, poll_for_it, wait_on_futex, compute};
#define WAYS (int)(sizeof ways / sizeof *ways)

static void *work(void *argument) {
    int number = (int)(intptr_t)argument;
    struct marks before, after;
    become(number);
    look(&before);
    announce();
    ways[number < WAYS ? number : 1](number);
    look(&after);
    compare(&before, &after);
    return (void *)(intptr_t)(number * 7);
}

int main(int count, char **arguments) {
    go = arguments[1];
    int threads = WAYS + (count > 2 && !strcmp(arguments[2], "many") ? EXTRA : 0);
    pthread_t ids[WAYS + EXTRA];
    wanted_turns = threads;
    for (int number = 0; number < threads; number++)
        if (pthread_create(&ids[number], NULL, work, (void *)(intptr_t)number)) cannot("start thread %d", number);
    pthread_mutex_lock(&lock);
    while (waiting < threads) pthread_cond_wait(&changed, &lock);
    pthread_mutex_unlock(&lock);
    struct marks before, after;
    look(&before);
    ready();
    wait_for_go(go);
    look(&after);
    compare(&before, &after);
    pthread_mutex_lock(&lock);
    turn = 1;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    for (int number = 0; number < threads; number++) {
        void *result = NULL;
        int failed = pthread_join(ids[number], &result);
        EXPECT(!failed && (intptr_t)result == number * 7, "thread %d did not end as it should", number);
    }
    return finish();
}
