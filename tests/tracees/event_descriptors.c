/* Descriptors that only wake: eventfd, timerfd, signalfd and epoll; the case is named by the second argument. */
#include "tracee.h"

#include <poll.h>
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/signalfd.h>
#include <sys/timerfd.h>

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static uint64_t take(int file) {
    uint64_t value = 0;
    errno = 0;
    return read(file, &value, 8) == 8 ? value : 0;
}

static int is_ready(int file) { return poll(&(struct pollfd){file, POLLIN, 0}, 1, 0) == 1; }

static void put(int file, uint64_t value) {
    if (write(file, &value, 8) != 8) differs("cannot write to fd %d: %s", file, strerror(errno));
}

/* eventfd */

static void eventfd_counter(void) {
    int counter = eventfd(5, EFD_NONBLOCK), empty = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK), twin = dup(counter);
    put(counter, 37);
    wait_here();
    EXPECT(!is_ready(empty), "the empty one has something");
    EXPECT_EQUAL("count", take(twin), 42);
    EXPECT(take(counter) == 0 && errno == EAGAIN, "the twin counts on its own");
    EXPECT_EQUAL("flags", fcntl(empty, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    EXPECT_EQUAL("mark", fcntl(empty, F_GETFD), FD_CLOEXEC);
    EXPECT_EQUAL("mark", fcntl(counter, F_GETFD), 0);
}

static void eventfd_semaphore(void) {
    int semaphore = eventfd(3, EFD_SEMAPHORE | EFD_NONBLOCK);
    wait_here();
    for (int round = 0; round < 3; round++) EXPECT_EQUAL("one at a time", take(semaphore), 1);
    EXPECT(take(semaphore) == 0 && errno == EAGAIN, "more than three");
}

static void eventfd_full(void) {
    int counter = eventfd(0, EFD_NONBLOCK);
    put(counter, 0xfffffffffffffffdULL);
    wait_here();
    put(counter, 1);
    uint64_t one = 1;
    EXPECT(write(counter, &one, 8) == -1 && errno == EAGAIN, "it was full");
    EXPECT(take(counter) == 0xfffffffffffffffeULL, "the count differs");
}

static void eventfd_many(void) {
    int files[400];
    for (int index = 0; index < 400; index++)
        if ((files[index] = eventfd(index, EFD_NONBLOCK)) < 0) cannot("make eventfd %d", index);
    wait_here();
    for (int index = 0; index < 400; index++) EXPECT_EQUAL("count", take(files[index]), index);
}

static void pidfd_self(void) {
    int self = syscall(SYS_pidfd_open, getpid(), O_NONBLOCK), events = epoll_create1(0);
    struct stat before, after;
    if (self < 0 || epoll_ctl(events, EPOLL_CTL_ADD, self, &(struct epoll_event){EPOLLIN, {.u32 = 7}})) cannot("open a pidfd");
    fstat(self, &before);
    signal(SIGUSR2, SIG_IGN);
    wait_here();
    EXPECT(syscall(SYS_pidfd_send_signal, self, SIGUSR2, NULL, 0) == 0, "it takes no signal: %s", strerror(errno));
    EXPECT(fcntl(self, F_GETFL) & O_NONBLOCK, "it waits");
    EXPECT(fcntl(self, F_GETFD) == FD_CLOEXEC, "it is not closed by exec");
    int again = syscall(SYS_pidfd_open, getpid(), 0);
    fstat(self, &before), fstat(again, &after);
    EXPECT(before.st_ino == after.st_ino, "it stands for somebody else");
}

static pid_t waiter;

static void *await_signal(void *signals) {
    int number = 0;
    __atomic_store_n(&waiter, syscall(SYS_gettid), __ATOMIC_SEQ_CST);
    EXPECT(sigwait(signals, &number) == 0 && number == SIGUSR2, "the thread heard %d", number);
    return NULL;
}

static void pidfd_thread(void) {
    sigset_t signals, pending;
    pthread_t thread;
    sigemptyset(&signals), sigaddset(&signals, SIGUSR2), pthread_sigmask(SIG_BLOCK, &signals, NULL);
    if (pthread_create(&thread, NULL, await_signal, &signals)) cannot("start a thread");
    while (!__atomic_load_n(&waiter, __ATOMIC_SEQ_CST)) usleep(1000);
    int of_thread = syscall(SYS_pidfd_open, waiter, O_EXCL | O_NONBLOCK), twin = dup(of_thread);
    if (of_thread < 0 || twin < 0) cannot("open the pidfd of a thread");
    wait_here();
    EXPECT(!is_ready(of_thread), "it has ended");
    EXPECT_EQUAL("mark", fcntl(of_thread, F_GETFD), FD_CLOEXEC);
    EXPECT_EQUAL("mark", fcntl(twin, F_GETFD), 0);
    EXPECT(fcntl(twin, F_GETFL) & O_NONBLOCK, "it waits");
    EXPECT(syscall(SYS_pidfd_send_signal, twin, SIGUSR2, NULL, 1) == 0, "it takes no signal: %s", strerror(errno));
    pthread_join(thread, NULL);
    sigpending(&pending);
    EXPECT(!sigismember(&pending, SIGUSR2), "the signal came to the process");
    while (poll(&(struct pollfd){of_thread, POLLIN, 0}, 1, -1) != 1) continue;
}

/* Children that have ended and were waited for: two pidfds of one, one of another; files of /proc of a third. */
static void ended_processes(void) {
    pid_t children[3];
    int files[3], status;
    char path[40], text[64];
    for (int index = 0; index < 3; index++)
        if (!(children[index] = fork())) {
            pause();
            _exit(0);
        }
    for (int index = 0; index < 3; index++)
        if ((files[index] = syscall(SYS_pidfd_open, children[index / 2], index == 1 ? O_NONBLOCK : 0)) < 0) cannot("open a pidfd");
    snprintf(path, sizeof path, "/proc/%d", children[2]);
    int folder = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC), about = openat(folder, "status", O_RDONLY);
    if (about < 0) cannot("open %s/status", path);
    for (int index = 0; index < 3; index++)
        if (kill(children[index], SIGKILL) || waitpid(children[index], &status, 0) != children[index]) cannot("end a child");
    signal(SIGCHLD, hear);
    struct stat first, second, other;
    fstat(files[0], &first), fstat(files[2], &other);
    int told_apart = first.st_ino != other.st_ino;  /* since Linux 6.9 */
    wait_here();
    fstat(files[0], &first), fstat(files[1], &second), fstat(files[2], &other);
    EXPECT(first.st_ino == second.st_ino && (first.st_ino != other.st_ino) == told_apart, "they stand for others");
    for (int index = 0; index < 3; index++) {
        EXPECT(is_ready(files[index]), "pidfd %d says that somebody lives", index);
        EXPECT(syscall(SYS_pidfd_send_signal, files[index], 0, NULL, 0) == -1 && errno == ESRCH, "somebody takes a signal");
        EXPECT_EQUAL("flags", !!(fcntl(files[index], F_GETFL) & O_NONBLOCK), index == 1);
    }
    EXPECT(read(about, text, sizeof text) == -1 && errno == ESRCH, "its status is told: %s", strerror(errno));
    EXPECT(openat(folder, "status", O_RDONLY) == -1 && fcntl(folder, F_GETFD) == FD_CLOEXEC, "its folder is another one");
    EXPECT(waitpid(-1, &status, __WALL) == -1 && errno == ECHILD && !told, "there is a child");
}

/* It works in the directory of a process that has ended. */
static void ended_directory(void) {
    int here = open(".", O_RDONLY | O_DIRECTORY), status;
    char path[40];
    pid_t child = fork();
    if (child == 0) {
        pause();
        _exit(0);
    }
    snprintf(path, sizeof path, "/proc/%d", child);
    if (chdir(path) || kill(child, SIGKILL) || waitpid(child, &status, 0) != child) cannot("leave");
    ready();
    while (faccessat(here, go, F_OK, 0)) usleep(2000);
    EXPECT(getcwd(path, sizeof path) == NULL && errno == ENOENT, "it works in %s", path);
    EXPECT(open("status", O_RDONLY) == -1 && (errno == ENOENT || errno == ESRCH), "somebody lives there: %s", strerror(errno));
    EXPECT(waitpid(-1, &status, __WALL) == -1 && errno == ECHILD, "there is a child");
}

/* Namespaces of its own; the process may live in others afterwards, of the same kinds. */
static void namespaces(void) {
    static const char *const kinds[] = {"net", "pid", "time", "user", "mnt"};
    int files[5];
    for (int index = 0; index < 5; index++) {
        char path[40];
        snprintf(path, sizeof path, "/proc/self/ns/%s", kinds[index]);
        if ((files[index] = open(path, O_RDONLY | (index ? O_CLOEXEC : 0))) < 0) cannot("open %s", path);
    }
    wait_here();
    for (int index = 0; index < 5; index++) {
        char path[40];
        struct stat own, found = {0};
        snprintf(path, sizeof path, "/proc/self/ns/%s", kinds[index]);
        EXPECT(!stat(path, &own) && !fstat(files[index], &found) && own.st_ino == found.st_ino, "%s is another one", path);
        EXPECT_EQUAL("mark", fcntl(files[index], F_GETFD), index ? FD_CLOEXEC : 0);
    }
}

/* timerfd */

static void timer_relative(void) {
    int timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    struct itimerspec left, time = {.it_value = {40, 0}};
    timerfd_settime(timer, 0, &time, NULL);
    int64_t start = now_ns(CLOCK_MONOTONIC);
    wait_here();
    int64_t passed_ms = (now_ns(CLOCK_MONOTONIC) - start) / 1000000;
    timerfd_gettime(timer, &left);
    long left_ms = left.it_value.tv_sec * 1000 + left.it_value.tv_nsec / 1000000;
    EXPECT(left_ms <= 40000 && left_ms >= 40000 - passed_ms - 200, "%ld ms left after %lld", left_ms, (long long)passed_ms);
    EXPECT(take(timer) == 0 && errno == EAGAIN, "it went off");
    EXPECT_EQUAL("mark", fcntl(timer, F_GETFD), FD_CLOEXEC);
}

static void timer_absolute(clockid_t clock) {
    int timer = timerfd_create(clock, 0);
    int64_t end = now_ns(clock) + 2 * SECOND;
    struct itimerspec time = {.it_value = {end / SECOND, end % SECOND}};
    timerfd_settime(timer, TFD_TIMER_ABSTIME | (clock == CLOCK_REALTIME ? TFD_TIMER_CANCEL_ON_SET : 0), &time, NULL);
    wait_here();
    EXPECT_EQUAL("expirations", take(timer), 1);
    int64_t late = now_ns(clock) - end;
    EXPECT(late >= -20000000, "it went off %lld us early", (long long)-late / 1000);
}

static void timer_absolute_monotonic(void) { timer_absolute(CLOCK_MONOTONIC); }
static void timer_absolute_realtime(void) { timer_absolute(CLOCK_REALTIME); }
static void timer_absolute_boottime(void) { timer_absolute(CLOCK_BOOTTIME); }

/* Every expiration is counted, those before the capture too; those of the outage may be or not, as its clock goes on. */
static void timer_periodic(void) {
    int timer = timerfd_create(CLOCK_MONOTONIC, 0);
    struct itimerspec left, time = {.it_value = {0, 30000000}, .it_interval = {0, 20000000}};
    timerfd_settime(timer, 0, &time, NULL);
    int64_t start = now_ns(CLOCK_MONOTONIC);
    nanosleep(&(struct timespec){0, 100000000}, NULL);
    wait_here();
    int64_t passed_ms = (now_ns(CLOCK_MONOTONIC) - start) / 1000000;
    int64_t count = take(timer), wanted = (passed_ms - 30) / 20 + 1;
    EXPECT(count >= 4 && count <= wanted + 1, "%lld expirations in %lld ms", (long long)count,
           (long long)passed_ms);
    timerfd_gettime(timer, &left);
    EXPECT_EQUAL("interval", left.it_interval.tv_nsec, 20000000);
    EXPECT(take(timer) >= 1, "it does not go on");
}

static void timer_unread(void) {
    int timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
    struct itimerspec left, time = {.it_value = {0, 1000000}};
    timerfd_settime(timer, 0, &time, NULL);
    poll(&(struct pollfd){timer, POLLIN, 0}, 1, -1);
    wait_here();
    timerfd_gettime(timer, &left);
    EXPECT(left.it_value.tv_sec == 0 && left.it_value.tv_nsec == 0, "a timer that went off is armed");
    EXPECT_EQUAL("expirations", take(timer), 1);
    EXPECT(take(timer) == 0 && errno == EAGAIN, "it went off again");
}

static void timer_disarmed(void) {
    int timer = timerfd_create(CLOCK_REALTIME, TFD_NONBLOCK);
    wait_here();
    EXPECT(take(timer) == 0 && errno == EAGAIN, "it went off");
    struct itimerspec time = {.it_value = {0, 1}};
    timerfd_settime(timer, 0, &time, NULL);
    poll(&(struct pollfd){timer, POLLIN, 0}, 1, 10000);
    EXPECT_EQUAL("expirations", take(timer), 1);
}

/* signalfd */

static void signalfd_waiting(void) {
    sigset_t set;
    sigemptyset(&set), sigaddset(&set, SIGUSR2), sigaddset(&set, SIGRTMIN + 3);
    sigprocmask(SIG_BLOCK, &set, NULL);
    int signals = signalfd(-1, &set, SFD_NONBLOCK | SFD_CLOEXEC);
    if (signals < 0) cannot("make a signalfd");
    sigqueue(getpid(), SIGRTMIN + 3, (union sigval){.sival_int = 17});
    sigqueue(getpid(), SIGRTMIN + 3, (union sigval){.sival_int = 18});
    wait_here();
    struct signalfd_siginfo about;
    for (int value = 17; value < 19; value++) {
        EXPECT(read(signals, &about, sizeof about) == sizeof about, "no signal waits");
        EXPECT_EQUAL("signal", about.ssi_signo, SIGRTMIN + 3);
        EXPECT_EQUAL("value", about.ssi_int, value);
    }
    EXPECT(read(signals, &about, sizeof about) == -1 && errno == EAGAIN, "more signals wait");
    kill(getpid(), SIGHUP > 0 ? SIGUSR2 : 0);
    EXPECT(read(signals, &about, sizeof about) == sizeof about && about.ssi_signo == SIGUSR2, "it does not hear SIGUSR2");
}

/* epoll */

static void watch(int epoll, int file, uint32_t events, uint64_t word) {
    struct epoll_event event = {.events = events, .data.u64 = word};
    if (epoll_ctl(epoll, EPOLL_CTL_ADD, file, &event)) cannot("watch fd %d", file);
}

static void expect_event(int epoll, uint32_t events, uint64_t word) {
    struct epoll_event event = {0};
    int count = epoll_wait(epoll, &event, 1, 5000);
    EXPECT(count == 1 && event.events == events && event.data.u64 == word, "%d events: %x of %llx, not %x of %llx", count,
           event.events, (unsigned long long)event.data.u64, events, (unsigned long long)word);
}

static void expect_silence(int epoll) {
    struct epoll_event event;
    EXPECT_EQUAL("events", epoll_wait(epoll, &event, 1, 0), 0);
}

static void epoll_simple(void) {
    int epoll = epoll_create1(EPOLL_CLOEXEC), counter = eventfd(0, EFD_NONBLOCK), ends[2];
    if (pipe(ends)) cannot("make a pipe");
    watch(epoll, counter, EPOLLIN, 0xfedcba9876543210ULL);
    watch(epoll, ends[0], EPOLLIN | EPOLLRDHUP, 7);
    wait_here();
    expect_silence(epoll);
    put(counter, 1);
    expect_event(epoll, EPOLLIN, 0xfedcba9876543210ULL);
    take(counter);
    expect_silence(epoll);
    put(ends[1], 1);
    expect_event(epoll, EPOLLIN, 7);
    EXPECT(epoll_ctl(epoll, EPOLL_CTL_DEL, ends[0], NULL) == 0, "cannot take one out: %s", strerror(errno));
    expect_silence(epoll);
    EXPECT_EQUAL("mark", fcntl(epoll, F_GETFD), FD_CLOEXEC);
}

static void epoll_ready(void) {
    int epoll = epoll_create1(0), twin = dup(epoll), counter = eventfd(1, 0);
    watch(epoll, counter, EPOLLIN, 1);
    wait_here();
    expect_event(twin, EPOLLIN, 1);
    expect_event(epoll, EPOLLIN, 1);
}

static void epoll_nested(void) {
    int outer = epoll_create1(0), middle = epoll_create1(0), inner = epoll_create1(0), counter = eventfd(0, EFD_NONBLOCK);
    watch(outer, middle, EPOLLIN, 1), watch(middle, inner, EPOLLIN, 2), watch(inner, counter, EPOLLIN, 3);
    wait_here();
    expect_silence(outer);
    put(counter, 1);
    expect_event(outer, EPOLLIN, 1), expect_event(middle, EPOLLIN, 2), expect_event(inner, EPOLLIN, 3);
}

static void epoll_once(void) {
    int epoll = epoll_create1(0), used = eventfd(1, 0), fresh = eventfd(0, 0);
    watch(epoll, used, EPOLLIN | EPOLLONESHOT, 1);
    expect_event(epoll, EPOLLIN, 1);
    watch(epoll, fresh, EPOLLIN | EPOLLONESHOT, 2);
    wait_here();
    expect_silence(epoll);
    put(fresh, 1);
    expect_event(epoll, EPOLLIN, 2);
    expect_silence(epoll);
    struct epoll_event event = {.events = EPOLLIN | EPOLLONESHOT, .data.u64 = 3};
    EXPECT(epoll_ctl(epoll, EPOLL_CTL_MOD, used, &event) == 0, "cannot arm it again: %s", strerror(errno));
    expect_event(epoll, EPOLLIN, 3);
}

static void epoll_edge(void) {
    int epoll = epoll_create1(0), counter = eventfd(0, EFD_NONBLOCK);
    watch(epoll, counter, EPOLLIN | EPOLLET, 9);
    wait_here();
    put(counter, 1);
    expect_event(epoll, EPOLLIN, 9);
    expect_silence(epoll);
    put(counter, 1);
    expect_event(epoll, EPOLLIN, 9);
}

static void epoll_exclusive(void) {
    int epoll = epoll_create1(0), counter = eventfd(0, EFD_NONBLOCK);
    watch(epoll, counter, EPOLLIN | EPOLLEXCLUSIVE, 11);
    wait_here();
    put(counter, 1);
    expect_event(epoll, EPOLLIN, 11);
    struct epoll_event event = {.events = EPOLLIN};
    EXPECT(epoll_ctl(epoll, EPOLL_CTL_MOD, counter, &event) == -1 && errno == EINVAL, "it is not exclusive any more");
}

/* What was registered under a number that is closed by now, or leads to something else. */
static void epoll_renumbered(void) {
    int epoll = epoll_create1(0), first = eventfd(0, 0), second = eventfd(0, 0);
    watch(epoll, first, EPOLLIN, 1), watch(epoll, second, EPOLLIN, 2);
    int far = dup2(first, 300), near = dup2(second, 301);
    close(first), close(second);
    int new_first = eventfd(0, EFD_CLOEXEC);
    if (new_first != first) cannot("get the number again");
    watch(epoll, new_first, EPOLLIN, 3);
    wait_here();
    EXPECT_EQUAL("mark", fcntl(new_first, F_GETFD), FD_CLOEXEC);
    EXPECT(fcntl(second, F_GETFD) == -1, "a closed descriptor is open");
    expect_silence(epoll);
    put(far, 1), expect_event(epoll, EPOLLIN, 1), take(far);
    put(near, 1), expect_event(epoll, EPOLLIN, 2), take(near);
    put(new_first, 1), expect_event(epoll, EPOLLIN, 3);
}

/* It sleeps in epoll_wait when it is captured, for ever, and is woken by a timer. */
static void epoll_waiting(void) {
    int epoll = epoll_create1(0), timer = timerfd_create(CLOCK_MONOTONIC, 0);
    struct itimerspec time = {.it_value = {0, 5000000}, .it_interval = {0, 5000000}};
    struct epoll_event event;
    watch(epoll, timer, EPOLLIN, 5);
    timerfd_settime(timer, 0, &time, NULL);
    ready();
    while (!is_told(go)) {
        int count = epoll_wait(epoll, &event, 1, -1);
        EXPECT(count == 1 && event.data.u64 == 5, "epoll_wait: %d (%s)", count, strerror(errno));
        EXPECT(take(timer) >= 1, "nothing to read");
    }
}

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
    } cases[] = {{"eventfd_counter", eventfd_counter},
                 {"eventfd_semaphore", eventfd_semaphore},
                 {"eventfd_full", eventfd_full},
                 {"eventfd_many", eventfd_many}, {"pidfd_self", pidfd_self},
                 {"pidfd_thread", pidfd_thread},
                 {"ended_processes", ended_processes},
                 {"ended_directory", ended_directory},
                 {"namespaces", namespaces},
                 {"timer_relative", timer_relative},
                 {"timer_absolute_monotonic", timer_absolute_monotonic},
                 {"timer_absolute_realtime", timer_absolute_realtime},
                 {"timer_absolute_boottime", timer_absolute_boottime},
                 {"timer_periodic", timer_periodic},
                 {"timer_unread", timer_unread},
                 {"timer_disarmed", timer_disarmed},
                 {"signalfd_waiting", signalfd_waiting},
                 {"epoll_simple", epoll_simple},
                 {"epoll_ready", epoll_ready},
                 {"epoll_nested", epoll_nested},
                 {"epoll_once", epoll_once},
                 {"epoll_edge", epoll_edge},
                 {"epoll_exclusive", epoll_exclusive},
                 {"epoll_renumbered", epoll_renumbered},
                 {"epoll_waiting", epoll_waiting}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}
