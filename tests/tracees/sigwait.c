/* Waits in sigwaitinfo, or with "timed" in sigtimedwait of 1.5 s, and must see neither EINTR nor a wrong signal. */
#include "tracee.h"

int main(int count, char **arguments) {
    sigset_t wanted;
    siginfo_t about;
    (void)arguments;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGUSR1);
    sigaddset(&wanted, SIGRTMIN);
    sigprocmask(SIG_BLOCK, &wanted, NULL);
    int64_t start = now_ns(CLOCK_MONOTONIC);
    ready();
    if (count > 2) {
        struct timespec limit = {1, 500000000};
        int got = sigtimedwait(&wanted, &about, &limit);
        int64_t waited = now_ns(CLOCK_MONOTONIC) - start;
        EXPECT(got == -1 && errno == EAGAIN, "sigtimedwait returned %d: %s", got, strerror(errno));
        EXPECT(waited >= 1490000000, "it waited only %lld ms", (long long)waited / 1000000);
    } else {
        int got = sigwaitinfo(&wanted, &about);
        EXPECT(got == SIGUSR1, "sigwaitinfo returned %d: %s", got, strerror(errno));
    }
    return finish();
}
