/* All 64 signal actions with flags, masks and restorers, and the blocked set, as the kernel tells them. */
#include "tracee.h"

struct kernel_action {
    uint64_t handler, flags, restorer, mask;
};

static volatile sig_atomic_t calls, value_seen, blocked_inside;

static void note(int signal_number, siginfo_t *about, void *context) {
    (void)signal_number, (void)context;
    sigset_t now;
    sigprocmask(SIG_BLOCK, NULL, &now);
    blocked_inside = sigismember(&now, SIGHUP) && sigismember(&now, SIGRTMIN + 5);
    value_seen = about->si_value.sival_int;
    calls++;
}

static void read_actions(struct kernel_action *actions) {
    memset(actions, 0, 65 * sizeof *actions);
    for (int number = 1; number <= 64; number++) syscall(SYS_rt_sigaction, number, NULL, &actions[number], 8);
}

int main(int count, char **arguments) {
    (void)count;
    static struct kernel_action before[65], after[65];
    struct sigaction action = {.sa_sigaction = note, .sa_flags = SA_SIGINFO | SA_NODEFER};
    sigset_t blocked, now;
    sigemptyset(&action.sa_mask);
    sigaddset(&action.sa_mask, SIGHUP);
    sigaddset(&action.sa_mask, SIGRTMIN + 5);
    sigaction(SIGUSR2, &action, NULL);
    action.sa_flags = SA_SIGINFO | SA_RESTART | SA_RESETHAND;
    sigaction(SIGRTMIN + 3, &action, NULL);
    action.sa_flags = SA_SIGINFO | SA_ONSTACK | SA_NOCLDSTOP | SA_NOCLDWAIT;
    sigaction(SIGCHLD, &action, NULL);
    signal(SIGPIPE, SIG_IGN);
    signal(SIGRTMAX, SIG_IGN);
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGTERM);
    sigaddset(&blocked, SIGRTMIN + 9);
    sigaddset(&blocked, SIGRTMAX);
    sigprocmask(SIG_BLOCK, &blocked, NULL);
    read_actions(before);
    ready();
    wait_for_go(arguments[1]);
    read_actions(after);
    for (int number = 1; number <= 64; number++) {
        EXPECT(!memcmp(&before[number], &after[number], sizeof *before), "action of signal %d changed", number);
    }
    sigprocmask(SIG_BLOCK, NULL, &now);
    for (int number = 1; number <= 64; number++)
        EXPECT(sigismember(&now, number) == sigismember(&blocked, number), "signal %d is%s blocked", number,
               sigismember(&now, number) ? "" : " not");
    union sigval value = {.sival_int = 31};
    sigqueue(getpid(), SIGRTMIN + 3, value);
    EXPECT(calls == 1 && value_seen == 31 && blocked_inside, "the queued signal ran its action wrongly");
    syscall(SYS_rt_sigaction, SIGRTMIN + 3, NULL, &after[0], 8);
    EXPECT(after[0].handler == 0, "SA_RESETHAND did not reset");
    raise(SIGUSR2);
    raise(SIGPIPE);
    EXPECT_EQUAL("handled signals", calls, 2);
    return finish();
}
