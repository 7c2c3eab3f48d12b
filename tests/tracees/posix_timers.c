/* timer_create: ids with gaps, clocks, signals and values, a disarmed one, and intervals that go on. */
#include "tracee.h"

static volatile sig_atomic_t ticks, wrong_value;

static void count_tick(int signal_number, siginfo_t *about, void *context) {
    (void)signal_number, (void)context;
    if (about->si_value.sival_int != 1234 || about->si_code != SI_TIMER) wrong_value = 1;
    ticks++;
}

static int create(clockid_t clock, int notify, int signal_number, int value) {
    struct sigevent event = {.sigev_notify = notify, .sigev_signo = signal_number};
    int id = -1;
    event.sigev_value.sival_int = value;
    if (notify == SIGEV_THREAD_ID) event._sigev_un._tid = gettid();
    if (syscall(SYS_timer_create, clock, &event, &id)) cannot("create a timer");
    return id;
}

int main(int count, char **arguments) {
    (void)count;
    struct sigaction action = {.sa_sigaction = count_tick, .sa_flags = SA_SIGINFO | SA_RESTART};
    sigaction(SIGRTMIN + 1, &action, NULL);
    int ids[6];
    clockid_t own; /* of processor time, by our PID */
    if (clock_getcpuclockid(getpid(), &own)) cannot("find the clock of a process");
    for (int index = 0; index < 6; index++)
        ids[index] = create(index == 2 ? CLOCK_REALTIME : index == 4 ? CLOCK_PROCESS_CPUTIME_ID : CLOCK_MONOTONIC,
                            index == 3 ? SIGEV_NONE : index == 5 ? SIGEV_THREAD_ID : SIGEV_SIGNAL, SIGRTMIN + 1, 1234);
    int counted = create(own, SIGEV_NONE, 0, 0);
    syscall(SYS_timer_delete, ids[0]);
    syscall(SYS_timer_delete, ids[1]);
    struct itimerspec often = {.it_interval = {0, 15000000}, .it_value = {0, 15000000}}, now;
    struct itimerspec long_away = {.it_value = {100, 0}};
    syscall(SYS_timer_settime, ids[2], 0, &often, NULL);
    syscall(SYS_timer_settime, ids[3], 0, &long_away, NULL);
    syscall(SYS_timer_settime, counted, 0, &long_away, NULL);
    ready();
    while (!is_told(arguments[1]))
        ; /* no nap: ticks may end one early */
    EXPECT(syscall(SYS_timer_gettime, ids[0], &now) == -1, "a deleted timer is back");
    EXPECT(syscall(SYS_timer_gettime, ids[2], &now) == 0, "the ticking timer is gone");
    EXPECT_EQUAL("its interval", now.it_interval.tv_nsec, 15000000);
    EXPECT(syscall(SYS_timer_gettime, ids[3], &now) == 0, "the silent timer is gone");
    EXPECT(now.it_value.tv_sec <= 100 && now.it_value.tv_sec >= 60, "silent timer: %ld s left", now.it_value.tv_sec);
    EXPECT(syscall(SYS_timer_gettime, ids[4], &now) == 0, "the disarmed timer is gone");
    EXPECT(now.it_value.tv_sec == 0 && now.it_value.tv_nsec == 0, "the disarmed timer is armed");
    EXPECT(syscall(SYS_timer_gettime, counted, &now) == 0, "the timer of processor time is gone");
    EXPECT(now.it_value.tv_sec <= 100 && now.it_value.tv_sec >= 10, "timer of processor time: %ld s left", now.it_value.tv_sec);
    ticks = 0;
    int64_t end = now_ns(CLOCK_MONOTONIC) + 10 * SECOND;
    while (ticks < 3 && now_ns(CLOCK_MONOTONIC) < end)
        ;
    EXPECT(ticks >= 3, "the timer does not tick");
    struct itimerspec off = {0};
    syscall(SYS_timer_settime, ids[2], 0, &off, NULL);
    for (int index = 4; index < 6; index++) {
        ticks = 0;
        syscall(SYS_timer_settime, ids[index], 0, &often, NULL);
        end = now_ns(CLOCK_MONOTONIC) + 10 * SECOND;
        while (ticks < 1 && now_ns(CLOCK_MONOTONIC) < end)
            ;
        EXPECT(ticks >= 1, "timer %d cannot be armed again", index);
        syscall(SYS_timer_settime, ids[index], 0, &off, NULL);
    }
    EXPECT(!wrong_value, "a tick carried a wrong value or code");
    int next = create(CLOCK_MONOTONIC, SIGEV_NONE, 0, 0);
    EXPECT(next > counted, "a new timer got id %d, the last one had %d", next, counted);
    return finish();
}
