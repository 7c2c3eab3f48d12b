/* Reads the clocks by the vdso's functions all the time; none may go back or leap. Argument: readings between two looks for go. */
#include "tracee.h"

#include <sys/time.h>

#define LEAP (600 * SECOND)

int main(int count, char **arguments) {
    static const clockid_t clocks[] = {CLOCK_REALTIME, CLOCK_MONOTONIC, CLOCK_REALTIME_COARSE, CLOCK_MONOTONIC_COARSE,
                                       CLOCK_BOOTTIME};
    enum { KINDS = sizeof clocks / sizeof *clocks };
    int64_t last[KINDS], leaps = 0;
    int rounds = count > 2 ? atoi(arguments[2]) : 1;
    for (int kind = 0; kind < KINDS; kind++) last[kind] = now_ns(clocks[kind]);
    ready();
    while (!is_told(arguments[1]))
        for (int round = 0; round < rounds; round++) {
            int64_t now = now_ns(CLOCK_MONOTONIC);
            leaps += now < last[1] || now > last[1] + LEAP;
            last[1] = now;
        }
    EXPECT_EQUAL("leaps of the monotonic clock", leaps, 0);
    for (int kind = 0; kind < KINDS; kind++) {
        int64_t now = now_ns(clocks[kind]);
        EXPECT(now >= last[kind] && now < last[kind] + LEAP, "clock %d went from %lld to %lld", clocks[kind],
               (long long)last[kind], (long long)now);
    }
    struct timeval day;
    gettimeofday(&day, NULL);
    int64_t second = now_ns(CLOCK_REALTIME) / SECOND;
    EXPECT(second - day.tv_sec <= 2, "gettimeofday(2) is elsewhere");
    EXPECT(second - time(NULL) <= 2, "time(2) is elsewhere");
    struct timespec fine = {1, 0};
    clock_getres(CLOCK_MONOTONIC, &fine);
    EXPECT(fine.tv_sec == 0 && fine.tv_nsec > 0, "the resolution is %ld ns", fine.tv_nsec);
    EXPECT(sched_getcpu() >= 0, "no processor");
    return finish();
}
