/* Its first thread has ended; the others go on, and must find it ended in every life.
 *
 * Second argument: nothing; "late": the first thread ends when there is a file "leave"; "brief": the eldest of the others ends
 * when there is a file "hush"; "exec": that one executes another program then; "status": at the end all end one by one, each with another status;
 * "child": it has one.
 */
#include "tracee.h"

#include <pthread.h>
#include <sys/prctl.h>

#define WORKERS 4
#define STATUS 7

static const char *go, *mode = "";
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static pthread_t first, workers[WORKERS];
static pid_t process, child;
static int waiting, ticks, opened;
static __thread uint64_t own[64];
static uint64_t *heap;
static timer_t timer;

static int is(const char *name) { return !strcmp(mode, name); }

static char state_of_first(void) {
    char path[64], text[512] = "";
    snprintf(path, sizeof path, "/proc/self/task/%d/stat", process);
    int file = open(path, O_RDONLY | O_CLOEXEC);
    if (file < 0 || read(file, text, sizeof text - 1) < 0) return '?';
    close(file);
    char *end = strrchr(text, ')');
    return end ? end[2] : '?';
}

static void tick(int number) { ticks += number == SIGRTMIN; }

static void start_timer(void) {
    struct sigaction action = {.sa_handler = tick};
    sigaction(SIGRTMIN, &action, NULL);
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGRTMIN};
    struct itimerspec every = {{0, 5000000}, {0, 5000000}};
    if (timer_create(CLOCK_MONOTONIC, &event, &timer) || timer_settime(timer, 0, &every, NULL)) cannot("set a timer");
}

/* What all of them look at; by one thread at a time. */
static void compare(int number) {
    pthread_mutex_lock(&lock);
    EXPECT_EQUAL("pid", getpid(), process);
    EXPECT_EQUAL("state of the first thread", state_of_first(), 'Z');
    uint64_t wanted[64];
    fill(wanted, sizeof wanted, number);
    EXPECT(!memcmp(own, wanted, sizeof own), "worker %d: thread-local storage", number);
    int death_signal = 0;
    prctl(PR_GET_PDEATHSIG, &death_signal);
    EXPECT_EQUAL("signal at the parent's death", death_signal, SIGURG);
    EXPECT(tgkill(process, process, 0) == 0, "worker %d: nobody has the first thread's id", number);
    pthread_mutex_unlock(&lock);
}

/* Those of the process as a whole. */
static void compare_process(void) {
    char text[8] = "";
    EXPECT_EQUAL("joining the first thread", pthread_tryjoin_np(first, NULL), 0);
    EXPECT(pread(opened, text, 5, 0) == 5 && !strcmp(text, "there"), "the open file says %s", text);
    struct flock held = {.l_type = F_WRLCK, .l_whence = SEEK_SET};
    EXPECT(fcntl(opened, F_GETLK, &held) == 0 && held.l_type == F_UNLCK, "the lock is somebody else's");
    uint64_t *wanted = malloc(64 * PAGE);
    fill(wanted, 64 * PAGE, 99);
    EXPECT(!memcmp(heap, wanted, 64 * PAGE), "the heap");
    int before = ticks;
    for (int tries = 0; tries < 2000 && ticks == before; tries++) usleep(10000);
    EXPECT(ticks != before, "the timer stands still");
}

static void *work(void *argument) {
    int number = (int)(intptr_t)argument;
    char name[16];
    snprintf(name, sizeof name, "worker %d", number);
    prctl(PR_SET_NAME, name);
    prctl(PR_SET_PDEATHSIG, SIGURG);
    fill(own, sizeof own, number);
    pthread_mutex_lock(&lock);
    waiting++;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    if (number == 0 && is("brief")) {
        while (!is_told("hush")) usleep(2000);
        return NULL;
    }
    if (number == 0 && is("exec")) {
        while (!is_told("hush")) usleep(2000);
        execl("/bin/sleep", "sleep", "1000", NULL);
    }
    while (number == 1 && !is("late") && state_of_first() != 'Z') usleep(1000);
    if (number == 1) ready();
    while (!is_told(go)) usleep(2000);
    if (number == 1 && is("late"))
        while (state_of_first() != 'Z') usleep(1000);
    while (state_of_first() != 'Z') usleep(1000);
    compare(number);
    if (number != 1) return NULL;
    for (int other = 0; other < WORKERS; other++)
        if (other != number) pthread_join(workers[other], NULL);
    compare_process();
    timer_delete(timer);
    if (child > 0) kill(child, SIGKILL);
    int status = finish();
    if (is("status") && status == 0) syscall(SYS_exit, 3);
    exit(status);
}

int main(int count, char **arguments) {
    go = arguments[1];
    if (count > 2) mode = arguments[2];
    first = pthread_self();
    process = getpid();
    heap = malloc(64 * PAGE);
    fill(heap, 64 * PAGE, 99);
    opened = open("held", O_RDWR | O_CREAT, 0644);
    struct flock held = {.l_type = F_WRLCK, .l_whence = SEEK_SET};
    if (opened < 0 || write(opened, "there", 5) != 5 || fcntl(opened, F_SETLK, &held)) cannot("lock a file");
    if (is("child") && !(child = fork()))
        for (;;) pause();
    start_timer();
    sigset_t all;
    sigfillset(&all);
    for (int number = 0; number < WORKERS; number++) {
        if (pthread_create(&workers[number], NULL, work, (void *)(intptr_t)number)) cannot("start thread %d", number);
        pthread_mutex_lock(&lock);
        while (waiting <= number) pthread_cond_wait(&changed, &lock);
        pthread_mutex_unlock(&lock);
    }
    pthread_sigmask(SIG_BLOCK, &all, NULL);
    if (is("late"))
        while (!is_told("leave")) usleep(2000);
    if (is("status")) syscall(SYS_exit, STATUS);
    pthread_exit(NULL);
}
