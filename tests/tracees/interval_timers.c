/* setitimer: the real timer goes on ticking; virtual and profiling ones keep what was left and tick with work. */
#include "tracee.h"

#include <sys/time.h>

static volatile sig_atomic_t ticks[3];

static void count_tick(int signal_number) {
    ticks[signal_number == SIGALRM ? 0 : signal_number == SIGVTALRM ? 1 : 2]++;
}

int main(int count, char **arguments) {
    (void)count;
    static const char *const names[3] = {"real", "virtual", "profiling"};
    struct sigaction action = {.sa_handler = count_tick, .sa_flags = SA_RESTART};
    sigaction(SIGALRM, &action, NULL);
    sigaction(SIGVTALRM, &action, NULL);
    sigaction(SIGPROF, &action, NULL);
    for (int which = 0; which < 3; which++) {
        struct itimerval timer = {.it_interval = {0, 20000 + 1000 * which}, .it_value = {0, 50000}};
        setitimer(which, &timer, NULL);
    }
    ready();
    while (!is_told(arguments[1]))
        ;
    for (int which = 0; which < 3; which++) {
        struct itimerval timer;
        getitimer(which, &timer);
        EXPECT_EQUAL(names[which], timer.it_interval.tv_usec, 20000 + 1000 * which);
        EXPECT(timer.it_value.tv_usec > 0 && timer.it_value.tv_usec <= 54000, "%s: left %ld us", names[which],
               timer.it_value.tv_usec);
        ticks[which] = 0;
    }
    int64_t end = now_ns(CLOCK_MONOTONIC) + 10 * SECOND;
    while ((ticks[0] < 3 || ticks[1] < 3 || ticks[2] < 3) && now_ns(CLOCK_MONOTONIC) < end)
        ;
    for (int which = 0; which < 3; which++) EXPECT(ticks[which] >= 3, "the %s timer does not tick", names[which]);
    return finish();
}
