/* Pending signals: the process's and the thread's, realtime ones with their values in order, and who sent them. */
#include "tracee.h"

static void expect_next(sigset_t *which, int number, int code, int value) {
    siginfo_t about;
    struct timespec none = {0, 0};
    memset(&about, 0, sizeof about);
    int got = syscall(SYS_rt_sigtimedwait, which, &about, &none, 8); /* the C library rewrites si_code */
    if (got != number) {
        differs("next pending signal is %d, was %d", got, number);
        return;
    }
    EXPECT_EQUAL("si_code", about.si_code, code);
    if (code == SI_QUEUE) EXPECT_EQUAL("si_value", about.si_value.sival_int, value);
    EXPECT_EQUAL("si_uid", about.si_uid, getuid());
    if (code == SI_QUEUE) EXPECT_EQUAL("si_pid", about.si_pid, value / 1000000);
}

int main(int count, char **arguments) {
    (void)count;
    sigset_t all, one, left;
    int pid = getpid() % 2000;
    sigfillset(&all);
    sigprocmask(SIG_BLOCK, &all, NULL);
    for (int index = 0; index < 5; index++) {
        siginfo_t about = {.si_code = SI_QUEUE};
        about.si_pid = pid, about.si_uid = getuid(), about.si_value.sival_int = pid * 1000000 + index;
        syscall(SYS_rt_sigqueueinfo, getpid(), SIGRTMIN + 2, &about);
        about.si_value.sival_int = pid * 1000000 + 100 + index;
        syscall(SYS_rt_tgsigqueueinfo, getpid(), gettid(), SIGRTMIN + 4, &about);
    }
    kill(getpid(), SIGTERM);
    syscall(SYS_tgkill, getpid(), gettid(), SIGHUP);
    kill(getpid(), SIGRTMIN + 6);
    siginfo_t trap = {.si_code = SI_QUEUE};
    trap.si_pid = pid, trap.si_uid = getuid(), trap.si_value.sival_int = pid * 1000000 + 7;
    syscall(SYS_rt_sigqueueinfo, getpid(), SIGTRAP, &trap);
    trap.si_value.sival_int++;
    syscall(SYS_rt_tgsigqueueinfo, getpid(), gettid(), SIGTRAP, &trap);
    ready();
    wait_for_go(arguments[1]);
    sigemptyset(&one);
    sigaddset(&one, SIGHUP);
    expect_next(&one, SIGHUP, SI_TKILL, 0);
    sigaddset(&one, SIGTERM);
    expect_next(&one, SIGTERM, SI_USER, 0);
    sigaddset(&one, SIGRTMIN + 2);
    for (int index = 0; index < 5; index++) expect_next(&one, SIGRTMIN + 2, SI_QUEUE, pid * 1000000 + index);
    sigaddset(&one, SIGRTMIN + 4);
    for (int index = 0; index < 5; index++) expect_next(&one, SIGRTMIN + 4, SI_QUEUE, pid * 1000000 + 100 + index);
    sigaddset(&one, SIGRTMIN + 6);
    expect_next(&one, SIGRTMIN + 6, SI_USER, 0);
    sigemptyset(&one), sigaddset(&one, SIGTRAP);
    for (int last = 1; last >= 0; last--) expect_next(&one, SIGTRAP, SI_QUEUE, pid * 1000000 + 7 + last);
    sigpending(&left);
    for (int number = 1; number <= 64; number++)
        EXPECT(!sigismember(&left, number), "signal %d is pending and nobody sent it", number);
    return finish();
}
