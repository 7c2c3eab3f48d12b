/* A fast timer whose signal is blocked: it stays pending once, and the expirations meanwhile are counted. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    sigset_t wanted;
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGRTMIN + 1};
    struct itimerspec often = {.it_interval = {0, 10000000}, .it_value = {0, 10000000}};
    timer_t timer;
    event.sigev_value.sival_int = 88;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGRTMIN + 1);
    sigprocmask(SIG_BLOCK, &wanted, NULL);
    timer_create(CLOCK_MONOTONIC, &event, &timer);
    timer_settime(timer, 0, &often, NULL);
    struct timespec nap = {0, 300000000};
    nanosleep(&nap, NULL);
    ready();
    wait_for_go(arguments[1]);
    siginfo_t about;
    struct timespec limit = {5, 0};
    for (int round = 0; round < 3; round++) {
        int got = sigtimedwait(&wanted, &about, &limit);
        EXPECT(got == SIGRTMIN + 1, "no signal from the timer");
        EXPECT_EQUAL("its value", about.si_value.sival_int, 88);
        EXPECT_EQUAL("its code", about.si_code, SI_TIMER);
        if (round == 0) EXPECT(timer_getoverrun(timer) >= 20, "only %d overruns counted", timer_getoverrun(timer));
    }
    return finish();
}
