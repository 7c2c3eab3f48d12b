/* One timer of a kind: created by timer_create or timerfd_create, on a clock, relative or absolute; it goes off when it is due.
 *
 * Arguments: go, "timer" or "descriptor", the clock's number, "relative" or "absolute".
 */
#include "tracee.h"

#include <poll.h>
#include <sys/timerfd.h>

#define DUE (700 * 1000000LL)    /* after the start */
#define WORKED (100 * 1000000LL) /* of processor time, before the capture */

static clockid_t kind;
static volatile sig_atomic_t went_off;

static void note(int signal_number) {
    (void)signal_number;
    went_off = 1;
}

static int counts_work(void) { return kind == CLOCK_PROCESS_CPUTIME_ID || kind == CLOCK_THREAD_CPUTIME_ID; }

static struct itimerspec setting(int64_t when) {
    return (struct itimerspec){.it_value = {.tv_sec = when / SECOND, .tv_nsec = when % SECOND}};
}

static int64_t left_ns(int timer) {
    struct itimerspec now;
    syscall(SYS_timer_gettime, timer, &now);
    return now.it_value.tv_sec * SECOND + now.it_value.tv_nsec;
}

/* Wait, or work where work is what is counted. */
static void pass(int descriptor) {
    if (counts_work()) return;
    struct pollfd event = {.fd = descriptor, .events = POLLIN};
    if (poll(&event, descriptor >= 0 ? 1 : 0, 2) == 1) went_off = 1;
}

int main(int count, char **arguments) {
    if (count < 5) return 2;
    int is_descriptor = !strcmp(arguments[2], "descriptor"), is_absolute = !strcmp(arguments[4], "absolute");
    kind = atoi(arguments[3]);
    struct sigaction action = {.sa_handler = note, .sa_flags = SA_RESTART};
    sigaction(SIGRTMIN + 3, &action, NULL);
    int timer = -1, descriptor = -1;
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGRTMIN + 3};
    if (is_descriptor ? (descriptor = timerfd_create(kind, 0)) < 0 : syscall(SYS_timer_create, kind, &event, &timer) != 0)
        cannot("create a timer of clock %d", kind);
    int64_t began = now_ns(kind), started = now_ns(CLOCK_REALTIME);
    struct itimerspec due = setting(is_absolute ? began + DUE : DUE);
    if (is_descriptor ? timerfd_settime(descriptor, is_absolute ? TFD_TIMER_ABSTIME : 0, &due, NULL)
                      : syscall(SYS_timer_settime, timer, is_absolute ? TIMER_ABSTIME : 0, &due, NULL))
        cannot("arm a timer of clock %d", kind);
    while (counts_work() && now_ns(kind) < began + WORKED)
        ;
    int64_t left = counts_work() ? left_ns(timer) : 0;
    EXPECT(!counts_work() || (left > 0 && left <= DUE - WORKED + SECOND / 50), "%lld ns were left from the beginning", (long long)left);
    ready();
    while (!is_told(arguments[1])) pass(-1);
    if (counts_work()) { /* the processor time of a restored program begins anew; what was left does not */
        int64_t now_left = left_ns(timer), until = now_ns(kind) + now_left;
        EXPECT(went_off || now_left <= left, "%lld ns are left, %lld were", (long long)now_left, (long long)left);
        while (!went_off && now_ns(kind) < until + 10 * SECOND)
            ;
        EXPECT(went_off, "it never goes off");
        EXPECT(now_ns(kind) + SECOND / 50 >= until, "it went off %lld ns early", (long long)(until - now_ns(kind)));
    } else {
        while (!went_off && now_ns(CLOCK_REALTIME) < started + DUE + 30 * SECOND) pass(descriptor);
        int64_t after = now_ns(CLOCK_REALTIME) - started;
        EXPECT(went_off, "it never goes off");
        EXPECT(after + SECOND / 50 >= DUE, "it went off %lld ns after the start", (long long)after);
    }
    return finish();
}
