/* One blocking call with a limit of time, named by the second argument, captured while it waits.
 *
 * It must end by its time being over: never EINTR, never early, and not later than the limit, counted once more from
 * the restore (a relative sleep may start over, if what was left cannot be known), plus the outage.
 */
#include "tracee.h"

#include <linux/futex.h>
#include <poll.h>
#include <sys/select.h>

#define LIMIT_MS 1500

static long futex(uint32_t *word, int operation, struct timespec *limit) {
    return syscall(SYS_futex, word, operation, 0, limit, NULL, FUTEX_BITSET_MATCH_ANY);
}

static void wait_by(const char *way) {
    struct timespec limit = {LIMIT_MS / 1000, LIMIT_MS % 1000 * 1000000L}, left = {-1, -1}, until;
    struct timeval limit_us = {LIMIT_MS / 1000, LIMIT_MS % 1000 * 1000};
    uint32_t word = 0;
    int null = open("/dev/null", O_RDONLY), result = -2, wanted = 0, wanted_errno = 0;
    clockid_t clock = strstr(way, "realtime") ? CLOCK_REALTIME : CLOCK_MONOTONIC;
    clock_gettime(clock, &until);
    until.tv_nsec += limit.tv_nsec, until.tv_sec += limit.tv_sec + until.tv_nsec / SECOND, until.tv_nsec %= SECOND;
    sigset_t none;
    sigemptyset(&none);
    errno = 0;
    if (!strcmp(way, "nanosleep")) result = nanosleep(&limit, &left);
    if (!strcmp(way, "nanosleep_no_rest")) result = nanosleep(&limit, NULL);
    if (!strcmp(way, "clock_relative")) result = clock_nanosleep(CLOCK_MONOTONIC, 0, &limit, NULL);
    if (!strcmp(way, "clock_boottime")) result = clock_nanosleep(CLOCK_BOOTTIME, 0, &limit, NULL);
    if (!strcmp(way, "absolute_monotonic")) result = clock_nanosleep(clock, TIMER_ABSTIME, &until, NULL);
    if (!strcmp(way, "absolute_realtime")) result = clock_nanosleep(clock, TIMER_ABSTIME, &until, NULL);
    if (!strcmp(way, "poll")) result = poll(NULL, 0, LIMIT_MS);
    if (!strcmp(way, "poll_file")) result = poll(&(struct pollfd){.fd = null, .events = 0}, 1, LIMIT_MS);
    if (!strcmp(way, "ppoll")) result = ppoll(NULL, 0, &limit, &none);
    if (!strcmp(way, "select")) result = select(0, NULL, NULL, NULL, &limit_us);
    if (!strcmp(way, "pselect")) result = pselect(0, NULL, NULL, NULL, &limit, &none);
    if (!strncmp(way, "futex", 5)) wanted = -1, wanted_errno = ETIMEDOUT;
    if (!strcmp(way, "futex")) result = futex(&word, FUTEX_WAIT, &limit);
    if (!strcmp(way, "futex_bitset")) result = futex(&word, FUTEX_WAIT_BITSET, &until);
    if (!strcmp(way, "futex_realtime"))
        result = futex(&word, FUTEX_WAIT_BITSET | FUTEX_CLOCK_REALTIME | FUTEX_PRIVATE_FLAG, &until);
    if (result == -2) cannot("wait by %s", way);
    EXPECT(result == wanted && errno == wanted_errno, "%s returned %d: %s", way, result, strerror(errno));
    close(null);
}

int main(int count, char **arguments) {
    const char *way = count > 2 ? arguments[2] : "nanosleep";
    int64_t start = now_ns(CLOCK_MONOTONIC);
    ready();
    wait_by(way);
    int64_t waited_ms = (now_ns(CLOCK_MONOTONIC) - start) / 1000000;
    EXPECT(waited_ms >= LIMIT_MS - 5, "%s waited only %lld ms", way, (long long)waited_ms);
    EXPECT(waited_ms < LIMIT_MS + 20000, "%s waited %lld ms", way, (long long)waited_ms);
    fprintf(stderr, "%s waited %lld ms\n", way, (long long)waited_ms);
    return finish();
}
