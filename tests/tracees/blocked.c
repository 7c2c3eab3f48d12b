/* Threads that each wait in another system call; once told, the first one ends every wait, and each looks at what it was answered.
 *
 * The calls go through syscall(2), whose number is loaded from a register: it cannot be read from the code in front of it.
 */
#include "tracee.h"

#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/msg.h>
#include <sys/sem.h>
#include <sys/socket.h>
#include <sys/timerfd.h>

#define LONG_S 1000
#define NOT_YET -77

struct message {
    long kind;
    char text[8];
};

static int word, timed_word, locked_word, vector_word, channel[2], source[2], drain[2], pair[2], counter, epoll, clock_fd;
static int lock_held, lock_wanted, queue, semaphores;
static const struct timespec long_limit = {LONG_S, 0};

static long wait_on_word(void) { return syscall(SYS_futex, &word, FUTEX_WAIT, 0, NULL, NULL, 0); }
static void wake_word(void) { syscall(SYS_futex, &word, FUTEX_WAKE, 1, NULL, NULL, 0); }

static long wait_with_limit(void) { return syscall(SYS_futex, &timed_word, FUTEX_WAIT_PRIVATE, 0, &long_limit, NULL, 0); }
static void wake_timed(void) { syscall(SYS_futex, &timed_word, FUTEX_WAKE_PRIVATE, 1, NULL, NULL, 0); }

static long lock_with_inheritance(void) { return syscall(SYS_futex, &locked_word, FUTEX_LOCK_PI_PRIVATE, 0, NULL, NULL, 0); }
static void unlock_with_inheritance(void) { syscall(SYS_futex, &locked_word, FUTEX_UNLOCK_PI_PRIVATE, 0, NULL, NULL, 0); }

static long wait_on_several(void) {
    struct {
        uint64_t value, address;
        uint32_t flags, reserved;
    } waiters[1] = {{0, (uint64_t)&vector_word, 2 | FUTEX_PRIVATE_FLAG, 0}};
    return syscall(449, waiters, 1, 0, NULL, CLOCK_MONOTONIC);
}
static void wake_several(void) { syscall(SYS_futex, &vector_word, FUTEX_WAKE_PRIVATE, 1, NULL, NULL, 0); }

static long read_pipe(void) {
    char byte;
    return syscall(SYS_read, channel[0], &byte, 1);
}
static void write_pipe(void) { EXPECT_EQUAL("written", write(channel[1], "x", 1), 1); }

static long splice_pipes(void) { return syscall(SYS_splice, source[0], NULL, drain[1], NULL, 10, 0); }
static void fill_source(void) { EXPECT_EQUAL("written", write(source[1], "abc", 3), 3); }

static long receive(void) {
    char bytes[4];
    return syscall(SYS_recvfrom, pair[0], bytes, 4, 0, NULL, NULL);
}
static void send_two(void) { EXPECT_EQUAL("sent", send(pair[1], "ab", 2, 0), 2); }

static long read_counter(void) {
    uint64_t value = 0;
    return syscall(SYS_read, counter, &value, 8) == 8 ? (long)value : -1;
}
static void count(void) { eventfd_write(counter, 5); }

static long read_clock(void) {
    uint64_t value = 0;
    return syscall(SYS_read, clock_fd, &value, 8) == 8 ? (long)value : -1;
}
static void arm_clock(void) {
    struct itimerspec soon = {.it_value = {0, 1000}};
    timerfd_settime(clock_fd, 0, &soon, NULL);
}

static long wait_for_events(void) {
    struct epoll_event event;
    return syscall(SYS_epoll_pwait, epoll, &event, 1, -1, NULL, 8) == 1 ? (long)event.data.u32 : -1;
}
static void make_event(void) { EXPECT_EQUAL("sent", send(pair[0], "ab", 2, 0), 2); }

static long take_lock(void) { return syscall(SYS_flock, lock_wanted, LOCK_EX); }
static void give_lock(void) { flock(lock_held, LOCK_UN); }

static long take_message(void) {
    struct message message;
    return syscall(SYS_msgrcv, queue, &message, sizeof message.text, 0, 0);
}
static void put_message(void) {
    struct message message = {1, "hi"};
    msgsnd(queue, &message, sizeof message.text, 0);
}

static long take_semaphore(void) {
    struct sembuf down = {0, -1, 0};
    return syscall(SYS_semtimedop, semaphores, &down, 1, NULL);
}
static void give_semaphore(void) {
    struct sembuf up = {0, 1, 0};
    semop(semaphores, &up, 1);
}

static struct wait {
    const char *name;
    long (*begin)(void);
    void (*end)(void);
    long wanted;
    volatile long answer;
    volatile pid_t tid;
    pthread_t thread;
} waits[] = {
    {"futex", wait_on_word, wake_word, 0, NOT_YET, 0, 0},
    {"futex with a limit", wait_with_limit, wake_timed, 0, NOT_YET, 0, 0},
    {"futex with priority inheritance", lock_with_inheritance, unlock_with_inheritance, 0, NOT_YET, 0, 0},
    {"futex_waitv", wait_on_several, wake_several, 0, NOT_YET, 0, 0},
    {"read of a pipe", read_pipe, write_pipe, 1, NOT_YET, 0, 0},
    {"splice", splice_pipes, fill_source, 3, NOT_YET, 0, 0},
    {"recv", receive, send_two, 2, NOT_YET, 0, 0},
    {"read of an eventfd", read_counter, count, 5, NOT_YET, 0, 0},
    {"read of a timerfd", read_clock, arm_clock, 1, NOT_YET, 0, 0},
    {"epoll_wait", wait_for_events, make_event, 7, NOT_YET, 0, 0},
    {"flock", take_lock, give_lock, 0, NOT_YET, 0, 0},
    {"msgrcv", take_message, put_message, 8, NOT_YET, 0, 0},
    {"semtimedop", take_semaphore, give_semaphore, 0, NOT_YET, 0, 0},
};
#define WAITS (sizeof waits / sizeof *waits)

static void *carry_out(void *argument) {
    struct wait *wait = argument;
    wait->tid = gettid();
    wait->answer = wait->begin();
    return NULL;
}

static void set_stage(void) {
    struct epoll_event wanted = {EPOLLIN, {.u32 = 7}};
    locked_word = gettid();
    if (pipe(channel) || pipe(source) || pipe(drain) || socketpair(AF_UNIX, SOCK_STREAM, 0, pair)) cannot("make channels");
    counter = eventfd(0, 0);
    clock_fd = timerfd_create(CLOCK_MONOTONIC, 0);
    epoll = epoll_create1(0);
    epoll_ctl(epoll, EPOLL_CTL_ADD, pair[1], &wanted);
    lock_held = open("lock", O_CREAT | O_RDWR, 0600);
    lock_wanted = open("lock", O_RDWR);
    flock(lock_held, LOCK_EX);
    queue = msgget(IPC_PRIVATE, 0600);
    semaphores = semget(IPC_PRIVATE, 1, 0600);
    if (queue < 0 || semaphores < 0) cannot("make a message queue and a semaphore");
}

/* Whether a thread sleeps in the kernel. */
static int sleeps(pid_t tid) {
    char path[64], state = 0;
    snprintf(path, sizeof path, "/proc/self/task/%d/stat", tid);
    FILE *stat = fopen(path, "r");
    if (stat && fscanf(stat, "%*d (%*[^)]) %c", &state) != 1) state = 0;
    if (stat) fclose(stat);
    return state == 'S';
}

/* Who is not answered yet sleeps: one that has just been let go may be on its way to its call, and would miss being woken. */
static void wait_until_all_sleep(void) {
    for (size_t index = 0; index < WAITS; index++)
        while (waits[index].answer == NOT_YET && (!waits[index].tid || !sleeps(waits[index].tid))) usleep(1000);
}

int main(int number, char **arguments) {
    if (number < 2) cannot("find the go file");
    set_stage();
    for (size_t index = 0; index < WAITS; index++) pthread_create(&waits[index].thread, NULL, carry_out, &waits[index]);
    wait_until_all_sleep();
    ready(), wait_for_go(arguments[1]);
    wait_until_all_sleep();
    for (size_t index = 0; index < WAITS; index++) {
        struct wait *wait = &waits[index];
        EXPECT(wait->answer == NOT_YET, "%s ended early with %ld", wait->name, wait->answer);
        wait->end();
        pthread_join(wait->thread, NULL);
        EXPECT_EQUAL(wait->name, wait->answer, wait->wanted);
    }
    msgctl(queue, IPC_RMID, NULL);
    semctl(semaphores, 0, IPC_RMID);
    return finish();
}
