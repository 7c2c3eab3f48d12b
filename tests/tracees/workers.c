/* Five threads, each waiting at a descriptor in its own way; told to go on, each must answer in turn, and only then.
 *
 * The file "locked" is locked by somebody else, who lets go of it when he sees the line "unlock".
 */
#include "tracee.h"
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/un.h>

#define WORKERS 5

static const char *const names[WORKERS] = {"epoll", "read", "accept", "lock", "signal"};
static int event_of_epoll, event_of_read, listener, locked;
static volatile int waiting[WORKERS], answered[WORKERS];
static volatile pid_t tids[WORKERS];
static struct sockaddr_un name = {.sun_family = AF_UNIX, .sun_path = "workers.sock"};

static void wait_in_epoll(void) {
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = 77};
    uint64_t count = 0;
    int epoll = epoll_create1(0);
    epoll_ctl(epoll, EPOLL_CTL_ADD, event_of_epoll, &event);
    event.data.u64 = 0;
    waiting[0] = 1;
    int got = epoll_wait(epoll, &event, 1, -1);
    EXPECT(got == 1 && event.data.u64 == 77, "epoll_wait returned %d, %s", got, strerror(errno));
    EXPECT(read(event_of_epoll, &count, 8) == 8 && count == 5, "the eventfd of the epoll had %llu", (unsigned long long)count);
}

static void wait_in_read(void) {
    uint64_t count = 0;
    waiting[1] = 1;
    EXPECT(read(event_of_read, &count, 8) == 8 && count == 6, "the eventfd that is read had %llu", (unsigned long long)count);
}

static void wait_in_accept(void) {
    waiting[2] = 1;
    int accepted = accept(listener, NULL, NULL);
    EXPECT(accepted >= 0, "accept: %s", strerror(errno));
    close(accepted);
}

static void wait_for_lock(void) {
    struct flock lock = {.l_type = F_RDLCK, .l_whence = SEEK_SET};
    waiting[3] = 1;
    EXPECT(fcntl(locked, F_SETLKW, &lock) == 0, "F_SETLKW: %s", strerror(errno));
}

/* Another signal, which the descriptor does not tell of, is pending for this thread alone all the while. */
static void wait_for_signal(void) {
    struct signalfd_siginfo told = {0};
    sigset_t wanted, pending;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGUSR1);
    int descriptor = signalfd(-1, &wanted, 0);
    pthread_kill(pthread_self(), SIGUSR2);
    waiting[4] = 1;
    long got = read(descriptor, &told, sizeof told);
    EXPECT(got == sizeof told && told.ssi_signo == SIGUSR1, "the signalfd told of %u: %s", told.ssi_signo, strerror(errno));
    sigpending(&pending);
    EXPECT(sigismember(&pending, SIGUSR2), "the pending signal of the thread is lost");
}

static void (*const acts[WORKERS])(void) = {wait_in_epoll, wait_in_read, wait_in_accept, wait_for_lock, wait_for_signal};

static void *work(void *number) {
    int own = (int)(intptr_t)number;
    tids[own] = gettid();
    acts[own]();
    answered[own] = 1;
    return NULL;
}

/* Whether a thread sleeps, as /proc tells it. */
static int sleeps(pid_t tid) {
    char path[64], line[512] = "";
    snprintf(path, sizeof path, "/proc/self/task/%d/stat", tid);
    FILE *stat = fopen(path, "r");
    if (!stat || !fgets(line, sizeof line, stat)) return 0;
    fclose(stat);
    return !strncmp(strrchr(line, ')'), ") S", 3);
}

static void ring(int own) {
    uint64_t count = (uint64_t)own + 5;
    if (own == 0) EXPECT(write(event_of_epoll, &count, 8) == 8, "write: %s", strerror(errno));
    if (own == 1) EXPECT(write(event_of_read, &count, 8) == 8, "write: %s", strerror(errno));
    if (own == 2) {
        int caller = socket(AF_UNIX, SOCK_STREAM, 0);
        EXPECT(connect(caller, (void *)&name, sizeof name) == 0, "connect: %s", strerror(errno));
        close(caller);
    }
    if (own == 3) {
        puts("unlock");
        fflush(stdout);
    }
    if (own == 4) EXPECT(syscall(SYS_tgkill, getpid(), tids[4], SIGUSR1) == 0, "tgkill: %s", strerror(errno));
}

int main(int count, char **arguments) {
    pthread_t threads[WORKERS];
    sigset_t blocked, pending;
    (void)count;
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGUSR1);
    sigaddset(&blocked, SIGUSR2);
    sigprocmask(SIG_BLOCK, &blocked, NULL);
    event_of_epoll = eventfd(0, 0);
    event_of_read = eventfd(0, 0);
    listener = socket(AF_UNIX, SOCK_STREAM, 0);
    locked = open("locked", O_RDONLY);
    if (bind(listener, (void *)&name, sizeof name) || listen(listener, 4) || locked < 0) cannot("listen, or open the file");
    for (int own = 0; own < WORKERS; own++)
        if (pthread_create(&threads[own], NULL, work, (void *)(intptr_t)own)) cannot("make a thread");
    for (int own = 0; own < WORKERS; own++)
        while (!waiting[own] || !sleeps(tids[own])) usleep(1000);
    ready();
    wait_for_go(arguments[1]);
    sigpending(&pending);
    EXPECT(!sigismember(&pending, SIGUSR2), "the pending signal of one thread is pending for all");
    for (int own = 0; own < WORKERS; own++) {
        for (int other = 0; other < WORKERS; other++)
            EXPECT(answered[other] == (other < own), "before %s was called, %s had %d", names[own], names[other], answered[other]);
        ring(own);
        pthread_join(threads[own], NULL);
    }
    return finish();
}
