/* Who the program is to itself: the kernel's word, /proc's, and what a lock or a signal makes of it. "other": it may have changed. */
#include "tracee.h"

#include <pthread.h>
#include <sys/file.h>

static volatile sig_atomic_t sender;

static void hear_from(int signal_number, siginfo_t *about, void *context) {
    (void)signal_number, (void)context;
    sender = about->si_pid;
}

static long own_number(const char *path) {
    char text[64] = "";
    ssize_t size = readlink(path, text, sizeof text - 1);
    return size > 0 ? atol(text) : -1;
}

int main(int count, char **arguments) {
    int may_change = count > 2;
    pid_t pid = getpid(), tid = gettid();
    int64_t monotonic = now_ns(CLOCK_MONOTONIC), boot = now_ns(CLOCK_BOOTTIME);
    pthread_mutex_t mutex;
    pthread_mutexattr_t attributes;
    pthread_mutexattr_init(&attributes);
    pthread_mutexattr_settype(&attributes, PTHREAD_MUTEX_ERRORCHECK);
    pthread_mutex_init(&mutex, &attributes);
    pthread_mutex_lock(&mutex); /* it holds our thread's id */
    ready();
    wait_for_go(arguments[1]);
    if (!may_change) {
        EXPECT_EQUAL("getpid", getpid(), pid);
        EXPECT_EQUAL("gettid", gettid(), tid);
    }
    EXPECT(getpid() == gettid(), "the first thread is %d of process %d", gettid(), getpid());
    EXPECT_EQUAL("/proc/self", own_number("/proc/self"), getpid());
    EXPECT(kill(getpid(), 0) == 0, "it cannot send to itself");
    struct sigaction action = {.sa_sigaction = hear_from, .sa_flags = SA_SIGINFO};
    sigaction(SIGUSR2, &action, NULL);
    syscall(SYS_tgkill, getpid(), gettid(), SIGUSR2);
    EXPECT_EQUAL("sender", sender, getpid());
    EXPECT(pthread_mutex_unlock(&mutex) == 0, "its own lock is somebody else's");
    EXPECT(now_ns(CLOCK_MONOTONIC) >= monotonic && now_ns(CLOCK_BOOTTIME) >= boot, "a clock went back");
    fflush(stdout);
    pid_t child = fork();
    if (child == 0) _exit(getppid() == getpid() ? 1 : 0);
    int status;
    EXPECT(waitpid(child, &status, 0) == child && status == 0, "its child is not its own");
    return finish();
}
