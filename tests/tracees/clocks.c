/* Clocks read through the vdso: never back, and the same as the kernel's own answer. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    const clockid_t clocks[] = {CLOCK_REALTIME, CLOCK_MONOTONIC, CLOCK_BOOTTIME, CLOCK_MONOTONIC_RAW,
                                CLOCK_MONOTONIC_COARSE, CLOCK_PROCESS_CPUTIME_ID};
    enum { KINDS = sizeof clocks / sizeof *clocks };
    int64_t last[KINDS] = {0}, steps = 0;
    ready();
    do {
        for (int kind = 0; kind < KINDS - 1; kind++) { /* processor time starts over: known */
            int64_t now = now_ns(clocks[kind]);
            if (now < last[kind] && clocks[kind] != CLOCK_REALTIME)
                differs("clock %d went back by %lld ns", clocks[kind], (long long)(last[kind] - now));
            last[kind] = now;
        }
    } while (++steps % 1000 || !is_told(arguments[1]));
    for (int kind = 0; kind < KINDS - 1; kind++) {
        struct timespec kernel;
        int64_t before = now_ns(clocks[kind]);
        syscall(SYS_clock_gettime, clocks[kind], &kernel);
        int64_t between = kernel.tv_sec * SECOND + kernel.tv_nsec, after = now_ns(clocks[kind]);
        EXPECT(before <= between && between <= after, "clock %d: vdso and kernel disagree", clocks[kind]);
    }
    return finish();
}
