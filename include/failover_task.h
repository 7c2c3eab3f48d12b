/* failover_task.h: a task of this robot's schedule, from C or C++. One header besides failover_board.h; needs libc and Linux.
 *
 *     const ft_terms terms = {.period_ns = 50000000, .deadline_ns = 40000000, .after = {"odometry"}};
 *     ft_task *mapper = ft_begin(NULL, "mapper", &terms);
 *     ft_tick tick;
 *     while (ft_wait(mapper, &tick) == 0)                     an activation; it ends at the next ft_wait(), or ft_end()
 *         ...
 *     ft_close(mapper);
 *
 * A task computes its instants itself, from a table that all tasks of the robot share, and sleeps by one futex call: no other process
 * stands between the clock and an activation. failover/core/schedule/SCHEDULE.md says what the bytes are, activation.py what the rules
 * are; docs/tasks.md is the manual.
 *
 * Functions that return int return a negative errno when they fail, ft_begin() returns NULL and sets errno; fb_error() then says why in a
 * sentence. Nothing here prints or aborts. One thread uses one task. A forked child runs no task of its parent.
 *
 * SPDX-License-Identifier: MIT */

#ifndef FAILOVER_TASK_H
#define FAILOVER_TASK_H

#include "failover_board.h"

#include <sys/prctl.h>

#ifdef __cplusplus
extern "C" {
#endif

/* --- The contract --------------------------------------------------------------------------------------------------------------- */

typedef struct ft_task ft_task;

enum { FT_SKIP = 0, FT_QUEUE = 1, FT_CATCH_UP = 2 }; /* what becomes of activations that fall due while one is under way */
enum { FT_AFTER_MAX = 16 };
enum { FT_LEARN = 0, FT_AT_INSTANT = -1, FT_EARLY_MAX = 1000000 }; /* how early a task wakes */

/* All that is 0 has its default. */
typedef struct ft_terms {
    int64_t period_ns;   /* 100 µs to 10^6 s; 0: the task runs once, at `at_ns` */
    int64_t phase_ns;    /* from the schedule's origin to the first activation; taken modulo the period */
    int64_t deadline_ns; /* from due to ended; 0: the period */
    int64_t at_ns;       /* of a task that runs once: ns of CLOCK_MONOTONIC, as this process reads it */
    int64_t budget_ns;   /* what an activation may take of a processor */
    int overrun;         /* FT_SKIP … */
    bool is_strict;      /* a predecessor that does not run holds this task for ever, not until its deadline */
    const char *after[FT_AFTER_MAX]; /* predecessors, by name; NULL after the last */
    int64_t early_ns; /* wake so long before the instant, up to FT_EARLY_MAX, and be busy until it has come; FT_LEARN: as early as the
                         wake-ups of this task have been late, at most 0.2 ms and a fiftieth of its period; FT_AT_INSTANT: not at all */
} ft_terms;

/* An activation that begins. */
typedef struct ft_tick {
    uint64_t number;
    int64_t due_ns;  /* CLOCK_MONOTONIC, as this process reads it */
    int64_t late_ns; /* from then to its beginning */
    uint64_t missed; /* activations that were not run since the one before */
} ft_tick;

/* Run a task in this thread. `directory`: of the board; NULL: as fb_open(). `terms` NULL: the task is declared already. NULL on failure:
 * EBUSY: another process runs it. ENOENT: it is not declared. EINVAL: its terms cannot be. ELOOP: tasks would wait for one another. */
static inline ft_task *ft_begin(const char *directory, const char *name, const ft_terms *terms);

/* End the activation under way, if one is, and sleep until the next begins: 0. 1: there is none, the task has run once or was removed. */
static inline int ft_wait(ft_task *task, ft_tick *tick);

/* The activation under way has ended: 0. */
static inline int ft_end(ft_task *task);

/* Run the task no more; it stays on the schedule, idle. NULL is allowed. */
static inline void ft_close(ft_task *task);

/* --- Bytes (SCHEDULE.md) ------------------------------------------------------------------------------------------------------------ */

#define FT_PLACE_ "failover-schedule"
#define FT_MAGIC_ "\x89" "FOSCH\r\n"

enum {
    FT_TASKS_MAX_ = 256,
    FT_ROWS_AT_ = 4096,
    FT_ROW_SIZE_ = 2048,
    FT_FILE_SIZE_ = FT_ROWS_AT_ + FT_TASKS_MAX_ * FT_ROW_SIZE_,
    FT_ORIGIN_AT_ = 56,
    FT_SERIAL_ = 4, /* in a row */
    FT_SUCCESSORS_ = 8,
    FT_MODES_ = 12,
    FT_NAME_ = 16,
    FT_NAME_MAX_ = 200,
    FT_NAME_ROOM_ = 240,
    FT_TERMS_ = 256,
    FT_TERMS_ROOM_ = 256,
    FT_LIVE_ = 768,
    FT_SETTLED_ = 776,
    FT_NUMBER_ = 784,
    FT_STARTED_ = 792,
    FT_DUE_ = 800,
    FT_STARTED_NS_ = 808,
    FT_ENDED_NS_ = 816,
    FT_LIMIT_ = 824,
    FT_ENDED_ = 832,
    FT_MISSES_ = 840,
    FT_OVERRUNS_ = 848,
    FT_SKIPPED_ = 856,
    FT_ORPHANED_ = 864,
    FT_BLAMED_ = 872,
    FT_ADOPTED_ = 876,
    FT_COURSE_NUMBER_ = 880,
    FT_COURSES_ = 888,
    FT_LISTENERS_ = 936,
    FT_LATENESS_ = 1536,
    FT_DURATION_ = 1792,
    FT_DECLARED_ = 1,
    FT_STRICT_ = 1,
    FT_AT_NEXT_ = 2,
    FT_PERIODIC_ = 0,
    FT_ONE_SHOT_ = 1,
    FT_IDLE_ = 0,
    FT_WAITING_ = 1,
    FT_HELD_ = 2,
    FT_RUNNING_ = 3,
    FT_DONE_ = 4,
    FT_PERIOD_MIN_NS_ = 100000,
    FT_LEARNT_NS_MAX_ = 200000, /* as in failover/schedule/task.py */
    FT_LEARNT_SHARE_ = 50,
    FT_LEARNT_MARGIN_NS_ = 20000,
    FT_LEARNT_WEIGHT_ = 8
};

#define FT_PERIOD_MAX_NS_ INT64_C(1000000000000000)
#define FT_ROW_LOCKS_ ((int64_t)1 << 41)

typedef struct ft_bank_ {
    uint32_t flags, unused;
    uint64_t period, phase, deadline, at, distance, budget, cpus;
    int32_t priority;
    uint16_t mode, kind, overrun, count, after[FT_AFTER_MAX];
    uint32_t rest;
} ft_bank_;

typedef char ft_bank_has_112_bytes_[sizeof(ft_bank_) == 112 ? 1 : -1]; /* 108, and four that are zero */

typedef struct ft_course_ {
    uint64_t number;
    int64_t anchor, period;
} ft_course_;

struct ft_task {
    fb_board *board;
    unsigned char *map;
    char directory[PATH_MAX], *chosen;
    int file;
    pid_t pid;
    uint32_t row, adopted;
    int64_t skew;
    char name[FT_NAME_MAX_ + 1];
    ft_terms wanted;
    char *after[FT_AFTER_MAX];
    bool is_at_agents, is_declared, is_known, has_ordered, is_missed;
    int state;
    ft_bank_ terms, ordered;
    ft_course_ course;
    uint64_t number, counted, skipped;
    int64_t limit, started_ns, early, asked;
};

static inline unsigned char *ft_row_(unsigned char *map, uint32_t row) { return map + FT_ROWS_AT_ + (size_t)row * FT_ROW_SIZE_; }

static inline uint32_t *ft_half_(unsigned char *at) { return (uint32_t *)(void *)at; }

static inline uint64_t *ft_word_(unsigned char *at) { return (uint64_t *)(void *)at; }

static inline uint32_t ft_load_(unsigned char *at) { return __atomic_load_n(ft_half_(at), __ATOMIC_ACQUIRE); }

static inline uint64_t ft_load_word_(unsigned char *at) { return __atomic_load_n(ft_word_(at), __ATOMIC_ACQUIRE); }

static inline void ft_store_(unsigned char *at, uint32_t half) { __atomic_store_n(ft_half_(at), half, __ATOMIC_RELEASE); }

static inline void ft_store_word_(unsigned char *at, uint64_t word) { __atomic_store_n(ft_word_(at), word, __ATOMIC_RELEASE); }

static inline void ft_add_(unsigned char *at, uint64_t more) { ft_store_word_(at, ft_load_word_(at) + more); }

static inline void ft_count_(unsigned char *histogram, int64_t ns)
{
    unsigned bucket = ns <= 0 ? 0 : 64 - (unsigned)__builtin_clzll((unsigned long long)ns);
    unsigned char *at = histogram + 4 * (bucket > 63 ? 63 : bucket);
    ft_store_(at, ft_load_(at) + 1);
}

/* Sleep until woken, or an instant of this process's CLOCK_MONOTONIC, while the word has this value. */
static inline void ft_sleep_(unsigned char *word, uint32_t value, int64_t instant)
{
    struct timespec limit;
    instant = instant < 0 ? 0 : instant;
    limit.tv_sec = (time_t)(instant / 1000000000);
    limit.tv_nsec = (long)(instant % 1000000000);
    syscall(SYS_futex, word, 9 /* FUTEX_WAIT_BITSET */, value, &limit, NULL, ~0U);
}

/* --- Instants (course.py) ------------------------------------------------------------------------------------------------------------- */

static inline int64_t ft_due_(const ft_course_ *course, uint64_t number)
{
    return course->anchor + (int64_t)(number - course->number) * course->period;
}

/* The newest activation due at an instant or before, plus one. */
static inline uint64_t ft_covering_next_(const ft_course_ *course, int64_t instant)
{
    if (instant < course->anchor)
        return course->number;
    return course->number + 1 + (course->period > 0 ? (uint64_t)((instant - course->anchor) / course->period) : 0);
}

/* The first activation due at an instant or after. */
static inline uint64_t ft_first_from_(const ft_course_ *course, int64_t instant)
{
    if (instant <= course->anchor || course->period <= 0)
        return course->number;
    return course->number + (uint64_t)((instant - course->anchor + course->period - 1) / course->period);
}

static inline ft_course_ ft_first_course_(const ft_bank_ *terms, int64_t origin)
{
    ft_course_ course = {0, (int64_t)terms->at, 0};
    if (terms->kind == FT_PERIODIC_) {
        course.anchor = origin + (int64_t)terms->phase;
        course.period = (int64_t)terms->period;
    }
    return course;
}

/* --- Rows ----------------------------------------------------------------------------------------------------------------------------- */

/* The newest order of a row: its serial; 0 and errno EBADMSG where its terms are damaged. */
static inline int ft_read_terms_(unsigned char *map, uint32_t row, ft_bank_ *terms, uint32_t *serial)
{
    unsigned char *at = ft_row_(map, row);
    for (int turn = 0; turn < FB_RETRIES_; turn++) {
        *serial = ft_load_(at + FT_SERIAL_);
        memcpy(terms, at + FT_TERMS_ + (size_t)(*serial % 2) * FT_TERMS_ROOM_, sizeof *terms);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        if (ft_load_(at + FT_SERIAL_) == *serial)
            break;
    }
    if (terms->period > (uint64_t)FT_PERIOD_MAX_NS_ || terms->deadline > (uint64_t)FT_PERIOD_MAX_NS_ || terms->at > INT64_MAX ||
        terms->kind > 2 || terms->overrun > FT_CATCH_UP || terms->count > FT_AFTER_MAX ||
        (terms->kind == FT_PERIODIC_ && (terms->period < FT_PERIOD_MIN_NS_ || terms->phase >= terms->period)))
        return fb_fail_(EBADMSG, "damaged: row %u of the schedule: its terms cannot be", row);
    for (int place = 0; place < terms->count; place++)
        if (terms->after[place] >= FT_TASKS_MAX_)
            return fb_fail_(EBADMSG, "damaged: row %u of the schedule runs after a row that is not there", row);
    return 0;
}

static inline ft_course_ ft_read_course_(unsigned char *map, uint32_t row)
{
    unsigned char *at = ft_row_(map, row);
    ft_course_ course;
    for (int turn = 0; turn < FB_RETRIES_; turn++) {
        uint32_t newest = ft_load_(at + FT_COURSE_NUMBER_);
        unsigned char *bank = at + FT_COURSES_ + (size_t)(newest % 2) * 24;
        course.number = ft_load_word_(bank);
        course.anchor = (int64_t)ft_load_word_(bank + 8);
        course.period = (int64_t)ft_load_word_(bank + 16);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        if (ft_load_(at + FT_COURSE_NUMBER_) == newest)
            break;
    }
    return course;
}

static inline bool ft_is_declared_(unsigned char *map, uint32_t row) { return (ft_load_(ft_row_(map, row)) & FT_DECLARED_) != 0; }

static inline bool ft_is_named_(unsigned char *map, uint32_t row, const char *name)
{
    return strncmp((const char *)ft_row_(map, row) + FT_NAME_, name, FT_NAME_ROOM_) == 0;
}

/* The row of a name; a row that is not in use where there is none; FT_TASKS_MAX_: the table is full. The table lock is held. */
static inline uint32_t ft_place_(ft_task *task, const char *name)
{
    bool is_used[FT_TASKS_MAX_] = {false};
    for (uint32_t row = 0; row < FT_TASKS_MAX_; row++)
        if (name[0] != '\0' && ft_is_named_(task->map, row, name))
            return row;
    for (uint32_t row = 0; row < FT_TASKS_MAX_; row++)
        if (ft_row_(task->map, row)[FT_NAME_] == '\0')
            return row;
    for (uint32_t row = 0; row < FT_TASKS_MAX_; row++) {
        ft_bank_ terms;
        uint32_t serial;
        is_used[row] |= ft_is_declared_(task->map, row) || fb_is_taken_(task->file, FT_ROW_LOCKS_ + row, 1);
        if (ft_is_declared_(task->map, row) && ft_read_terms_(task->map, row, &terms, &serial) == 0)
            for (int place = 0; place < terms.count; place++)
                is_used[terms.after[place]] = true;
    }
    for (uint32_t row = 0; row < FT_TASKS_MAX_; row++)
        if (!is_used[row])
            return row;
    return FT_TASKS_MAX_;
}

/* Give a row a name, unless it has that one: it begins anew. */
static inline void ft_name_(ft_task *task, uint32_t row, const char *name)
{
    unsigned char *at = ft_row_(task->map, row);
    if (ft_is_named_(task->map, row, name))
        return;
    ft_store_(at, 0);
    memset(at + FT_LIVE_, 0, FT_ROW_SIZE_ - FT_LIVE_);
    memset(at + FT_NAME_, 0, FT_NAME_ROOM_);
    memcpy(at + FT_NAME_, name, strlen(name));
}

/* Whether `row` is reached from `from` by way of predecessors; `seen`: rows that were followed already. */
static inline bool ft_reaches_(ft_task *task, uint32_t from, uint32_t row, bool *seen)
{
    ft_bank_ terms;
    uint32_t serial;
    if (from == row)
        return true;
    if (seen[from] || !ft_is_declared_(task->map, from) || ft_read_terms_(task->map, from, &terms, &serial) != 0)
        return false;
    seen[from] = true;
    for (int place = 0; place < terms.count; place++)
        if (ft_reaches_(task, terms.after[place], row, seen))
            return true;
    return false;
}

static inline int ft_examined_(const ft_task *task)
{
    const ft_terms *wanted = &task->wanted;
    const int64_t times[] = {wanted->period_ns, wanted->phase_ns, wanted->deadline_ns, wanted->budget_ns};
    for (unsigned place = 0; place < 4; place++)
        if (times[place] < 0 || times[place] > FT_PERIOD_MAX_NS_)
            return fb_fail_(EINVAL, "cannot schedule %s: a time of %lld ns; 0 to 1,000,000 s are possible", task->name, (long long)times[place]);
    if (wanted->period_ns != 0 && wanted->period_ns < FT_PERIOD_MIN_NS_)
        return fb_fail_(EINVAL, "cannot schedule %s: a period of %lld ns; 100 µs to 1,000,000 s are possible", task->name, (long long)wanted->period_ns);
    if (wanted->period_ns != 0 && wanted->deadline_ns > wanted->period_ns && wanted->overrun == FT_SKIP)
        return fb_fail_(EINVAL, "cannot schedule %s: its deadline is longer than its period, and what falls due meanwhile is skipped; take FT_QUEUE, "
                                "or a shorter deadline", task->name);
    if (wanted->early_ns < FT_AT_INSTANT || wanted->early_ns > FT_EARLY_MAX)
        return fb_fail_(EINVAL, "cannot schedule %s: early_ns %lld; 1 to %d, FT_LEARN and FT_AT_INSTANT are possible", task->name,
                        (long long)wanted->early_ns, FT_EARLY_MAX);
    if (wanted->overrun < FT_SKIP || wanted->overrun > FT_CATCH_UP || wanted->at_ns < 0)
        return fb_fail_(EINVAL, "cannot schedule %s: overrun %d, at_ns %lld", task->name, wanted->overrun, (long long)wanted->at_ns);
    for (int place = 0; place < FT_AFTER_MAX && wanted->after[place] != NULL; place++)
        if (wanted->after[place][0] == '\0' || strlen(wanted->after[place]) > FT_NAME_MAX_ || strcmp(wanted->after[place], task->name) == 0)
            return fb_fail_(EINVAL, "cannot schedule %s: its predecessor %.200s cannot be", task->name, wanted->after[place]);
    return 0;
}

static inline int ft_taken_(const ft_task *task, uint32_t row)
{
    return fb_fail_(EBUSY, "task %s is run by pid %u already; end that one, or choose another name", task->name,
                    ft_load_(ft_row_(task->map, row) + FT_LIVE_ + 4));
}

/* Declare the task; the table lock is held, and the generation odd. */
static inline int ft_declare_(ft_task *task)
{
    ft_bank_ terms, before;
    uint32_t serial = 0;
    const ft_terms *wanted = &task->wanted;
    uint32_t row = ft_place_(task, task->name);
    unsigned char *at;
    if (row == FT_TASKS_MAX_)
        return fb_fail_(ENOSPC, "cannot add task %s: the schedule has %d, and no room for more; remove some", task->name, FT_TASKS_MAX_);
    if (ft_is_named_(task->map, row, task->name) && ft_is_declared_(task->map, row) && !fb_take_(task->file, FT_ROW_LOCKS_ + row))
        return ft_taken_(task, row);
    memset(&terms, 0, sizeof terms);
    terms.flags = wanted->is_strict ? FT_STRICT_ : 0;
    terms.kind = wanted->period_ns != 0 ? FT_PERIODIC_ : FT_ONE_SHOT_;
    terms.period = (uint64_t)wanted->period_ns;
    terms.phase = wanted->period_ns != 0 ? (uint64_t)(wanted->phase_ns % wanted->period_ns) : 0;
    terms.deadline = (uint64_t)(wanted->deadline_ns != 0 ? wanted->deadline_ns : wanted->period_ns);
    terms.at = wanted->period_ns != 0 ? 0 : (uint64_t)(wanted->at_ns - task->skew > 0 ? wanted->at_ns - task->skew : 0);
    terms.budget = (uint64_t)wanted->budget_ns;
    terms.overrun = (uint16_t)wanted->overrun;
    ft_name_(task, row, task->name);
    for (; terms.count < FT_AFTER_MAX && wanted->after[terms.count] != NULL; terms.count++) {
        uint32_t other = ft_place_(task, wanted->after[terms.count]);
        bool seen[FT_TASKS_MAX_] = {false};
        if (other == FT_TASKS_MAX_)
            return fb_fail_(ENOSPC, "cannot add task %s: the schedule has no room for its predecessors; remove some tasks", task->name);
        if (ft_reaches_(task, other, row, seen))
            return fb_fail_(ELOOP, "tasks would wait for one another: %s after %.200s, which runs after it; break the circle", task->name,
                            wanted->after[terms.count]);
        ft_name_(task, other, wanted->after[terms.count]);
        terms.after[terms.count] = (uint16_t)other;
    }
    at = ft_row_(task->map, row);
    if (ft_is_declared_(task->map, row) && ft_read_terms_(task->map, row, &before, &serial) == 0) {
        terms.cpus = before.cpus;
        terms.priority = before.priority;
        if (memcmp(&before, &terms, sizeof terms) == 0)
            return 0;
    }
    serial = ft_load_(at + FT_SERIAL_) + 1;
    ft_store_(at + FT_MODES_, 0);
    memcpy(at + FT_TERMS_ + (size_t)(serial % 2) * FT_TERMS_ROOM_, &terms, sizeof terms);
    ft_store_(at, FT_DECLARED_);
    ft_store_(at + FT_SERIAL_, serial);
    for (uint32_t one = 0; one < FT_TASKS_MAX_; one++) {
        uint32_t count = 0;
        for (uint32_t other = 0; other < FT_TASKS_MAX_; other++)
            if (ft_is_declared_(task->map, other) && ft_read_terms_(task->map, other, &before, &serial) == 0)
                for (int place = 0; place < before.count; place++)
                    count += before.after[place] == one;
        ft_store_(ft_row_(task->map, one) + FT_SUCCESSORS_, count);
    }
    fb_wake_(at + FT_SERIAL_);
    return 0;
}

/* --- Opening -------------------------------------------------------------------------------------------------------------------------- */

static inline void ft_leave_(ft_task *task)
{
    if (task->map != NULL)
        munmap(task->map, FT_FILE_SIZE_);
    if (task->file >= 0)
        close(task->file);
    task->map = NULL;
    task->file = -1;
}

/* Make the table, without an agent or at its place: 0, also where another process was quicker. */
static inline int ft_make_(ft_task *task, const char *path)
{
    unsigned char header[128] = {0};
    char made_at[40];
    const uint32_t halves[] = {1, task->is_at_agents ? 0U : (uint32_t)FB_ALONE_, 0, FT_TASKS_MAX_};
    const mode_t mode = task->is_at_agents ? 0660 : 0600;
    const uint64_t words[] = {2, FT_FILE_SIZE_, (uint64_t)((fb_clock_(CLOCK_MONOTONIC) - task->skew) / 1000000000 * 1000000000)};
    int outcome = 0, made = open(task->directory, O_TMPFILE | O_RDWR | O_CLOEXEC, mode);
    if (made < 0)
        return -errno;
    memcpy(header, FT_MAGIC_, 8);
    memcpy(header + 8, halves, 8);
    memcpy(header + 16, words, 8);
    memcpy(header + 24, halves + 2, 8);
    memcpy(header + 32, words + 1, 8);
    fb_boot_id_(header + 40);
    memcpy(header + FT_ORIGIN_AT_, words + 2, 8);
    if (task->board != NULL)
        memcpy(header + 64, task->board->own->robot, 64);
    else
        gethostname((char *)header + 64, 63);
    snprintf(made_at, sizeof made_at, "/proc/self/fd/%d", made);
    if (fchmod(made, mode) != 0 || ftruncate(made, FT_FILE_SIZE_) != 0 || pwrite(made, header, sizeof header, 0) != sizeof header ||
        linkat(AT_FDCWD, made_at, AT_FDCWD, path, AT_SYMLINK_FOLLOW) != 0)
        outcome = errno == EEXIST ? 0 : -errno;
    close(made);
    return outcome;
}

/* Where the schedule is: beside the board; without one, the agent's place if this user may use it. */
static inline int ft_find_(ft_task *task)
{
    const char *named = task->chosen != NULL ? task->chosen : getenv("FAILOVER_BOARD");
    size_t size, place = strlen(FT_PLACE_);
    int outcome = 0;
    task->is_at_agents = false;
    if (named == NULL || *named == '\0') {
        fb_beside_socket_(task->directory, "board");
        if (access(task->directory, F_OK) != 0) {
            fb_beside_socket_(task->directory, FT_PLACE_);
            task->is_at_agents = faccessat(AT_FDCWD, task->directory, R_OK | W_OK | X_OK, AT_EACCESS) == 0;
        }
    } else {
        snprintf(task->directory, sizeof task->directory, "%s", named);
        size = strlen(task->directory);
        task->is_at_agents = size > place && task->directory[size - place - 1] == '/' && strcmp(task->directory + size - place, FT_PLACE_) == 0;
    }
    if (task->is_at_agents)
        return 0;
    if (task->board == NULL)
        return (task->board = fb_open(task->chosen)) == NULL ? -errno : ft_find_(task);
    pthread_mutex_lock(&task->board->guard);
    outcome = fb_ensure_(task->board);
    pthread_mutex_unlock(&task->board->guard);
    snprintf(task->directory, sizeof task->directory, "%s", task->board->directory);
    return outcome;
}

/* Map the table of the robot where this program runs now. 1: it is made and removed meanwhile. */
static inline int ft_map_(ft_task *task)
{
    char path[PATH_MAX + 16];
    struct stat about;
    int outcome = ft_find_(task);
    if (outcome != 0)
        return outcome;
    task->skew = fb_skew_of_("monotonic");
    snprintf(path, sizeof path, "%s/schedule", task->directory);
    task->file = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW);
    if (task->file < 0 && errno == ENOENT) {
        if (!task->is_at_agents && (task->board->own->flags & FB_ALONE_) == 0)
            return fb_fail_(ENOENT, "the board %.400s has no schedule: its agent is older than this program; update it", task->directory);
        outcome = ft_make_(task, path);
        return outcome == 0 || outcome == -ENOENT ? 1 : fb_fail_(-outcome, "cannot make %.400s: %s", path, strerror(-outcome));
    }
    if (task->file < 0)
        return fb_fail_(errno, "cannot open %.400s: %s; its owner may, and the group of [board] in team.toml", path, strerror(errno));
    if (fstat(task->file, &about) != 0 || about.st_size < FT_FILE_SIZE_)
        return fb_fail_(EBADMSG, "%.400s: this is no schedule: it has %lld bytes", path, (long long)about.st_size);
    task->map = (unsigned char *)mmap(NULL, FT_FILE_SIZE_, PROT_READ | PROT_WRITE, MAP_SHARED, task->file, 0);
    if (task->map == MAP_FAILED) {
        task->map = NULL;
        return fb_fail_(errno, "cannot map %.400s: %s", path, strerror(errno));
    }
    if (fb_is_lost_(ft_load_word_(task->map + FB_GENERATION_AT_)))
        return 1;
    if (memcmp(task->map, FT_MAGIC_, 8) != 0 || ft_load_(task->map + 8) != 1 || ft_load_(task->map + 28) != FT_TASKS_MAX_)
        return fb_fail_(EBADMSG, "%.400s: this is no schedule of version 1", path);
    return 0;
}

static inline void ft_publish_(ft_task *task)
{
    unsigned char *at = ft_row_(task->map, task->row);
    ft_store_word_(at + FT_NUMBER_, task->number);
    ft_store_word_(at + FT_DUE_, (uint64_t)ft_due_(&task->course, task->number));
    ft_store_word_(at + FT_LIMIT_, (uint64_t)task->limit);
    ft_store_(at + FT_ADOPTED_, task->adopted);
    ft_store_(at + FT_LIVE_ + 4, (uint32_t)task->pid);
    ft_store_word_(at + FT_SETTLED_, task->number + (task->state == FT_DONE_));
    ft_store_(at + FT_LIVE_, (uint32_t)task->state);
}

static inline void ft_write_course_(ft_task *task)
{
    unsigned char *at = ft_row_(task->map, task->row), *bank;
    uint32_t newest = ft_load_(at + FT_COURSE_NUMBER_) + 1;
    bank = at + FT_COURSES_ + (size_t)(newest % 2) * 24;
    ft_store_word_(bank, task->course.number);
    ft_store_word_(bank + 8, (uint64_t)task->course.anchor);
    ft_store_word_(bank + 16, (uint64_t)task->course.period);
    ft_store_(at + FT_COURSE_NUMBER_, newest);
}

static inline int64_t ft_now_(const ft_task *task) { return fb_clock_(CLOCK_MONOTONIC) - task->skew; }

/* Go on where an earlier process has left, if its course is that of the terms. */
static inline void ft_start_course_(ft_task *task)
{
    unsigned char *at = ft_row_(task->map, task->row);
    uint64_t settled = ft_load_word_(at + FT_SETTLED_), first;
    ft_course_ left = ft_read_course_(task->map, task->row);
    int64_t now = ft_now_(task);
    if (ft_load_(at + FT_ADOPTED_) != task->adopted || left.period != (int64_t)task->terms.period) {
        ft_course_ fresh = ft_first_course_(&task->terms, (int64_t)ft_load_word_(task->map + FT_ORIGIN_AT_));
        first = ft_first_from_(&fresh, now);
        left.anchor = ft_due_(&fresh, first);
        left.number = first > settled ? first : settled;
        left.period = fresh.period;
    }
    task->course = left;
    task->number = settled > left.number ? settled : left.number;
    task->state = FT_WAITING_;
    first = ft_first_from_(&left, now);
    if (task->terms.kind == FT_PERIODIC_)
        task->number = first > task->number ? first : task->number;
    else if (task->number > left.number) {
        task->number--;
        task->state = FT_DONE_;
    }
    task->counted = task->number + 1;
    task->limit = 0;
    task->is_missed = task->has_ordered = false;
    ft_write_course_(task);
    ft_publish_(task);
}

/* The row of the task; FT_TASKS_MAX_: it is not declared. */
static inline uint32_t ft_find_row_(ft_task *task)
{
    uint32_t row = 0;
    while (row < FT_TASKS_MAX_ && !(ft_is_declared_(task->map, row) && ft_is_named_(task->map, row, task->name)))
        row++;
    return row;
}

/* Become the process that runs a row. One that resumes waits up to 5 s for a former life of itself to end. */
static inline bool ft_take_row_(ft_task *task, uint32_t row)
{
    const struct timespec pause = {0, 10000000};
    for (int turn = 0; !fb_take_(task->file, FT_ROW_LOCKS_ + row); turn++) {
        if (task->pid == 0 || turn == 500)
            return false;
        nanosleep(&pause, NULL);
    }
    return true;
}

/* Keep the terms of a task that others declared: where this program resumes on another robot it declares them there. */
static inline void ft_remember_(ft_task *task)
{
    const ft_bank_ *terms = &task->terms;
    if (task->is_declared)
        return;
    task->wanted.period_ns = (int64_t)terms->period;
    task->wanted.phase_ns = (int64_t)terms->phase;
    task->wanted.deadline_ns = (int64_t)terms->deadline;
    task->wanted.at_ns = (int64_t)terms->at + (terms->period != 0 ? 0 : task->skew);
    task->wanted.budget_ns = (int64_t)terms->budget;
    task->wanted.overrun = terms->overrun;
    task->wanted.is_strict = (terms->flags & FT_STRICT_) != 0;
    for (int place = 0; place < FT_AFTER_MAX; place++) {
        free(task->after[place]);
        task->after[place] = place < terms->count ? strdup((const char *)ft_row_(task->map, terms->after[place]) + FT_NAME_) : NULL;
        task->wanted.after[place] = task->after[place];
    }
    task->is_known = true;
}

/* Find or declare the row, and become the process that runs it. 1: the table was made anew meanwhile. */
static inline int ft_attach_(ft_task *task)
{
    uint64_t generation;
    uint32_t found;
    int outcome = ft_map_(task);
    if (outcome != 0)
        return outcome;
    found = ft_find_row_(task);
    if (found < FT_TASKS_MAX_ && !ft_take_row_(task, found))
        return ft_taken_(task, found);
    if (task->is_declared || (task->is_known && found == FT_TASKS_MAX_)) {
        outcome = fb_take_table_(task->file, task->directory);
        if (outcome != 0)
            return outcome;
        generation = ft_load_word_(task->map + FB_GENERATION_AT_);
        generation += generation % 2;
        ft_store_word_(task->map + FB_GENERATION_AT_, generation + 1);
        outcome = ft_declare_(task);
        if (!fb_is_lost_(ft_load_word_(task->map + FB_GENERATION_AT_)))
            ft_store_word_(task->map + FB_GENERATION_AT_, generation + 2);
        fb_give_(task->file, FB_TABLE_LOCK_);
        if (outcome != 0)
            return outcome;
    }
    task->row = ft_find_row_(task);
    if (task->row == FT_TASKS_MAX_)
        return fb_fail_(ENOENT, "the schedule %.400s has no task %s; declare it, or give its terms", task->directory, task->name);
    if (!fb_take_(task->file, FT_ROW_LOCKS_ + task->row))
        return ft_taken_(task, task->row);
    task->pid = getpid();
    outcome = ft_read_terms_(task->map, task->row, &task->terms, &task->adopted);
    if (outcome == 0 && task->terms.kind > FT_ONE_SHOT_)
        outcome = fb_fail_(ENOTSUP, "task %s is sporadic: only Python runs such tasks", task->name);
    if (outcome == 0) {
        ft_remember_(task);
        ft_start_course_(task);
    }
    return outcome;
}

static inline int ft_ensure_(ft_task *task)
{
    int outcome = 1;
    if (task->map != NULL && task->pid == getpid() && !fb_is_lost_(ft_load_word_(task->map + FB_GENERATION_AT_)))
        return 0;
    if (task->pid != 0 && task->pid != getpid())
        return fb_fail_(ECHILD, "task %s is run by the parent of this process; begin another one", task->name);
    for (int turn = 0; outcome == 1 && turn < FB_TURNS_; turn++) {
        ft_leave_(task);
        outcome = ft_attach_(task);
    }
    if (outcome == 1)
        outcome = fb_fail_(ESTALE, "cannot open the schedule: others make and remove it meanwhile; try again");
    if (outcome != 0)
        ft_leave_(task);
    return outcome;
}

static inline void ft_close(ft_task *task)
{
    if (task == NULL)
        return;
    if (task->map != NULL && task->pid == getpid() && !fb_is_lost_(ft_load_word_(task->map + FB_GENERATION_AT_)))
        ft_store_(ft_row_(task->map, task->row) + FT_LIVE_, FT_IDLE_);
    ft_leave_(task);
    fb_close(task->board);
    free(task->chosen);
    for (int place = 0; place < FT_AFTER_MAX; place++)
        free(task->after[place]);
    free(task);
}

static inline ft_task *ft_begin(const char *directory, const char *name, const ft_terms *terms)
{
    ft_task *task;
    int outcome = 0;
    if (name == NULL || name[0] == '\0' || strlen(name) > FT_NAME_MAX_) {
        fb_fail_(EINVAL, "cannot schedule a task: its name has 1 to %d bytes", FT_NAME_MAX_);
        return NULL;
    }
    task = (ft_task *)calloc(1, sizeof *task);
    if (task == NULL) {
        fb_fail_(ENOMEM, "cannot schedule %s: no memory", name);
        return NULL;
    }
    task->file = -1;
    memcpy(task->name, name, strlen(name));
    if (terms != NULL) {
        task->is_declared = true;
        task->wanted = *terms;
        for (int place = 0; outcome == 0 && place < FT_AFTER_MAX && terms->after[place] != NULL; place++)
            if ((task->wanted.after[place] = task->after[place] = strdup(terms->after[place])) == NULL)
                outcome = fb_fail_(ENOMEM, "cannot schedule %s: no memory", name);
        if (outcome == 0)
            outcome = ft_examined_(task);
    }
    if (outcome == 0 && directory != NULL && (task->chosen = strdup(directory)) == NULL)
        outcome = fb_fail_(ENOMEM, "cannot schedule %s: no memory", name);
    if (outcome == 0)
        outcome = ft_ensure_(task);
    if (outcome != 0) {
        ft_close(task);
        errno = -outcome;
        return NULL;
    }
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    return task;
}

/* --- Activations (activation.py) ------------------------------------------------------------------------------------------------------ */

static inline void ft_begin_course_(ft_task *task, ft_course_ course, int64_t now)
{
    task->course.anchor = ft_due_(&course, ft_first_from_(&course, now));
    task->course.period = course.period;
    task->number += task->state == FT_DONE_;
    task->course.number = task->number;
    task->state = FT_WAITING_;
    ft_write_course_(task);
}

/* New terms between two activations. */
static inline void ft_adopt_(ft_task *task, const ft_bank_ *terms, int64_t now)
{
    ft_bank_ old = task->terms;
    ft_course_ course = ft_first_course_(terms, (int64_t)ft_load_word_(task->map + FT_ORIGIN_AT_));
    int64_t due = ft_due_(&task->course, task->number);
    task->terms = *terms;
    task->has_ordered = false;
    if (old.kind != terms->kind || (terms->kind == FT_PERIODIC_ && old.phase != terms->phase)) {
        ft_begin_course_(task, course, terms->kind == FT_PERIODIC_ ? now : course.anchor);
    } else if (terms->kind == FT_ONE_SHOT_) {
        if (old.at != terms->at)
            ft_begin_course_(task, course, course.anchor);
    } else if (old.period != terms->period) {
        if (due <= now) {
            task->course.number = task->number;
            task->course.anchor = due;
            task->course.period = (int64_t)terms->period;
            ft_write_course_(task);
        } else {
            course.number = 0;
            course.anchor = due - (int64_t)old.period + (int64_t)terms->period;
            ft_begin_course_(task, course, now);
        }
    }
}

static inline void ft_order_(ft_task *task)
{
    ft_bank_ terms;
    uint32_t serial;
    int outcome = ft_read_terms_(task->map, task->row, &terms, &serial);
    task->adopted = serial;
    if (outcome != 0 || terms.kind > FT_ONE_SHOT_)
        return; /* damaged: the task goes on as before */
    if (!task->is_declared) {
        ft_bank_ in_force = task->terms;
        task->terms = terms;
        ft_remember_(task);
        task->terms = in_force;
    }
    if ((terms.flags & FT_AT_NEXT_) != 0 && task->state != FT_DONE_) {
        task->ordered = terms;
        task->has_ordered = true;
    } else
        ft_adopt_(task, &terms, ft_now_(task));
    ft_publish_(task);
}

static inline int ft_end(ft_task *task)
{
    uint64_t first, known, next;
    int64_t now;
    unsigned char *at;
    int outcome;
    if (task->state != FT_RUNNING_)
        return 0;
    outcome = ft_ensure_(task);
    if (outcome != 0 || task->state != FT_RUNNING_)
        return outcome;
    now = ft_now_(task);
    at = ft_row_(task->map, task->row);
    ft_store_word_(at + FT_ENDED_NS_, (uint64_t)now);
    ft_add_(at + FT_ENDED_, 1);
    if (task->limit != 0 && now > task->limit && !task->is_missed)
        ft_add_(at + FT_MISSES_, 1);
    task->limit = 0;
    task->is_missed = false;
    if (task->terms.kind == FT_PERIODIC_) {
        next = task->number + 1;
        first = ft_first_from_(&task->course, now);
        known = task->counted > next ? task->counted : next;
        if (first > known)
            ft_add_(at + FT_OVERRUNS_, first - known);
        task->counted = first > known ? first : known;
        if (first > next && task->terms.overrun != FT_CATCH_UP)
            next = task->terms.overrun == FT_SKIP ? first : first - 1;
        task->skipped = next - task->number - 1;
        ft_add_(at + FT_SKIPPED_, task->skipped);
        task->number = next;
        task->state = FT_WAITING_;
    } else
        task->state = FT_DONE_;
    if (task->has_ordered && (task->ordered.flags & FT_AT_NEXT_) == 0)
        ft_adopt_(task, &task->ordered, now);
    ft_count_(at + FT_DURATION_, now - task->started_ns);
    ft_publish_(task);
    if (ft_load_(at + FT_SUCCESSORS_) != 0 || ft_load_(at + FT_LISTENERS_) != 0)
        fb_wake_(at + FT_SETTLED_);
    return 0;
}

/* Whether a predecessor has ended what covers an instant. */
static inline bool ft_has_ended_(ft_task *task, uint32_t row, int64_t due)
{
    ft_course_ course;
    if (!ft_is_declared_(task->map, row))
        return true;
    course = ft_read_course_(task->map, row);
    return ft_load_word_(ft_row_(task->map, row) + FT_SETTLED_) >= ft_covering_next_(&course, due);
}

/* The row of a predecessor to wait for; FT_TASKS_MAX_: none. */
static inline uint32_t ft_blocking_(ft_task *task, int64_t due, int64_t now)
{
    unsigned char *at = ft_row_(task->map, task->row);
    int64_t limit = task->terms.deadline != 0 ? due + (int64_t)task->terms.deadline : 0;
    for (int place = 0; place < task->terms.count; place++) {
        uint32_t row = task->terms.after[place];
        if (ft_has_ended_(task, row, due))
            continue;
        if (limit != 0 && now >= limit) {
            if (!task->is_missed) {
                task->is_missed = true;
                ft_add_(at + FT_MISSES_, 1);
                ft_store_(at + FT_BLAMED_, row + 1);
            }
            if ((task->terms.flags & FT_STRICT_) == 0 && !fb_is_taken_(task->file, FT_ROW_LOCKS_ + row, 1)) {
                ft_add_(at + FT_ORPHANED_, 1);
                continue;
            }
        }
        return row;
    }
    return FT_TASKS_MAX_;
}

static inline void ft_start_(ft_task *task, ft_tick *tick, int64_t due, int64_t now)
{
    unsigned char *at = ft_row_(task->map, task->row);
    if (task->has_ordered) {
        if (task->ordered.kind != task->terms.kind || task->ordered.phase != task->terms.phase)
            task->ordered.flags &= ~(uint32_t)FT_AT_NEXT_; /* other instants: from its end on */
        else {
            task->terms = task->ordered;
            task->has_ordered = false;
            task->course.number = task->number;
            task->course.anchor = due;
            task->course.period = (int64_t)task->terms.period;
            ft_write_course_(task);
        }
    }
    task->state = FT_RUNNING_;
    task->started_ns = now;
    task->limit = task->terms.deadline != 0 ? due + (int64_t)task->terms.deadline : 0;
    ft_add_(at + FT_STARTED_, 1);
    ft_store_word_(at + FT_STARTED_NS_, (uint64_t)now);
    ft_count_(at + FT_LATENESS_, now - due);
    ft_publish_(task);
    if (tick != NULL) {
        tick->number = task->number;
        tick->due_ns = due + task->skew;
        tick->late_ns = now - due;
        tick->missed = task->skipped;
    }
    task->skipped = 0;
}

/* How long before an instant this task wakes. */
static inline int64_t ft_early_(const ft_task *task)
{
    int64_t most = (int64_t)task->terms.period / FT_LEARNT_SHARE_, told = task->wanted.early_ns;
    if (told != FT_LEARN)
        return told > 0 ? told : 0;
    return task->early < most ? task->early : most;
}

/* How late it was woken: from the instant that it has asked for to its next look at the clock. */
static inline void ft_learn_(ft_task *task, int64_t now)
{
    int64_t late = now - task->asked + FT_LEARNT_MARGIN_NS_;
    if (task->asked == 0 || now < task->asked)
        return; /* it did not sleep, or a change of its row has woken it */
    if (late > FT_LEARNT_NS_MAX_)
        late = FT_LEARNT_NS_MAX_;
    task->early += task->early == 0 ? late : (late - task->early) / FT_LEARNT_WEIGHT_;
}

static inline int ft_wait(ft_task *task, ft_tick *tick)
{
    int outcome = ft_end(task);
    while (outcome == 0 && (outcome = ft_ensure_(task)) == 0) {
        unsigned char *at = ft_row_(task->map, task->row);
        uint32_t serial = ft_load_(at + FT_SERIAL_), row, settled;
        int64_t now, due, limit, latest;
        if (serial != task->adopted) {
            if (!ft_is_declared_(task->map, task->row) || !ft_is_named_(task->map, task->row, task->name)) {
                ft_store_(at + FT_LIVE_, FT_IDLE_);
                return 1;
            }
            ft_order_(task);
        }
        if (task->state == FT_DONE_)
            return 1;
        now = ft_now_(task);
        ft_learn_(task, now);
        task->asked = 0;
        due = ft_due_(&task->course, task->number);
        if (now < due) {
            int64_t until = due - ft_early_(task);
            if (now < until) {
                ft_sleep_(at + FT_SERIAL_, serial, until + task->skew);
                task->asked = until;
            }
            continue;
        }
        row = ft_blocking_(task, due, now);
        if (row == FT_TASKS_MAX_) {
            ft_start_(task, tick, due, now);
            return 0;
        }
        if (task->state != FT_HELD_) {
            task->state = FT_HELD_;
            ft_publish_(task);
        }
        settled = ft_load_(ft_row_(task->map, row) + FT_SETTLED_);
        if (ft_has_ended_(task, row, due))
            continue;
        limit = task->terms.deadline != 0 ? due + (int64_t)task->terms.deadline : 0;
        latest = now + FB_SLICE_NS_;
        ft_sleep_(ft_row_(task->map, row) + FT_SETTLED_, settled, (limit > now && limit < latest ? limit : latest) + task->skew);
    }
    return outcome;
}

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif
