/* Waits again and again in a call that the kernel ends with EINTR at every stop; every wait must end as it does undisturbed.
 *
 * waits GO KIND: says "round" after each wait, and looks for the go file then. "lenient" as a third argument: a wait may end
 * with EINTR, once its time is over.
 */
#include "tracee.h"
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/ipc.h>
#include <sys/sem.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>

#define LONG_MS 400
#define TICK_MS 10
#define EVENT_US 10000
#define EVENT_LIMIT_MS 100
#define SIGNAL_US 3000

static const char *go, *kind;
static int lenient, epoll = -1, channel[2], set, listener, pair[2];
static volatile sig_atomic_t handled;

static int is(const char *wanted) { return strcmp(kind, wanted) == 0; }

static void count_signal(int signal_number) {
    (void)signal_number;
    handled++;
}

/* One wait: what the call returned, and how long it was told to wait. */
struct wait {
    int result, error, limit_ms;
};

static struct wait of_epoll(int limit_ms) {
    struct epoll_event events[4];
    errno = 0;
    int got = epoll_wait(epoll, events, 4, limit_ms);
    return (struct wait){got, errno, limit_ms};
}

/* As a compiler may do it: the registers of the arguments are loaded once, for many calls. The kernel changes rcx and r11 only. */
#ifdef __x86_64__
static struct wait of_inline_code(void) {
    static struct epoll_event events[4];
    struct wait found = {0, 0, LONG_MS};
    register long limit __asm__("r10") = LONG_MS;
    register long spare __asm__("r8") = 0x8888, other __asm__("r9") = 0x9999;
    long result = SYS_epoll_wait, descriptor = epoll, count = 4;
    void *where = events;
    __asm__ volatile("syscall"
                     : "+a"(result), "+D"(descriptor), "+S"(where), "+d"(count), "+r"(limit), "+r"(spare), "+r"(other)
                     :
                     : "rcx", "r11", "memory");
    EXPECT(limit == LONG_MS && spare == 0x8888 && other == 0x9999, "r10, r8, r9 have become %ld, %lx, %lx", limit, spare, other);
    EXPECT(descriptor == epoll && where == events && count == 4, "rdi, rsi or rdx has changed");
    found.result = result < 0 ? -1 : (int)result;
    found.error = result < 0 ? (int)-result : 0;
    return found;
}

#else
/* There the kernel changes nothing but the result. */
static struct wait of_inline_code(void) {
    static struct epoll_event events[4];
    struct wait found = {0, 0, LONG_MS};
    register long number __asm__("x8") = SYS_epoll_pwait, result __asm__("x0") = epoll, count __asm__("x2") = 4;
    register long limit __asm__("x3") = LONG_MS, mask __asm__("x4") = 0, size __asm__("x5") = 8, spare __asm__("x6") = 0x6666;
    register void *where __asm__("x1") = events;
    __asm__ volatile("svc #0"
                     : "+r"(number), "+r"(result), "+r"(where), "+r"(count), "+r"(limit), "+r"(mask), "+r"(size), "+r"(spare)
                     :
                     : "memory");
    EXPECT(number == SYS_epoll_pwait && where == events && count == 4 && limit == LONG_MS, "x8, x1, x2 or x3 has changed");
    EXPECT(!mask && size == 8 && spare == 0x6666, "x4, x5, x6 have become %lx, %lx, %lx", mask, size, spare);
    found.result = result < 0 ? -1 : (int)result;
    found.error = result < 0 ? (int)-result : 0;
    return found;
}
#endif

static struct wait of_pwait2(void) {
    struct epoll_event events[4];
    struct timespec limit = {0, LONG_MS * 1000000L};
    errno = 0;
    int got = (int)syscall(SYS_epoll_pwait2, epoll, events, 4, &limit, NULL, 8);
    EXPECT(limit.tv_sec == 0 && limit.tv_nsec == LONG_MS * 1000000L, "the time of epoll_pwait2 has changed");
    if (got < 0 && errno == ENOSYS) cannot("make an epoll_pwait2");
    return (struct wait){got, errno, LONG_MS};
}

static struct wait of_signals(void) {
    struct timespec limit = {0, LONG_MS * 1000000L};
    sigset_t wanted;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGUSR1);
    errno = 0;
    int got = sigtimedwait(&wanted, NULL, &limit);
    return (struct wait){got, errno, LONG_MS};
}

static struct wait of_semaphore(void) {
    struct timespec limit = {0, LONG_MS * 1000000L};
    struct sembuf down = {0, -1, 0};
    errno = 0;
    int got = semtimedop(set, &down, 1, &limit);
    return (struct wait){got, errno, LONG_MS};
}

static struct wait of_socket(void) {
    char byte[65536] = "";
    errno = 0;
    long got = 0;
    if (is("recv")) got = recv(pair[0], byte, 1, 0);
    if (is("read")) got = read(pair[0], byte, 1);
    if (is("accept")) got = accept(listener, NULL, NULL);
    if (is("send"))
        while ((got = send(pair[0], byte, sizeof byte, 0)) > 0) continue;
    return (struct wait){(int)got, errno, LONG_MS};
}

static struct wait once(void) {
    if (is("inline")) return of_inline_code();
    if (is("pwait2")) return of_pwait2();
    if (is("sigtimedwait")) return of_signals();
    if (is("semtimedop")) return of_semaphore();
    if (is("ticks")) return of_epoll(TICK_MS);
    if (is("epoll") || is("thread")) return of_epoll(LONG_MS);
    return of_socket();
}

/* Waits for nothing: each wait ends when its time is over. */
static void *time_out(void *unused) {
    do {
        int64_t began = now_ns(CLOCK_MONOTONIC);
        struct wait found = once();
        int64_t waited_ms = (now_ns(CLOCK_MONOTONIC) - began) / 1000000;
        int over = found.result == 0 || (found.result == -1 && found.error == EAGAIN);
        EXPECT(over || (lenient && found.error == EINTR), "it returned %d: %s", found.result, strerror(found.error));
        EXPECT(waited_ms >= found.limit_ms, "it waited for %lld of %d ms", (long long)waited_ms, found.limit_ms);
        puts("round");
        fflush(stdout);
    } while (!is_told(go));
    return unused;
}

/* Somebody writes a byte at a time; each must arrive, and no wait may end without one before its time is over. */
static void *write_bytes(void *unused) {
    for (unsigned char next = 0; !is_told(go); next++) {
        usleep(EVENT_US);
        if (write(channel[1], &next, 1) != 1) differs("write: %s", strerror(errno));
    }
    close(channel[1]);
    return unused;
}

static void receive_events(uint32_t flags) {
    struct epoll_event event = {.events = EPOLLIN | flags};
    pthread_t writer;
    fcntl(channel[0], F_SETFL, O_NONBLOCK);
    epoll_ctl(epoll, EPOLL_CTL_ADD, channel[0], &event);
    if (pthread_create(&writer, NULL, write_bytes, NULL)) cannot("make a thread");
    unsigned char byte, wanted = 0;
    for (long size = 1; size != 0;) {
        int64_t began = now_ns(CLOCK_MONOTONIC);
        int got = epoll_wait(epoll, &event, 1, EVENT_LIMIT_MS);
        int64_t waited_ms = (now_ns(CLOCK_MONOTONIC) - began) / 1000000;
        int is_right = got == 1 || (got == 0 && waited_ms >= EVENT_LIMIT_MS); /* the writer was late */
        EXPECT(is_right, "epoll_wait returned %d after %lld ms: %s", got, (long long)waited_ms, strerror(errno));
        while ((size = read(channel[0], &byte, 1)) == 1) EXPECT_EQUAL("a byte", byte, wanted++);
        puts("round");
        fflush(stdout);
    }
    pthread_join(writer, NULL);
}

/* A handler ends the wait that it runs in; it can run nowhere else. */
static void be_interrupted(void) {
    struct sigaction action = {.sa_handler = count_signal, .sa_flags = SA_RESTART};
    struct itimerval every = {{0, SIGNAL_US}, {0, SIGNAL_US}};
    struct epoll_event event;
    sigset_t blocked, outside;
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGALRM);
    sigprocmask(SIG_BLOCK, &blocked, &outside);
    sigaction(SIGALRM, &action, NULL);
    setitimer(ITIMER_REAL, &every, NULL);
    for (int ends = 0; !is_told(go);) {
        int got = epoll_pwait(epoll, &event, 1, 5000, &outside);
        EXPECT(got == -1 && errno == EINTR, "epoll_pwait returned %d: %s", got, strerror(errno));
        EXPECT_EQUAL("waits that were ended by handlers", ++ends, handled);
        puts("round");
        fflush(stdout);
    }
}

static void set_stage(void) {
    struct timeval limit = {0, LONG_MS * 1000};
    struct sockaddr_un name = {.sun_family = AF_UNIX};
    sigset_t blocked;
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGUSR1);
    if (is("sigtimedwait")) sigprocmask(SIG_BLOCK, &blocked, NULL);
    epoll = epoll_create1(0);
    if (epoll < 0 || pipe(channel)) cannot("make an epoll and a pipe");
    if (is("semtimedop")) {
        set = semget(IPC_PRIVATE, 1, 0600);
        if (set < 0) cannot("make a semaphore");
    }
    if (is("recv") || is("read") || is("send")) {
        if (socketpair(AF_UNIX, SOCK_STREAM, 0, pair)) cannot("make a pair of sockets");
        setsockopt(pair[0], SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
        setsockopt(pair[0], SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit);
    }
    if (is("accept")) {
        listener = socket(AF_UNIX, SOCK_STREAM, 0);
        snprintf(name.sun_path, sizeof name.sun_path, "listener");
        if (bind(listener, (void *)&name, sizeof name) || listen(listener, 1)) cannot("listen");
        setsockopt(listener, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
    }
}

int main(int count, char **arguments) {
    go = arguments[1];
    kind = arguments[2];
    lenient = count > 3;
    set_stage();
    ready();
    if (is("bytes")) {
        receive_events(0);
    } else if (is("edges")) {
        receive_events(EPOLLET);
    } else if (is("handlers")) {
        be_interrupted();
    } else if (is("thread")) {
        pthread_t thread;
        if (pthread_create(&thread, NULL, time_out, NULL)) cannot("make a thread");
        pthread_join(thread, NULL);
    } else {
        time_out(NULL);
    }
    if (is("semtimedop")) semctl(set, 0, IPC_RMID);
    return finish();
}
