/* A one-shot alarm of 40 s and an armed POSIX timer of 50 s: what was left goes on running down, from there. */
#include "tracee.h"

#include <sys/time.h>

int main(int count, char **arguments) {
    (void)count;
    struct itimerval alarm_timer = {.it_value = {40, 0}};
    struct itimerspec left, posix = {.it_value = {50, 0}};
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGUSR2};
    timer_t timer;
    signal(SIGALRM, SIG_IGN);
    if (timer_create(CLOCK_MONOTONIC, &event, &timer)) cannot("create a timer");
    setitimer(ITIMER_REAL, &alarm_timer, NULL);
    timer_settime(timer, 0, &posix, NULL);
    int64_t start = now_ns(CLOCK_MONOTONIC);
    ready();
    wait_for_go(arguments[1]);
    int64_t passed = (now_ns(CLOCK_MONOTONIC) - start) / 1000000;
    getitimer(ITIMER_REAL, &alarm_timer);
    timer_gettime(timer, &left);
    long alarm_ms = alarm_timer.it_value.tv_sec * 1000 + alarm_timer.it_value.tv_usec / 1000;
    long posix_ms = left.it_value.tv_sec * 1000 + left.it_value.tv_nsec / 1000000;
    /* The outage may be counted or not; more than before, or much less than the clock says, is wrong. */
    EXPECT(alarm_ms <= 40000 && alarm_ms >= 40000 - passed - 200, "alarm: %ld ms left after %lld", alarm_ms,
           (long long)passed);
    EXPECT(posix_ms <= 50000 && posix_ms >= 50000 - passed - 200, "timer: %ld ms left after %lld", posix_ms,
           (long long)passed);
    return finish();
}
