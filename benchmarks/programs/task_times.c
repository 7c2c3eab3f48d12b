/* How late an activation begins: TASK PERIOD_NS COUNT, or "-" for a bare clock_nanosleep. One line an activation: ns. */
#include "failover_task.h"

int main(int count, char **words)
{
    ft_terms terms;
    ft_tick tick;
    ft_task *task = NULL;
    int64_t period, turns, due;
    if (count != 4)
        return 2;
    period = atoll(words[2]);
    turns = atoll(words[3]);
    memset(&terms, 0, sizeof terms);
    terms.period_ns = period;
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    if (strcmp(words[1], "-") != 0 && (task = ft_begin(NULL, words[1], &terms)) == NULL) {
        fprintf(stderr, "%s\n", fb_error());
        return 1;
    }
    due = fb_clock_(CLOCK_MONOTONIC) / period * period;
    for (int64_t turn = 0; turn < turns; turn++) {
        if (task != NULL) {
            if (ft_wait(task, &tick) != 0)
                return 1;
            printf("%lld\n", (long long)(fb_clock_(CLOCK_MONOTONIC) - tick.due_ns));
        } else {
            struct timespec limit;
            due += period;
            limit.tv_sec = (time_t)(due / 1000000000);
            limit.tv_nsec = (long)(due % 1000000000);
            clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &limit, NULL);
            printf("%lld\n", (long long)(fb_clock_(CLOCK_MONOTONIC) - due));
        }
    }
    ft_close(task);
    return 0;
}
