/* failover.h: a program in C or C++ whose state outlives it. One header; needs libc and Linux, nothing else.
 *
 *     static struct { double setpoint, integral; } pid = {20.0, 0.0};
 *
 *     failover_region(&pid, sizeof pid, "pid");           what must survive
 *     if (failover_open("heater") < 0)                    fills it from the last commit, where there is one
 *         fprintf(stderr, "%s\n", failover_error());
 *     for (;;) {
 *         step(&pid);
 *         failover_commit();                              a point to return to: microseconds, never waits
 *     }
 *
 * Compile with -pthread. In C, include this header before all others or define _GNU_SOURCE. docs/c.md is the manual, SEGMENT.md
 * and TASK.md (in checkpoint/) say what the bytes are. All functions that return int or int64_t answer a negative errno when they fail, and
 * failover_error() says in a sentence what was tried, on what, why not. Nothing here prints, aborts or raises a signal.
 *
 * A process keeps one state. Regions are registered and the state is opened by one thread; commits come from any, one at a time, and
 * no thread writes to a region meanwhile. What regions hold must mean the same in another process: no pointers, no descriptors.
 *
 * SPDX-License-Identifier: MIT */

#ifndef FAILOVER_H
#define FAILOVER_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1
#endif

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdio_ext.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>

#ifndef F_OFD_SETLK
#error "failover.h: include it before all other headers, or compile with -D_GNU_SOURCE"
#endif
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "failover.h: this machine stores the high byte first, which segments do not"
#endif

#ifndef FAILOVER_FOLLOW_MIN
/* Regions of at least so many bytes are followed by the kernel (it tells which pages were written); smaller ones are compared, which
 * takes less time than asking. SIZE_MAX: always compare. */
#define FAILOVER_FOLLOW_MIN 65536
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* --- The contract --------------------------------------------------------------------------------------------------------------- */

/* Where the state came from that a program goes on with. */
typedef struct failover_resumption {
    uint64_t commit;     /* number of that commit, in the run that made it */
    uint64_t generation; /* of this run; every resume opens a new one. Under an agent: of the checkpoint that it goes on from */
    uint64_t epoch;      /* as failover_epoch() */
    double age_s;        /* seconds since that commit */
    const char *why;     /* "restarted" on the same robot; "taken over" from one that was lost; "handed over" as was ordered */
    const char *robot;   /* where that commit was made; "" without an agent */
    const char *notes;   /* what does not come back as it was, one sentence a line; "" if all does */
} failover_resumption;

typedef void failover_callback(const failover_resumption *resumed, void *context);

/* Say that `size` bytes at `memory` must survive under a name of 1 to 224 bytes. Before failover_open(); the memory must stay until
 * failover_close(). Regions do not overlap and their names differ. Change the name when the meaning of the bytes changes.
 * An error is remembered and refuses failover_open(), so it need not be looked at here. */
static inline int failover_region(void *memory, size_t size, const char *name);

/* Have a function called by failover_open() when the state was resumed: regions are filled by then. */
static inline void failover_on_resume(failover_callback *called, void *context);

/* Begin, or go on from the newest commit: 0 or 1. After an error regions are as they were.
 * Started by an agent (failover run), a program gets its state from there, and its commits travel to a standby; on a robot that stands by
 * this call waits, perhaps for days, until the program is needed. Otherwise the state is kept in NAME.segment ("/" as ".") in the folder that
 * FAILOVER_STATE names, else in the working directory; FAILOVER_COMPONENT takes the place of `name`. */
static inline int failover_open(const char *name);

/* Number of the primacy under which this program runs, which only grows: the fencing token, for a device that must tell an old primary from a
 * new one. 0 without an agent. */
static inline uint64_t failover_epoch(void);

/* What failover_open() resumed; NULL where the state began here. Valid until failover_close(). */
static inline const failover_resumption *failover_resumed(void);

/* Make what the regions hold now the point to return to. Answers the commit's number, from 1. -EAGAIN: readers held all banks, the next
 * commit makes up for it; -EBUSY: another thread is committing. */
static inline int64_t failover_commit(void);

/* Return 0 when the newest commit survives a power cut (under an agent: the loss of this robot); -ETIMEDOUT if it does not after so many
 * milliseconds. Negative: no limit. */
static inline int failover_wait(int timeout_ms);

/* Write the newest commit (under an agent: a caller that wants it to be safe waits before) and let everything go; regions are forgotten, their
 * memory stays. At exit() this happens by itself. */
static inline int failover_close(void);

/* Why the last call of this thread that failed did so: a sentence. */
static inline const char *failover_error(void);

/* --- Bytes (SEGMENT.md) ---------------------------------------------------------------------------------------------------------- */

#define FAILOVER_MAGIC_ "\x89" "FOSEG\r\n"

enum {
    FAILOVER_VERSION_ = 1,
    FAILOVER_BANKS_ = 3,
    FAILOVER_MAX_BANKS_ = 8,
    FAILOVER_MAX_REGIONS_ = 1024,
    FAILOVER_MAX_NAME_ = 224,
    FAILOVER_ARRAY_ = 2,
    FAILOVER_NEWEST_OFFSET_ = 256,
    FAILOVER_GENERATION_OFFSET_ = 384, /* in a file beside a program */
    FAILOVER_RECORDS_OFFSET_ = 512,
    FAILOVER_RECORD_SIZE_ = 64,
    FAILOVER_BANK_BITS_ = 8,
    FAILOVER_OWNER_BYTE_ = 255, /* of a file beside a program: write-locked by the process that has it */
    FAILOVER_CHUNK_PAGES_ = 64, /* copied to the file at a time */
    FAILOVER_SPANS_ = 256,      /* stretches of written pages that one question to the kernel may answer */
    FAILOVER_ATTEMPTS_ = 200    /* looks of a reader that the writer overtakes */
};

#define FAILOVER_PAGE_ ((uint64_t)4096)
#define FAILOVER_MAX_PAGES_ ((uint64_t)16777216)
#define FAILOVER_STRIDE_ ((uint64_t)1 << 37)

typedef struct failover_head_ {
    char magic[8];
    uint32_t version, page_size, regions, banks;
    uint64_t pages, size;
    uint8_t lineage[16];
} failover_head_;

typedef struct failover_entry_ {
    uint32_t kind, name_size;
    uint64_t address, size, first;
    char name[FAILOVER_MAX_NAME_];
} failover_entry_;

typedef struct failover_record_ {
    uint64_t number, realtime, monotonic, boottime;
    uint64_t told, outputs[2]; /* whether a guard counts the program's output, and how much there was */
    uint64_t sum;              /* in a file beside a program */
} failover_record_;

/* --- Bytes (TASK.md) --------------------------------------------------------------------------------------------------------------- */

enum {
    FAILOVER_TASK_VERSION_ = 1,
    FAILOVER_HELLO_ = 1,
    FAILOVER_BEGIN_ = 2,
    FAILOVER_REFUSED_ = 3,
    FAILOVER_KEEPS_ = 4,
    FAILOVER_SAFE_ = 5,
    FAILOVER_KEPT_ = 6, /* no robot stands by, this one's disk has it: that helps no caller who waits for a standby */
    FAILOVER_PACKET_SIZE_ = 512,
    FAILOVER_TOLD_ = 1,
    FAILOVER_PENDING_ = 2,
    FAILOVER_DIGITS_ = 20 /* of the epoch in the environment */
};

typedef struct failover_begin_ {
    uint32_t kind, version;
    uint64_t epoch, pipes[2];
    uint32_t why, unused;
    uint64_t generation, age_ns;
    char component[256], robot[64];
} failover_begin_;

typedef char failover_begin_has_376_bytes_[sizeof(failover_begin_) == 376 ? 1 : -1];

typedef union failover_packet_ {
    struct {
        uint32_t kind, version;
    } head;
    failover_begin_ begin;
    struct {
        uint32_t kind, version;
        uint64_t commit;
    } safe;
    struct {
        uint32_t kind, version;
        char why[504];
    } refused;
    unsigned char bytes[FAILOVER_PACKET_SIZE_];
} failover_packet_;

/* --- What this process keeps ------------------------------------------------------------------------------------------------------ */

typedef struct failover_kept_ {
    unsigned char *memory;
    uint64_t size, pages, first;
    uintptr_t low, high; /* the machine's pages that the kernel follows; empty where low == high */
    char name[FAILOVER_MAX_NAME_ + 1];
} failover_kept_;

/* A segment: what the header says, and where things lie. */
typedef struct failover_layout_ {
    failover_head_ head;
    failover_entry_ *entries;
} failover_layout_;

typedef struct failover_task_ {
    failover_kept_ *kept;
    uint32_t count;
    int refusal; /* the first failover_region() that failed */
    char refused[512];
    bool is_open, is_forked, is_registered;
    bool has_descriptors; /* those below are numbers, or -1 */
    failover_callback *on_resume;
    void *context;
    bool is_resumed;
    failover_resumption resumption;
    char notes[1024];

    /* the segment in memory: the committing thread's */
    failover_layout_ layout;
    int segment; /* the opening that has the locks */
    unsigned char *map;
    uint64_t *versions, held[FAILOVER_BANKS_], number;
    int newest;
    int faults, pagemap; /* userfaultfd, /proc/self/pagemap; -1 where written pages are compared */
    uint32_t committing;
    bool is_missing; /* the last commit found all banks held */

    /* the file: the recorder's, but for what is marked atomic */
    pthread_t recorder;
    bool has_recorder;
    int source, folder, file, fresh; /* fresh: a file that is begun aside, else -1 */
    bool is_file_ours; /* the file was begun by this run; else it is what we resumed from */
    int file_newest;
    uint64_t file_held[FAILOVER_BANKS_], sum, *sums, *stamps;
    uint64_t generation, table_sum;
    unsigned char *chunk;
    char file_name[256], fresh_name[260];
    uint32_t pulse, hurry, safe;   /* atomic, futexes: a commit was made; a thread waits; a commit is safe */
    uint32_t closing, trouble;     /* atomic; trouble: errno of the last write that failed */
    uint64_t committed, durable;   /* atomic: numbers */
    const char *step;              /* atomic: what failed */

    /* the guard, where there is one: then there is no recorder and no file */
    int guard;                  /* its socket, or -1 */
    const uint64_t *counters;   /* of our output; NULL where no guard counts it */
    uint64_t stuck[4], epoch;   /* the counters when they were last given up */
    const char *token;          /* the epoch's digits in the environment, renewed there; NULL without a guard */
    bool is_kept, is_pending;   /* the guard was told of a commit; the last commit does not know its output */
    char robot[64];
} failover_task_;

/* One of each in a program, however many of its files include this one. */
__attribute__((weak)) failover_task_ failover_the_task_;
__attribute__((weak)) __thread char failover_sentence_[768];
/* Held for the moment in which a file is opened or changes its place, and by fork(): a child must know what to close. */
__attribute__((weak)) pthread_mutex_t failover_files_ = PTHREAD_MUTEX_INITIALIZER;

static inline const char *failover_error(void) { return failover_sentence_; }

__attribute__((format(printf, 2, 3))) static inline int failover_fail_(int code, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(failover_sentence_, sizeof failover_sentence_, format, arguments);
    va_end(arguments);
    return -code;
}

/* --- Arithmetic of the layout ---------------------------------------------------------------------------------------------------- */

static inline uint64_t failover_pages_(uint64_t size) { return size / FAILOVER_PAGE_ + (size % FAILOVER_PAGE_ != 0); }

static inline uint64_t failover_whole_(uint64_t size) { return failover_pages_(size) * FAILOVER_PAGE_; }

static inline uint64_t failover_versions_at_(const failover_head_ *head, uint32_t bank)
{
    return FAILOVER_PAGE_ + failover_whole_((uint64_t)head->regions * sizeof(failover_entry_)) + bank * failover_whole_(head->pages * 8);
}

static inline uint64_t failover_bank_at_(const failover_head_ *head, uint32_t bank)
{
    return failover_versions_at_(head, head->banks) + bank * head->pages * FAILOVER_PAGE_;
}

static inline uint64_t failover_record_at_(uint32_t bank) { return FAILOVER_RECORDS_OFFSET_ + (uint64_t)bank * FAILOVER_RECORD_SIZE_; }

/* --- Calls that are repeated until they are done ---------------------------------------------------------------------------------- */

/* 0 or -errno; a file that ends before is -ENODATA. */
static inline int failover_read_(int file, void *target, uint64_t size, uint64_t offset)
{
    unsigned char *next = (unsigned char *)target;
    while (size != 0) {
        ssize_t count = pread(file, next, (size_t)size, (off_t)offset);
        if (count < 0 && errno == EINTR)
            continue;
        if (count <= 0)
            return count < 0 ? -errno : -ENODATA;
        next += count;
        offset += (uint64_t)count;
        size -= (uint64_t)count;
    }
    return 0;
}

static inline int failover_write_(int file, const void *from, uint64_t size, uint64_t offset)
{
    const unsigned char *next = (const unsigned char *)from;
    while (size != 0) {
        ssize_t count = pwrite(file, next, (size_t)size, (off_t)offset);
        if (count < 0 && errno == EINTR)
            continue;
        if (count <= 0)
            return count < 0 ? -errno : -EIO;
        next += count;
        offset += (uint64_t)count;
        size -= (uint64_t)count;
    }
    return 0;
}

static inline int failover_sync_(int file)
{
    while (fdatasync(file) != 0)
        if (errno != EINTR)
            return -errno;
    return 0;
}

/* ioctl(2) itself: libcs do not agree on the type of the request. */
static inline int failover_ioctl_(int file, unsigned long request, void *order) { return (int)syscall(SYS_ioctl, file, request, order); }

/* Lock one byte, for the opening that `file` is of (fcntl(2), F_OFD_SETLK); never waits. 0 or -errno. */
static inline int failover_lock_(int file, int kind, off_t byte)
{
    struct flock lock;
    memset(&lock, 0, sizeof lock);
    lock.l_type = (short)kind;
    lock.l_whence = SEEK_SET;
    lock.l_start = byte;
    lock.l_len = 1;
    return fcntl(file, F_OFD_SETLK, &lock) == 0 ? 0 : -errno;
}

/* Another opening of the same file: locks and mappings belong to openings. */
static inline int failover_again_(int file, int flags)
{
    char path[40];
    snprintf(path, sizeof path, "/proc/self/fd/%d", file);
    return open(path, flags | O_CLOEXEC);
}

static inline uint64_t failover_clock_(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static inline void failover_wake_(uint32_t *word)
{
    __atomic_add_fetch(word, 1, __ATOMIC_RELEASE);
    syscall(SYS_futex, word, 1 | 128 /* FUTEX_WAKE, private */, INT32_MAX, NULL, NULL, 0);
}

/* Wait until the word is not `seen` any more, or the time is over (UINT64_MAX: never); may return early. */
static inline void failover_sleep_(uint32_t *word, uint32_t seen, uint64_t timeout_ns)
{
    struct timespec limit;
    limit.tv_sec = (time_t)(timeout_ns / 1000000000u);
    limit.tv_nsec = (long)(timeout_ns % 1000000000u);
    syscall(SYS_futex, word, 0 | 128 /* FUTEX_WAIT, private */, seen, timeout_ns == UINT64_MAX ? NULL : &limit, NULL, 0);
}

/* --- Regions ------------------------------------------------------------------------------------------------------------------------ */

/* Whether a text is UTF-8 as RFC 3629 has it: nothing too long, no surrogates, nothing beyond U+10FFFF. */
static inline bool failover_is_utf8_(const char *text)
{
    const unsigned char *next = (const unsigned char *)text;
    while (*next != 0) {
        const unsigned char lead = *next++;
        unsigned char low = lead == 0xE0 ? 0xA0 : lead == 0xF0 ? 0x90 : 0x80, high = lead == 0xED ? 0x9F : lead == 0xF4 ? 0x8F : 0xBF;
        int rest = lead < 0x80 ? 0 : lead < 0xE0 ? 1 : lead < 0xF0 ? 2 : 3;
        if (lead > 0xF4 || (lead >= 0x80 && lead < 0xC2))
            return false;
        for (; rest > 0; rest--, low = 0x80, high = 0xBF)
            if (*next < low || *next++ > high)
                return false;
    }
    return true;
}

static inline int failover_refuse_region_(failover_task_ *task, void *memory, size_t size, const char *name)
{
    if (task->is_open)
        return failover_fail_(EBUSY, "cannot keep region '%.224s': the state is open; register regions before failover_open()", name);
    if (memory == NULL || size == 0 || size > FAILOVER_MAX_PAGES_ * FAILOVER_PAGE_)
        return failover_fail_(EINVAL, "cannot keep region '%.224s': %zu bytes at %p; 1 byte to 64 GiB are possible", name, size, memory);
    if (name[0] == '\0' || strlen(name) > FAILOVER_MAX_NAME_)
        return failover_fail_(ENAMETOOLONG, "cannot keep region '%.80s': a name has 1 to %d bytes", name, FAILOVER_MAX_NAME_);
    if (!failover_is_utf8_(name))
        return failover_fail_(EILSEQ, "cannot keep region %u, of %zu bytes: its name is no UTF-8", task->count + 1, size);
    if (task->count == FAILOVER_MAX_REGIONS_)
        return failover_fail_(E2BIG, "cannot keep region '%.224s': there are %d, which is all; put several variables into one struct", name,
                              FAILOVER_MAX_REGIONS_);
    for (uint32_t index = 0; index < task->count; index++) {
        const failover_kept_ *other = &task->kept[index];
        if (strcmp(other->name, name) == 0)
            return failover_fail_(EEXIST, "cannot keep region '%.224s': another one has that name", name);
        if ((uintptr_t)memory < (uintptr_t)other->memory + other->size && (uintptr_t)other->memory < (uintptr_t)memory + size)
            return failover_fail_(EINVAL, "cannot keep region '%.224s': it overlaps with '%s'", name, other->name);
    }
    return 0;
}

static inline int failover_region(void *memory, size_t size, const char *name)
{
    failover_task_ *task = &failover_the_task_;
    int failed = failover_refuse_region_(task, memory, size, name == NULL ? "" : name);
    failover_kept_ *more = NULL;
    if (failed == 0) {
        more = (failover_kept_ *)realloc(task->kept, (task->count + 1) * sizeof *more);
        if (more == NULL)
            failed = failover_fail_(ENOMEM, "cannot keep region '%.224s': no memory", name);
    }
    if (failed != 0) {
        if (task->refusal == 0 && !task->is_open) {
            task->refusal = failed;
            snprintf(task->refused, sizeof task->refused, "%.511s", failover_sentence_);
        }
        return failed;
    }
    task->kept = more;
    more += task->count++;
    memset(more, 0, sizeof *more);
    more->memory = (unsigned char *)memory;
    more->size = size;
    more->pages = failover_pages_(size);
    memcpy(more->name, name, strlen(name));
    return 0;
}

static inline void failover_on_resume(failover_callback *called, void *context)
{
    failover_the_task_.on_resume = called;
    failover_the_task_.context = context;
}

/* The epoch that these digits tell, read in their order (checkpoint/program/epoch_variable.py); 0 where they are none. */
static inline uint64_t failover_token_(const volatile char *digits)
{
    uint64_t told = 0;
    for (int index = 0; index < FAILOVER_DIGITS_; index++) {
        const char digit = digits[index];
        if (digit < '0' || digit > '9')
            return 0;
        told = told * 10 + (uint64_t)(digit - '0');
    }
    return told;
}

static inline uint64_t failover_epoch(void)
{
    const failover_task_ *task = &failover_the_task_;
    const uint64_t told = task->token != NULL ? failover_token_(task->token) : 0;
    return told > task->epoch ? told : task->epoch;
}

static inline const failover_resumption *failover_resumed(void)
{
    return failover_the_task_.is_resumed ? &failover_the_task_.resumption : NULL;
}

/* --- Which pages were written: userfaultfd(2), asynchronous write protection; PAGEMAP_SCAN -------------------------------------- */

/* Source: linux/userfaultfd.h and linux/fs.h of 6.7; older headers do not have all of it. */
typedef struct failover_api_ {
    uint64_t api, features, ioctls;
} failover_api_;

typedef struct failover_register_ {
    uint64_t start, size, mode, ioctls;
} failover_register_;

typedef struct failover_span_ {
    uint64_t start, end, categories;
} failover_span_;

typedef struct failover_scan_ {
    uint64_t size, flags, start, end, walk_end, spans, span_count, max_pages, inverted, mask, any_of, answered;
} failover_scan_;

#define FAILOVER_UFFDIO_API_ _IOWR(0xAA, 0x3F, failover_api_)
#define FAILOVER_UFFDIO_REGISTER_ _IOWR(0xAA, 0x00, failover_register_)
#define FAILOVER_PAGEMAP_SCAN_ _IOWR('f', 16, failover_scan_)

/* Find what was written in [start, end) since the last question and protect it again: the number of spans, or -errno. Where there
 * were more spans than fit, `*next` is where to go on. */
static inline int failover_written_(const failover_task_ *task, uint64_t start, uint64_t end, failover_span_ *spans, uint64_t *next)
{
    failover_scan_ scan;
    memset(&scan, 0, sizeof scan);
    scan.size = sizeof scan;
    scan.flags = 1 | 2; /* PM_SCAN_WP_MATCHING | PM_SCAN_CHECK_WPASYNC: -EPERM where the memory is not ours to follow any more */
    scan.start = start;
    scan.end = end;
    scan.spans = (uint64_t)(uintptr_t)spans;
    scan.span_count = FAILOVER_SPANS_;
    scan.mask = scan.answered = 2; /* PAGE_IS_WRITTEN, and just that: the kernel's fast path */
    int count = failover_ioctl_(task->pagemap, FAILOVER_PAGEMAP_SCAN_, &scan);
    *next = scan.walk_end;
    return count < 0 ? -errno : count;
}

static inline void failover_stop_following_(failover_task_ *task)
{
    if (task->faults >= 0)
        close(task->faults);
    if (task->pagemap >= 0)
        close(task->pagemap);
    task->faults = task->pagemap = -1;
    for (uint32_t index = 0; index < task->count; index++)
        task->kept[index].low = task->kept[index].high = 0;
}

/* Have large regions followed. Only pages of the machine that belong to a region alone: the rest is compared. */
static inline void failover_follow_(failover_task_ *task)
{
    failover_api_ api;
    const uintptr_t page = (uintptr_t)sysconf(_SC_PAGESIZE);
    uint64_t largest = 0;
    for (uint32_t index = 0; index < task->count; index++)
        largest = task->kept[index].size > largest ? task->kept[index].size : largest;
    if (largest < (uint64_t)FAILOVER_FOLLOW_MIN)
        return;
    task->faults = (int)syscall(SYS_userfaultfd, O_CLOEXEC | O_NONBLOCK | 1 /* UFFD_USER_MODE_ONLY */);
    if (task->faults < 0)
        return;
    memset(&api, 0, sizeof api);
    api.api = 0xAA;
    api.features = (1u << 13) | (1u << 15); /* UFFD_FEATURE_WP_UNPOPULATED, UFFD_FEATURE_WP_ASYNC */
    task->pagemap = open("/proc/self/pagemap", O_RDONLY | O_CLOEXEC);
    if (task->pagemap < 0 || failover_ioctl_(task->faults, FAILOVER_UFFDIO_API_, &api) != 0) {
        failover_stop_following_(task);
        return;
    }
    for (uint32_t index = 0; index < task->count; index++) {
        failover_kept_ *kept = &task->kept[index];
        failover_register_ order;
        uintptr_t low = ((uintptr_t)kept->memory + page - 1) / page * page;
        uintptr_t high = ((uintptr_t)kept->memory + kept->size) / page * page;
        if (kept->size < (uint64_t)FAILOVER_FOLLOW_MIN || low >= high)
            continue;
        memset(&order, 0, sizeof order);
        order.start = low;
        order.size = high - low;
        order.mode = 2; /* UFFDIO_REGISTER_MODE_WP */
        if (failover_ioctl_(task->faults, FAILOVER_UFFDIO_REGISTER_, &order) != 0)
            continue;
        kept->low = low;
        kept->high = high;
    }
}

/* --- Under an agent: how much this program has printed (SEGMENT.md, records) -------------------------------------------------------- */

/* A commit that finds a pipe full, or the guard in the middle of counting, waits so long; for a guard that stands still, once. */
#define FAILOVER_PATIENCE_NS_ ((uint64_t)300000)

static inline int failover_unread_(int stream)
{
    int unread = 0;
    return failover_ioctl_(stream, 0x541B /* FIONREAD */, &unread) == 0 ? unread : 0;
}

/* Whether a flush fits into the pipe, however its slots, each a page, are filled: two neighbours hold more than one page together, and
 * the first may be read in part. An empty pipe is taken as it is. Source: pipe(7), pipe_write() in the kernel's fs/pipe.c. */
static inline bool failover_has_room_(FILE *file, int stream)
{
    const uint64_t page = (uint64_t)sysconf(_SC_PAGESIZE), held = __fpending(file), unread = (uint64_t)failover_unread_(stream);
    const int size = held != 0 && unread != 0 ? fcntl(stream, F_GETPIPE_SZ) : -1;
    return size < 0 || 2 * ((unread + page - 1) / page) + 2 + (held + page - 1) / page + 1 <= (uint64_t)size / page;
}

/* Flush a stream if that does not wait: neither for room in its pipe nor for a thread that is in the middle of printing. */
static inline bool failover_flush_(FILE *file, int stream)
{
    if (ftrylockfile(file) != 0)
        return false;
    const bool has_room = failover_has_room_(file, stream);
    if (has_room)
        fflush(file);
    funlockfile(file);
    return has_room;
}

/* Bytes that were written to a stream: those that the guard took, and those that it has not. False while it is taking some. */
static inline bool failover_total_(const failover_task_ *task, int stream, uint64_t *total)
{
    const uint64_t *busy = task->counters + 2 * (stream - 1), *taken = busy + 1;
    const uint64_t before = __atomic_load_n(taken, __ATOMIC_SEQ_CST);
    if (__atomic_load_n(busy, __ATOMIC_SEQ_CST) != 0)
        return false;
    *total = before + (uint64_t)failover_unread_(stream);
    return __atomic_load_n(busy, __ATOMIC_SEQ_CST) == 0 && __atomic_load_n(taken, __ATOMIC_SEQ_CST) == before;
}

static inline bool failover_totals_(const failover_task_ *task, uint64_t *totals)
{
    return failover_flush_(stdout, 1) && failover_flush_(stderr, 2) && failover_total_(task, 1, totals) &&
           failover_total_(task, 2, totals + 1);
}

/* What a commit's record says of its output. */
static inline uint64_t failover_outputs_(failover_task_ *task, uint64_t *totals)
{
    totals[0] = totals[1] = 0;
    task->is_pending = false;
    if (task->counters == NULL)
        return 0;
    const bool is_stuck = memcmp(task->stuck, task->counters, sizeof task->stuck) == 0;
    const uint64_t limit = failover_clock_(CLOCK_MONOTONIC) + FAILOVER_PATIENCE_NS_;
    while (!failover_totals_(task, totals)) {
        const struct timespec moment = {0, 50000};
        if (is_stuck || failover_clock_(CLOCK_MONOTONIC) > limit) {
            memcpy(task->stuck, task->counters, sizeof task->stuck);
            totals[0] = totals[1] = 0;
            task->is_pending = true;
            return FAILOVER_PENDING_;
        }
        nanosleep(&moment, NULL);
    }
    memset(task->stuck, 0xff, sizeof task->stuck);
    return FAILOVER_TOLD_;
}

/* --- Under an agent: the guard's socket (TASK.md) -------------------------------------------------------------------------------------- */

/* Send a packet that is nothing but its head. Never waits; 0 or -errno. */
static inline int failover_say_(int guard, uint32_t kind)
{
    const uint32_t head[2] = {kind, FAILOVER_TASK_VERSION_};
    return send(guard, head, sizeof head, MSG_NOSIGNAL | MSG_DONTWAIT) == (ssize_t)sizeof head ? 0 : -errno;
}

/* Take one packet, and up to two descriptors (the others stay -1): its size, 0 when the guard hung up, -errno. Others are closed unseen. */
static inline ssize_t failover_take_(int guard, int flags, failover_packet_ *packet, int *descriptors)
{
    union {
        struct cmsghdr head;
        char room[CMSG_SPACE(8 * sizeof(int))];
    } control;
    struct iovec place;
    struct msghdr message;
    memset(&message, 0, sizeof message);
    memset(&control, 0, sizeof control);
    place.iov_base = packet;
    place.iov_len = sizeof *packet;
    message.msg_iov = &place;
    message.msg_iovlen = 1;
    message.msg_control = &control;
    message.msg_controllen = sizeof control;
    ssize_t size = recvmsg(guard, &message, flags | MSG_CMSG_CLOEXEC);
    if (size < 0)
        return -errno;
    size_t count = 0;
    if (message.msg_controllen >= CMSG_LEN(0) && control.head.cmsg_level == SOL_SOCKET && control.head.cmsg_type == SCM_RIGHTS)
        count = (control.head.cmsg_len - CMSG_LEN(0)) / sizeof(int);
    for (size_t index = 0; index < count; index++) {
        int descriptor;
        memcpy(&descriptor, CMSG_DATA(&control.head) + index * sizeof(int), sizeof(int));
        if (descriptors != NULL && index < 2)
            descriptors[index] = descriptor;
        else
            close(descriptor);
    }
    if (size != 0 && ((message.msg_flags & MSG_TRUNC) != 0 || size < (ssize_t)sizeof packet->head || packet->head.version != FAILOVER_TASK_VERSION_))
        return -EPROTO;
    return size;
}

/* The abstract address that the environment names, which is taken out of it; 0 where it names none. */
static inline socklen_t failover_address_(struct sockaddr_un *address)
{
    const char *told = getenv("FAILOVER_TASK");
    if (told == NULL || strncmp(told, "@failover.", 10) != 0 || strlen(told) != 26 || strspn(told + 10, "0123456789abcdef") != 16)
        return 0;
    memset(address, 0, sizeof *address);
    address->sun_family = AF_UNIX;
    memcpy(address->sun_path + 1, told + 1, 25);
    unsetenv("FAILOVER_TASK");
    return (socklen_t)(offsetof(struct sockaddr_un, sun_path) + 26);
}

/* Connect to the guard: 1, or 0 where this program has none, or -errno with a sentence. */
static inline int failover_connect_(failover_task_ *task)
{
    struct sockaddr_un address;
    struct ucred listener;
    socklen_t size = failover_address_(&address), room = sizeof listener;
    if (size == 0)
        return 0;
    task->guard = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    if (task->guard < 0)
        return failover_fail_(errno, "cannot keep a state under the agent: no socket: %s", strerror(errno));
    while (connect(task->guard, (const struct sockaddr *)&address, size) != 0) {
        if (errno == EINTR)
            continue;
        const int code = errno;
        close(task->guard);
        task->guard = -1;
        return code == ECONNREFUSED ? 0 : failover_fail_(code, "cannot keep a state under the agent: no way to its guard: %s", strerror(code));
    }
    if (getsockopt(task->guard, SOL_SOCKET, SO_PEERCRED, &listener, &room) != 0 || (listener.uid != 0 && listener.uid != geteuid()))
        return failover_fail_(EPERM, "cannot keep a state under the agent: the listener at FAILOVER_TASK is neither this user nor root");
    return 1;
}

/* Say Hello and wait for Begin, as long as it takes. 0, or -errno with a sentence. */
static inline int failover_hear_begin_(failover_task_ *task, failover_packet_ *packet, int *descriptors)
{
    int failed = failover_say_(task->guard, FAILOVER_HELLO_);
    if (failed != 0)
        return failover_fail_(-failed, "cannot keep a state under the agent: no way to its guard: %s", strerror(-failed));
    ssize_t size;
    do
        size = failover_take_(task->guard, 0, packet, descriptors);
    while (size == -EINTR);
    if (size <= 0)
        return failover_fail_(size < 0 ? (int)-size : ECONNRESET, "cannot keep a state under the agent: its guard does not say how to begin: %s",
                              size < 0 ? strerror((int)-size) : "it closed the connection");
    if (packet->head.kind == FAILOVER_REFUSED_ && size == (ssize_t)sizeof packet->refused)
        return failover_fail_(EACCES, "cannot keep a state under the agent: %.503s", packet->refused.why);
    const failover_begin_ *begin = &packet->begin;
    if (begin->kind != FAILOVER_BEGIN_ || size != (ssize_t)sizeof *begin || begin->why > 3 || descriptors[0] < 0 ||
        (descriptors[1] < 0) != (begin->why == 0) || memchr(begin->robot, 0, sizeof begin->robot) == NULL)
        return failover_fail_(EPROTO, "cannot keep a state under the agent: its guard does not say how to begin");
    return 0;
}

/* Count our output if it still goes into the pipes that we were born with. */
static inline int failover_count_output_(failover_task_ *task, const failover_begin_ *begin, int counters)
{
    struct stat found;
    for (int stream = 1; stream <= 2; stream++)
        if (fstat(stream, &found) != 0 || !S_ISFIFO(found.st_mode) || found.st_ino != begin->pipes[stream - 1])
            return 0;
    void *map = fstat(counters, &found) == 0 && found.st_size >= (off_t)FAILOVER_PAGE_
                    ? mmap(NULL, FAILOVER_PAGE_, PROT_READ, MAP_SHARED, counters, 0)
                    : MAP_FAILED;
    if (map == MAP_FAILED)
        return failover_fail_(EPROTO, "cannot keep a state under the agent: its guard's counters cannot be read");
    task->counters = (const uint64_t *)map;
    memset(task->stuck, 0xff, sizeof task->stuck);
    return 0;
}

/* Take in what the guard has said until now. False when it has gone. */
static inline bool failover_hear_(failover_task_ *task)
{
    failover_packet_ packet;
    for (;;) {
        ssize_t size = failover_take_(task->guard, MSG_DONTWAIT, &packet, NULL);
        if (size == -EAGAIN || size == -EINTR)
            return true;
        if (size == (ssize_t)sizeof packet.safe && packet.head.kind == FAILOVER_KEPT_)
            continue;
        if (size != (ssize_t)sizeof packet.safe || packet.head.kind != FAILOVER_SAFE_)
            return false;
        uint64_t known = __atomic_load_n(&task->durable, __ATOMIC_RELAXED);
        while (known < packet.safe.commit &&
               !__atomic_compare_exchange_n(&task->durable, &known, packet.safe.commit, true, __ATOMIC_RELEASE, __ATOMIC_RELAXED))
            continue;
    }
}

static inline int failover_wait_for_standby_(failover_task_ *task, uint64_t number, uint64_t limit)
{
    for (;;) {
        const bool is_there = failover_hear_(task);
        const uint64_t durable = __atomic_load_n(&task->durable, __ATOMIC_ACQUIRE), now = failover_clock_(CLOCK_MONOTONIC);
        if (durable >= number)
            return 0;
        if (!is_there)
            return failover_fail_(EPIPE, "commit %llu is not safe: the guard of this program has gone, nothing that it commits is safe any more",
                                  (unsigned long long)number);
        if (now >= limit && task->is_pending)
            return failover_fail_(ETIMEDOUT, "commit %llu is not safe yet: its output pipe is full, the guard takes nothing from it; a later commit "
                                  "will do", (unsigned long long)number);
        if (now >= limit)
            return failover_fail_(ETIMEDOUT, "commit %llu is not safe yet: the standby holds commit %llu; see failover status",
                                  (unsigned long long)number, (unsigned long long)durable);
        struct pollfd wanted = {task->guard, POLLIN, 0};
        const uint64_t left = (limit - now) / 1000000u + 1;
        poll(&wanted, 1, left < 100 ? (int)left : 100); /* another thread that waits may take the packet that we wait for */
    }
}

/* --- Commit ---------------------------------------------------------------------------------------------------------------------------- */

static inline uint64_t *failover_words_(const failover_task_ *task, uint64_t offset)
{
    return (uint64_t *)(void *)(task->map + offset);
}

/* Note pages of a region whose bytes are not those of the newest commit. */
static inline void failover_compare_(failover_task_ *task, const failover_kept_ *kept, uint64_t page, uint64_t end)
{
    const unsigned char *newest = task->map + failover_bank_at_(&task->layout.head, (uint32_t)task->newest) + kept->first * FAILOVER_PAGE_;
    for (; page < end; page++) {
        uint64_t offset = page * FAILOVER_PAGE_, left = kept->size - offset;
        if (memcmp(kept->memory + offset, newest + offset, left < FAILOVER_PAGE_ ? left : FAILOVER_PAGE_) != 0)
            task->versions[kept->first + page] = task->number + 1;
    }
}

/* Note pages of a region that the kernel saw written. The segment's pages count from the region's first byte, the machine's do not. */
static inline int failover_ask_(failover_task_ *task, failover_kept_ *kept)
{
    failover_span_ spans[FAILOVER_SPANS_];
    const uint64_t base = (uint64_t)(uintptr_t)kept->memory;
    uint64_t next = kept->low;
    while (next < kept->high) {
        int count = failover_written_(task, next, kept->high, spans, &next);
        if (count < 0)
            return count;
        for (int index = 0; index < count; index++) {
            uint64_t page = (spans[index].start - base) / FAILOVER_PAGE_, end = failover_pages_(spans[index].end - base);
            for (; page < end; page++)
                task->versions[kept->first + page] = task->number + 1;
        }
    }
    return 0;
}

static inline void failover_mark_(failover_task_ *task, failover_kept_ *kept)
{
    if (kept->low < kept->high && failover_ask_(task, kept) != 0)
        kept->low = kept->high = 0; /* not the memory that was registered: from now on it is compared */
    if (task->newest < 0) {
        for (uint64_t page = 0; page < kept->pages; page++)
            task->versions[kept->first + page] = task->number + 1;
    } else if (kept->low == kept->high) {
        failover_compare_(task, kept, 0, kept->pages);
    } else {
        failover_compare_(task, kept, 0, failover_pages_(kept->low - (uintptr_t)kept->memory));
        failover_compare_(task, kept, (kept->high - (uintptr_t)kept->memory) / FAILOVER_PAGE_, kept->pages);
    }
}

/* Copy the pages of a region that a bank has missed, with their versions. The last page's rest is zeros since the segment was made. */
static inline void failover_copy_(failover_task_ *task, const failover_kept_ *kept, uint32_t bank)
{
    uint64_t *stamps = failover_words_(task, failover_versions_at_(&task->layout.head, bank)) + kept->first;
    const uint64_t *versions = task->versions + kept->first;
    unsigned char *target = task->map + failover_bank_at_(&task->layout.head, bank) + kept->first * FAILOVER_PAGE_;
    for (uint64_t page = 0; page < kept->pages;) {
        uint64_t end = page, offset = page * FAILOVER_PAGE_;
        for (; end < kept->pages && versions[end] > task->held[bank]; end++)
            stamps[end] = versions[end];
        uint64_t limit = end * FAILOVER_PAGE_ < kept->size ? end * FAILOVER_PAGE_ : kept->size;
        if (end > page)
            memcpy(target + offset, kept->memory + offset, limit - offset);
        page = end + 1;
    }
}

/* Lock a bank that is neither the newest nor held by a reader, the one that has missed least; -1 if there is none. */
static inline int failover_free_bank_(int file, const uint64_t *held, int newest)
{
    bool is_tried[FAILOVER_BANKS_] = {false, false, false};
    for (;;) {
        int best = -1;
        for (int bank = 0; bank < FAILOVER_BANKS_; bank++)
            if (bank != newest && !is_tried[bank] && (best < 0 || held[bank] > held[best]))
                best = bank;
        if (best < 0 || failover_lock_(file, F_WRLCK, best) == 0)
            return best;
        is_tried[best] = true;
    }
}

/* Bring a locked bank up to date; SEGMENT.md, "Commit", steps 2 to 6. */
static inline void failover_fill_(failover_task_ *task, uint32_t bank, uint64_t told, const uint64_t *outputs)
{
    uint64_t *record = failover_words_(task, failover_record_at_(bank));
    __atomic_store_n(record, 0, __ATOMIC_RELEASE);
    __atomic_thread_fence(__ATOMIC_SEQ_CST); /* no page is seen written while the record still names a whole commit */
    for (uint32_t index = 0; index < task->count; index++)
        failover_copy_(task, &task->kept[index], bank);
    record[1] = failover_clock_(CLOCK_REALTIME);
    record[2] = failover_clock_(CLOCK_MONOTONIC);
    record[3] = failover_clock_(CLOCK_BOOTTIME);
    record[4] = told;
    record[5] = outputs[0];
    record[6] = outputs[1];
    task->number++;
    __atomic_store_n(record, task->number, __ATOMIC_RELEASE);
    task->held[bank] = task->number;
    task->newest = (int)bank;
    failover_lock_(task->segment, F_UNLCK, (off_t)bank);
    __atomic_store_n(failover_words_(task, FAILOVER_NEWEST_OFFSET_), task->number << FAILOVER_BANK_BITS_ | bank, __ATOMIC_RELEASE);
}

static inline int64_t failover_commit(void)
{
    failover_task_ *task = &failover_the_task_;
    if (task->is_forked)
        return failover_fail_(EPERM, "cannot commit in pid %d, a child of the process that keeps the state: commit there", (int)getpid());
    if (!task->is_open)
        return failover_fail_(EINVAL, "cannot commit: no state is open; call failover_open() first");
    if (__atomic_exchange_n(&task->committing, 1, __ATOMIC_ACQUIRE) != 0)
        return failover_fail_(EBUSY, "cannot commit: another thread is committing");
    uint64_t outputs[2];
    const uint64_t told = failover_outputs_(task, outputs);
    for (uint32_t index = 0; index < task->count; index++)
        failover_mark_(task, &task->kept[index]);
    int bank = failover_free_bank_(task->segment, task->held, task->newest);
    task->is_missing = bank < 0;
    if (bank >= 0)
        failover_fill_(task, (uint32_t)bank, told, outputs);
    if (bank >= 0 && task->guard >= 0 && !task->is_kept)
        task->is_kept = failover_say_(task->guard, FAILOVER_KEEPS_) != -EAGAIN;
    int64_t number = (int64_t)task->number;
    __atomic_store_n(&task->committed, task->number, __ATOMIC_RELEASE);
    __atomic_store_n(&task->committing, 0, __ATOMIC_RELEASE);
    if (bank < 0)
        return failover_fail_(EAGAIN, "not committed: readers hold all banks of the segment; the next commit makes up for it");
    failover_wake_(&task->pulse);
    return number;
}

/* --- Making the segment ------------------------------------------------------------------------------------------------------------------ */

static inline int failover_lay_out_(failover_task_ *task)
{
    failover_head_ *head = &task->layout.head;
    memset(head, 0, sizeof *head);
    memcpy(head->magic, FAILOVER_MAGIC_, sizeof head->magic);
    head->version = FAILOVER_VERSION_;
    head->page_size = FAILOVER_PAGE_;
    head->regions = task->count;
    head->banks = FAILOVER_BANKS_;
    task->layout.entries = (failover_entry_ *)calloc(task->count, sizeof(failover_entry_));
    if (task->layout.entries == NULL)
        return failover_fail_(ENOMEM, "cannot keep %u regions: no memory", task->count);
    for (uint32_t index = 0; index < task->count; index++) {
        failover_kept_ *kept = &task->kept[index];
        failover_entry_ *entry = &task->layout.entries[index];
        kept->first = head->pages;
        head->pages += kept->pages;
        entry->kind = FAILOVER_ARRAY_;
        entry->name_size = (uint32_t)strlen(kept->name);
        entry->address = (index + 1) * FAILOVER_STRIDE_;
        entry->size = kept->size;
        entry->first = kept->first;
        memcpy(entry->name, kept->name, entry->name_size);
    }
    if (head->pages > FAILOVER_MAX_PAGES_)
        return failover_fail_(E2BIG, "cannot keep %llu pages: %llu are possible; keep less", (unsigned long long)head->pages,
                              (unsigned long long)FAILOVER_MAX_PAGES_);
    head->size = failover_bank_at_(head, head->banks);
    if (getrandom(head->lineage, sizeof head->lineage, 0) != (ssize_t)sizeof head->lineage)
        return failover_fail_(EIO, "cannot keep a state: the kernel gave no random number");
    return 0;
}

static inline int failover_make_segment_(failover_task_ *task)
{
    const failover_head_ *head = &task->layout.head;
    void *map = MAP_FAILED;
    task->segment = memfd_create("failover-segment", MFD_CLOEXEC | MFD_ALLOW_SEALING);
    if (task->segment < 0 || ftruncate(task->segment, (off_t)head->size) != 0 ||
        fcntl(task->segment, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW) != 0)
        return failover_fail_(errno, "cannot make a segment of %llu bytes: %s", (unsigned long long)head->size, strerror(errno));
    int again = failover_again_(task->segment, O_RDWR); /* a forked child keeps mappings: they must not keep the locks alive */
    if (again >= 0) {
        map = mmap(NULL, head->size, PROT_READ | PROT_WRITE, MAP_SHARED, again, 0);
        close(again);
    }
    task->source = failover_again_(task->segment, O_RDONLY);
    task->versions = (uint64_t *)calloc(head->pages, sizeof(uint64_t));
    if (map == MAP_FAILED || task->source < 0 || task->versions == NULL)
        return failover_fail_(ENOMEM, "cannot map a segment of %llu bytes: %s", (unsigned long long)head->size, strerror(errno));
    task->map = (unsigned char *)map;
    memcpy(task->map, head, sizeof *head);
    memcpy(task->map + FAILOVER_PAGE_, task->layout.entries, task->count * sizeof(failover_entry_));
    task->newest = -1;
    return 0;
}

/* --- Reading a segment; each number is checked before it is used ------------------------------------------------------------------- */

/* Lock the newest bank for reading and read its record; SEGMENT.md, "Reading". 0, -ENODATA: nothing was committed, -EBUSY, -errno. */
static inline int failover_hold_newest_(int file, uint32_t banks, uint32_t *bank, failover_record_ *record)
{
    for (int attempt = 0; attempt < FAILOVER_ATTEMPTS_; attempt++) {
        uint64_t newest;
        int failed = failover_read_(file, &newest, sizeof newest, FAILOVER_NEWEST_OFFSET_);
        if (failed != 0)
            return failed;
        *bank = (uint32_t)(newest & 0xff);
        if (newest == 0)
            return -ENODATA;
        if (*bank >= banks)
            return -EBADMSG;
        if (failover_lock_(file, F_RDLCK, (off_t)*bank) != 0)
            continue;
        failed = failover_read_(file, record, sizeof *record, failover_record_at_(*bank));
        if (failed == 0 && record->number >= newest >> FAILOVER_BANK_BITS_)
            return 0;
        failover_lock_(file, F_UNLCK, (off_t)*bank);
        if (failed != 0)
            return failed;
    }
    return -EBUSY;
}

/* Read header and table. 0, or -errno with a sentence. */
static inline int failover_read_layout_(int file, const char *name, failover_layout_ *layout)
{
    failover_head_ *head = &layout->head;
    struct stat about;
    uint64_t pages = 0;
    if (failover_read_(file, head, sizeof *head, 0) != 0 || memcmp(head->magic, FAILOVER_MAGIC_, sizeof head->magic) != 0)
        return failover_fail_(EBADMSG, "cannot resume from %s: it is no segment; to begin anew, move it away", name);
    if (head->version != FAILOVER_VERSION_ || head->page_size != FAILOVER_PAGE_)
        return failover_fail_(EPROTONOSUPPORT,
                              "cannot resume from %s: it is of version %u with pages of %u bytes, this header reads version %d with 4096",
                              name, head->version, head->page_size, FAILOVER_VERSION_);
    if (head->regions < 1 || head->regions > FAILOVER_MAX_REGIONS_ || head->banks < FAILOVER_BANKS_ || head->banks > FAILOVER_MAX_BANKS_ ||
        head->pages > FAILOVER_MAX_PAGES_)
        return failover_fail_(EBADMSG, "cannot resume from %s: %u regions in %u banks of %llu pages cannot be; to begin anew, move it away", name,
                              head->regions, head->banks, (unsigned long long)head->pages);
    layout->entries = (failover_entry_ *)calloc(head->regions, sizeof(failover_entry_));
    if (layout->entries == NULL)
        return failover_fail_(ENOMEM, "cannot resume from %s: no memory", name);
    int failed = failover_read_(file, layout->entries, head->regions * sizeof(failover_entry_), FAILOVER_PAGE_);
    for (uint32_t index = 0; index < head->regions && failed == 0; index++) {
        const failover_entry_ *entry = &layout->entries[index];
        if (entry->first != pages || entry->size == 0 || entry->size > FAILOVER_MAX_PAGES_ * FAILOVER_PAGE_ || entry->name_size == 0 ||
            entry->name_size > FAILOVER_MAX_NAME_)
            failed = -EBADMSG;
        pages += failover_pages_(entry->size);
    }
    if (failed != 0 || pages != head->pages || head->size != failover_bank_at_(head, head->banks))
        return failover_fail_(EBADMSG, "cannot resume from %s: its header and its table contradict one another; to begin anew, move it away", name);
    if (fstat(file, &about) != 0 || (uint64_t)about.st_size < head->size)
        return failover_fail_(EBADMSG, "cannot resume from %s: it is cut off, %lld bytes where %llu belong; to begin anew, move it away", name,
                              (long long)about.st_size, (unsigned long long)head->size);
    return 0;
}

/* --- Sums of a file: SEGMENT.md, "A file beside a program" -------------------------------------------------------------------------- */

static inline uint64_t failover_mix_(uint64_t sum, const void *from, uint64_t size)
{
    const unsigned char *next = (const unsigned char *)from;
    for (uint64_t offset = 0; offset < size; offset += sizeof(uint64_t)) {
        uint64_t word;
        memcpy(&word, next + offset, sizeof word);
        sum ^= word;
        sum = (sum << 27 | sum >> 37) * UINT64_C(0x9fb21c651e98df25);
    }
    return sum;
}

static inline uint64_t failover_page_sum_(uint64_t page, const void *content)
{
    return failover_mix_((page + 1) * UINT64_C(0x9e3779b97f4a7c15), content, FAILOVER_PAGE_);
}

static inline uint64_t failover_table_sum_(const failover_layout_ *layout)
{
    return failover_mix_(failover_mix_(0, &layout->head, sizeof layout->head), layout->entries, layout->head.regions * sizeof(failover_entry_));
}

static inline uint64_t failover_record_sum_(uint64_t table_sum, uint64_t generation, const failover_record_ *record)
{
    return failover_mix_(failover_mix_(table_sum, &generation, sizeof generation), record, offsetof(failover_record_, sum));
}

/* Whether a bank of a file is whole: 1, 0, or -errno. */
static inline int failover_is_whole_(int file, const failover_layout_ *layout, uint64_t generation, uint32_t bank, failover_record_ *record)
{
    const failover_head_ *head = &layout->head;
    unsigned char content[4096];
    uint64_t version, sum = 0;
    int failed = failover_read_(file, record, sizeof *record, failover_record_at_(bank));
    for (uint64_t page = 0; page < head->pages && failed == 0 && record->number != 0; page++) {
        failed = failover_read_(file, &version, sizeof version, failover_versions_at_(head, bank) + page * sizeof version);
        if (failed != 0 || version == 0)
            continue;
        if (version > record->number)
            return 0;
        failed = failover_read_(file, content, sizeof content, failover_bank_at_(head, bank) + page * FAILOVER_PAGE_);
        sum += failover_page_sum_(page, content);
    }
    if (failed != 0)
        return failed;
    return record->number != 0 && record->sum == sum + failover_record_sum_(failover_table_sum_(layout), generation, record);
}

/* --- The file beside the program: two banks in turn, each step on the disk before the next --------------------------------------- */

/* 0, or -errno with the step that failed noted for the waiting thread. */
static inline int failover_step_(failover_task_ *task, int outcome, const char *step)
{
    if (outcome < 0)
        __atomic_store_n(&task->step, step, __ATOMIC_RELAXED);
    return outcome;
}

/* Open a fresh file; close it, or put it in the place of the old one. No fork() sees that half done. */
static inline int failover_open_fresh_(failover_task_ *task)
{
    pthread_mutex_lock(&failover_files_);
    task->fresh = openat(task->folder, task->fresh_name, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC | O_NOFOLLOW, 0600);
    int outcome = task->fresh < 0 ? -errno : task->fresh;
    pthread_mutex_unlock(&failover_files_);
    return outcome;
}

static inline void failover_end_fresh_(failover_task_ *task, bool is_taken)
{
    pthread_mutex_lock(&failover_files_);
    close(is_taken ? task->file : task->fresh);
    task->file = is_taken ? task->fresh : task->file;
    task->fresh = -1;
    pthread_mutex_unlock(&failover_files_);
}

/* Begin a file aside, with room for two banks; it takes the place of the old one when it holds a commit. Answers it, or -errno. */
static inline int failover_begin_file_(failover_task_ *task)
{
    const failover_head_ *head = &task->layout.head;
    int file = failover_open_fresh_(task);
    if (file < 0)
        return failover_step_(task, file, "making a file");
    int failed = failover_lock_(file, F_WRLCK, FAILOVER_OWNER_BYTE_);
    if (failed == 0 && ftruncate(file, (off_t)head->size) != 0)
        failed = -errno;
    if (failed == 0)
        failed = -posix_fallocate(file, 0, (off_t)failover_bank_at_(head, 2));
    if (failed == 0)
        failed = failover_write_(file, head, sizeof *head, 0);
    if (failed == 0)
        failed = failover_write_(file, &task->generation, sizeof task->generation, FAILOVER_GENERATION_OFFSET_);
    if (failed == 0)
        failed = failover_write_(file, task->layout.entries, head->regions * sizeof(failover_entry_), FAILOVER_PAGE_);
    if (failed != 0) {
        failover_end_fresh_(task, false);
        return failover_step_(task, failed, "making room in a file");
    }
    memset(task->file_held, 0, sizeof task->file_held);
    memset(task->sums, 0, head->pages * sizeof(uint64_t));
    task->sum = 0;
    task->file_newest = -1;
    return file;
}

/* Copy a few pages that follow one another from the segment to the file, with their versions. */
static inline int failover_transfer_(failover_task_ *task, uint32_t from, int file, uint32_t bank, uint64_t page, uint64_t count)
{
    const failover_head_ *head = &task->layout.head;
    int failed = failover_read_(task->source, task->chunk, count * FAILOVER_PAGE_, failover_bank_at_(head, from) + page * FAILOVER_PAGE_);
    if (failed != 0)
        return failover_step_(task, failed, "reading the segment");
    for (uint64_t index = 0; index < count; index++) {
        uint64_t sum = failover_page_sum_(page + index, task->chunk + index * FAILOVER_PAGE_);
        task->sum += sum - task->sums[page + index];
        task->sums[page + index] = sum;
    }
    failed = failover_write_(file, task->chunk, count * FAILOVER_PAGE_, failover_bank_at_(head, bank) + page * FAILOVER_PAGE_);
    if (failed == 0)
        failed = failover_write_(file, task->stamps + page, count * sizeof(uint64_t), failover_versions_at_(head, bank) + page * sizeof(uint64_t));
    return failover_step_(task, failed, "writing pages");
}

static inline int failover_transfer_all_(failover_task_ *task, uint32_t from, int file, uint32_t bank)
{
    const uint64_t since = task->file_held[bank], pages = task->layout.head.pages;
    for (uint64_t page = 0; page < pages;) {
        uint64_t end = page;
        while (end < pages && end - page < FAILOVER_CHUNK_PAGES_ && task->stamps[end] > since)
            end++;
        if (end > page) {
            int failed = failover_transfer_(task, from, file, bank, page, end - page);
            if (failed != 0)
                return failed;
            page = end;
        } else {
            page++;
        }
    }
    return 0;
}

/* Bring a locked bank of the file up to date with a held bank of the segment. The word that names it comes later. */
static inline int failover_write_bank_(failover_task_ *task, uint32_t from, failover_record_ *record, int file, uint32_t bank)
{
    const uint64_t none = 0;
    const failover_head_ *head = &task->layout.head;
    int failed = failover_read_(task->source, task->stamps, head->pages * sizeof(uint64_t), failover_versions_at_(head, from));
    if (failed != 0)
        return failover_step_(task, failed, "reading the segment");
    failed = failover_step_(task, failover_write_(file, &none, sizeof none, failover_record_at_(bank)), "writing a record");
    if (failed == 0)
        failed = failover_transfer_all_(task, from, file, bank);
    if (failed != 0)
        return failed;
    record->sum = task->sum + failover_record_sum_(task->table_sum, task->generation, record);
    return failover_step_(task, failover_write_(file, record, sizeof *record, failover_record_at_(bank)), "writing a record");
}

/* Make a bank the newest on the disk: first what it holds, then the word that names it. */
static inline int failover_name_bank_(failover_task_ *task, int file, uint32_t bank, uint64_t number)
{
    const uint64_t newest = number << FAILOVER_BANK_BITS_ | bank;
    int failed = failover_step_(task, failover_sync_(file), "fdatasync");
    failover_lock_(file, F_UNLCK, (off_t)bank);
    if (failed == 0)
        failed = failover_step_(task, failover_write_(file, &newest, sizeof newest, FAILOVER_NEWEST_OFFSET_), "writing the newest word");
    if (failed == 0)
        failed = failover_step_(task, failover_sync_(file), "fdatasync");
    return failed;
}

static inline int failover_adopt_file_(failover_task_ *task, int file)
{
    if (fsync(file) != 0 || renameat(task->folder, task->fresh_name, task->folder, task->file_name) != 0 || fsync(task->folder) != 0)
        return failover_step_(task, -errno, "putting a file in its place");
    failover_end_fresh_(task, true);
    task->is_file_ours = true;
    return 0;
}

/* Write a commit that is held. After an error the file is not written any more (who knows what the disk has): the next attempt begins
 * another one aside, and the old one stands until then. */
static inline int failover_store_held_(failover_task_ *task, uint32_t from, failover_record_ *record)
{
    int file = task->is_file_ours ? task->file : failover_begin_file_(task);
    if (file < 0)
        return file;
    int bank = failover_free_bank_(file, task->file_held, task->file_newest);
    if (bank < 0) {
        if (file != task->file)
            failover_end_fresh_(task, false);
        return -EBUSY;
    }
    int failed = failover_write_bank_(task, from, record, file, (uint32_t)bank);
    if (failed == 0)
        failed = failover_name_bank_(task, file, (uint32_t)bank, record->number);
    if (failed == 0 && file != task->file)
        failed = failover_adopt_file_(task, file);
    if (failed != 0) {
        if (file != task->file)
            failover_end_fresh_(task, false);
        else
            failover_lock_(file, F_UNLCK, bank);
        task->is_file_ours = false;
        return failed;
    }
    task->file_held[bank] = record->number;
    task->file_newest = bank;
    return 0;
}

/* Write the newest commit to the file: its number, or -errno. */
static inline int64_t failover_store_(failover_task_ *task)
{
    uint32_t from = 0;
    failover_record_ record;
    memset(&record, 0, sizeof record);
    int failed = failover_hold_newest_(task->source, FAILOVER_BANKS_, &from, &record);
    if (failed != 0)
        return failover_step_(task, failed, "reading the segment");
    failed = failover_store_held_(task, from, &record);
    failover_lock_(task->source, F_UNLCK, (off_t)from);
    return failed != 0 ? failed : (int64_t)record.number;
}

/* The thread that writes the newest commit again and again. It rests nine times as long as a write took, at most 0.1 s: it takes a tenth of
 * the disk's time, and that is what a SIGKILL loses without failover_wait(). */
static inline void *failover_record_all_(void *argument)
{
    failover_task_ *task = (failover_task_ *)argument;
    for (;;) {
        uint32_t closing = __atomic_load_n(&task->closing, __ATOMIC_ACQUIRE);
        uint32_t pulse = __atomic_load_n(&task->pulse, __ATOMIC_ACQUIRE), hurry = __atomic_load_n(&task->hurry, __ATOMIC_ACQUIRE);
        if (__atomic_load_n(&task->committed, __ATOMIC_ACQUIRE) <= __atomic_load_n(&task->durable, __ATOMIC_RELAXED)) {
            if (closing)
                return NULL;
            failover_sleep_(&task->pulse, pulse, UINT64_MAX);
            continue;
        }
        uint64_t began = failover_clock_(CLOCK_MONOTONIC), rest = 1000000;
        int64_t number = failover_store_(task);
        if (number >= 0) {
            rest = 9 * (failover_clock_(CLOCK_MONOTONIC) - began);
            rest = rest < 100000000 ? rest : 100000000;
            __atomic_store_n(&task->trouble, 0, __ATOMIC_RELAXED);
            __atomic_store_n(&task->durable, (uint64_t)number, __ATOMIC_RELEASE);
            failover_wake_(&task->safe);
        } else if (number != -EBUSY) {
            __atomic_store_n(&task->trouble, (uint32_t)-number, __ATOMIC_RELEASE);
            rest = 500000000;
            if (closing)
                return NULL;
        }
        failover_sleep_(&task->hurry, hurry, rest);
    }
}

static inline int failover_not_safe_(const failover_task_ *task, int code, uint64_t number)
{
    uint32_t trouble = __atomic_load_n(&task->trouble, __ATOMIC_ACQUIRE);
    if (trouble == 0)
        return failover_fail_(code, "commit %llu is not safe yet: the disk has taken commit %llu", (unsigned long long)number,
                              (unsigned long long)__atomic_load_n(&task->durable, __ATOMIC_ACQUIRE));
    return failover_fail_(code, "commit %llu is not safe: %s of %s: %s", (unsigned long long)number,
                          __atomic_load_n(&task->step, __ATOMIC_RELAXED), task->file_name, strerror((int)trouble));
}

static inline int failover_wait(int timeout_ms)
{
    failover_task_ *task = &failover_the_task_;
    if (!task->is_open || task->is_forked)
        return failover_fail_(EINVAL, "cannot wait: this process has no state open");
    if (task->is_missing)
        return failover_fail_(EAGAIN, "the last commit was not made: readers held all banks of the segment; commit again");
    const uint64_t number = __atomic_load_n(&task->committed, __ATOMIC_ACQUIRE), second = 1000000000u;
    const uint64_t limit = timeout_ms < 0 ? UINT64_MAX : failover_clock_(CLOCK_MONOTONIC) + (uint64_t)timeout_ms * 1000000u;
    if (task->guard >= 0)
        return failover_wait_for_standby_(task, number, limit);
    for (;;) {
        uint32_t safe = __atomic_load_n(&task->safe, __ATOMIC_ACQUIRE);
        if (__atomic_load_n(&task->durable, __ATOMIC_ACQUIRE) >= number)
            return 0;
        uint64_t now = failover_clock_(CLOCK_MONOTONIC);
        if (now >= limit)
            return failover_not_safe_(task, ETIMEDOUT, number);
        failover_wake_(&task->hurry);
        failover_sleep_(&task->safe, safe, limit - now < second ? limit - now : second);
    }
}

/* --- Going on from what is stored ----------------------------------------------------------------------------------------------------- */

/* lab.r1.mapper.segment for /lab/r1/mapper. */
static inline int failover_name_file_(failover_task_ *task, const char *name)
{
    while (*name == '/')
        name++;
    size_t size = strlen(name);
    while (size > 0 && name[size - 1] == '/')
        size--;
    if (size == 0 || size > 200)
        return failover_fail_(EINVAL, "cannot keep a state named '%.220s': a name has 1 to 200 bytes", name);
    if (!failover_is_utf8_(name))
        return failover_fail_(EILSEQ, "cannot keep a state: its name, of %zu bytes, is no UTF-8", size);
    snprintf(task->file_name, sizeof task->file_name, "%.*s.segment", (int)size, name);
    for (char *next = task->file_name; *next != '\0'; next++)
        if (*next == '/')
            *next = '.';
    snprintf(task->fresh_name, sizeof task->fresh_name, "%s.new", task->file_name);
    return 0;
}

/* Open the file and make sure that no other process has it. An empty one is made where there is none. */
static inline int failover_own_file_(failover_task_ *task)
{
    struct stat opened, named;
    for (int attempt = 0; attempt < FAILOVER_ATTEMPTS_; attempt++) {
        task->file = openat(task->folder, task->file_name, O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
        if (task->file < 0)
            return failover_fail_(errno, "cannot keep a state in %s: %s", task->file_name, strerror(errno));
        int failed = failover_lock_(task->file, F_WRLCK, FAILOVER_OWNER_BYTE_);
        if (failed == -EAGAIN || failed == -EACCES)
            return failover_fail_(EBUSY, "cannot keep a state in %s: another process has it; end that one, or use another name", task->file_name);
        if (failed != 0)
            return failover_fail_(-failed, "cannot keep a state in %s: no lock: %s", task->file_name, strerror(-failed));
        if (fstat(task->file, &opened) == 0 && fstatat(task->folder, task->file_name, &named, 0) == 0 && opened.st_ino == named.st_ino)
            return opened.st_size != 0;
        close(task->file); /* its owner has put another one in its place meanwhile */
        task->file = -1;
    }
    return failover_fail_(EBUSY, "cannot keep a state in %s: other processes replace it again and again", task->file_name);
}

__attribute__((format(printf, 2, 3))) static inline void failover_note_(failover_task_ *task, const char *format, ...)
{
    size_t used = strlen(task->notes);
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(task->notes + used, sizeof task->notes - used, format, arguments);
    va_end(arguments);
}

static inline const failover_entry_ *failover_entry_named_(const failover_layout_ *layout, const char *name)
{
    for (uint32_t index = 0; index < layout->head.regions; index++) {
        const failover_entry_ *entry = &layout->entries[index];
        if (entry->name_size == strlen(name) && memcmp(entry->name, name, entry->name_size) == 0)
            return entry;
    }
    return NULL;
}

/* Refuse a state that does not fit, and note what is new and what is gone. */
static inline int failover_match_(failover_task_ *task, const failover_layout_ *stored)
{
    uint32_t found = 0;
    for (uint32_t index = 0; index < task->count; index++) {
        const failover_kept_ *kept = &task->kept[index];
        const failover_entry_ *entry = failover_entry_named_(stored, kept->name);
        if (entry != NULL && entry->size != kept->size)
            return failover_fail_(EINVAL, "cannot resume from %s: region '%s' has %llu bytes there and %llu here; give it another name to begin it anew",
                                  task->file_name, kept->name, (unsigned long long)entry->size, (unsigned long long)kept->size);
        if (entry == NULL)
            failover_note_(task, "region '%.80s' is new and begins as it is\n", kept->name);
        found += entry != NULL;
    }
    if (found < stored->head.regions)
        failover_note_(task, "%u regions of the stored state are not kept any more\n", stored->head.regions - found);
    return 0;
}

/* The newest whole bank of a file: 0, or -errno with a sentence. A damaged one is passed over, and that is noted. */
static inline int failover_choose_(failover_task_ *task, const failover_layout_ *stored, uint32_t *bank, failover_record_ *record)
{
    uint64_t newest = 0;
    int best = -1;
    int failed = failover_read_(task->file, &newest, sizeof newest, FAILOVER_NEWEST_OFFSET_);
    if (failed == 0)
        failed = failover_read_(task->file, &task->generation, sizeof task->generation, FAILOVER_GENERATION_OFFSET_);
    *bank = (uint32_t)(newest & 0xff);
    if (failed == 0 && *bank < stored->head.banks && failover_is_whole_(task->file, stored, task->generation, *bank, record) == 1 &&
        record->number == newest >> FAILOVER_BANK_BITS_)
        return 0;
    for (uint32_t other = 0; other < stored->head.banks && failed == 0; other++) {
        failover_record_ found;
        if (failover_is_whole_(task->file, stored, task->generation, other, &found) != 1 || (best >= 0 && found.number < record->number))
            continue;
        *record = found;
        best = (int)other;
    }
    if (best < 0)
        return failover_fail_(EBADMSG, "cannot resume from %s: it is damaged, and holds no whole commit; to begin anew, move it away", task->file_name);
    if (record->number != newest >> FAILOVER_BANK_BITS_) /* else the disk gave at the second asking what it had not at the first */
        failover_note_(task, "the newest commit was damaged; commit %llu took its place\n", (unsigned long long)record->number);
    *bank = (uint32_t)best;
    return 0;
}

/* Fill regions from a bank that is whole; after an error they are as they were. What is read first goes to a bank of our own segment: the
 * first commit writes all of that anyway. */
static inline int failover_fill_regions_(failover_task_ *task, int file, const failover_layout_ *stored, uint32_t bank)
{
    unsigned char *aside = task->map + failover_bank_at_(&task->layout.head, 0);
    for (uint32_t index = 0; index < task->count; index++) {
        const failover_kept_ *kept = &task->kept[index];
        const failover_entry_ *entry = failover_entry_named_(stored, kept->name);
        int failed = entry == NULL ? 0
                                   : failover_read_(file, aside + kept->first * FAILOVER_PAGE_, entry->size,
                                                    failover_bank_at_(&stored->head, bank) + entry->first * FAILOVER_PAGE_);
        if (failed != 0)
            return failover_fail_(-failed, "cannot resume from %s: %s", task->file_name, strerror(-failed));
    }
    for (uint32_t index = 0; index < task->count; index++) {
        const failover_kept_ *kept = &task->kept[index];
        if (failover_entry_named_(stored, kept->name) != NULL)
            memcpy(kept->memory, aside + kept->first * FAILOVER_PAGE_, kept->size);
    }
    return 0;
}

/* Note the state that was resumed, for later questions. */
static inline void failover_tell_(failover_task_ *task, uint64_t commit, uint64_t generation, uint64_t age_ns, const char *why)
{
    task->is_resumed = true;
    task->resumption.commit = commit;
    task->resumption.generation = generation;
    task->resumption.epoch = task->epoch;
    task->resumption.age_s = (double)age_ns / 1e9;
    task->resumption.why = why;
    task->resumption.robot = task->robot;
    task->resumption.notes = task->notes;
}

static inline int failover_load_(failover_task_ *task)
{
    failover_layout_ stored;
    failover_record_ record;
    uint32_t bank = 0;
    memset(&stored, 0, sizeof stored);
    memset(&record, 0, sizeof record);
    int failed = failover_read_layout_(task->file, task->file_name, &stored);
    if (failed == 0)
        failed = failover_match_(task, &stored);
    if (failed == 0)
        failed = failover_choose_(task, &stored, &bank, &record);
    if (failed == 0)
        failed = failover_fill_regions_(task, task->file, &stored, bank);
    free(stored.entries);
    if (failed != 0)
        return failed;
    const uint64_t now = failover_clock_(CLOCK_REALTIME);
    task->generation++;
    failover_tell_(task, record.number, task->generation, now > record.realtime ? now - record.realtime : 0, "restarted");
    return 0;
}

/* Take the state that the guard handed over: a segment of which the newest commit is it. */
static inline int failover_load_handed_(failover_task_ *task, const failover_begin_ *begin, int handed)
{
    static const char *const reasons[] = {"", "restarted", "taken over", "handed over"};
    failover_layout_ stored;
    failover_record_ record;
    uint32_t bank = 0;
    memset(&stored, 0, sizeof stored);
    memset(&record, 0, sizeof record);
    int file = failover_again_(handed, O_RDONLY); /* the lock must be ours */
    int failed = file < 0 ? failover_fail_(errno, "cannot resume from %s: %s", task->file_name, strerror(errno)) : 0;
    if (failed == 0)
        failed = failover_read_layout_(file, task->file_name, &stored);
    if (failed == 0)
        failed = failover_match_(task, &stored);
    if (failed == 0) {
        failed = failover_hold_newest_(file, stored.head.banks, &bank, &record);
        if (failed != 0)
            failover_fail_(-failed, "cannot resume from %s: cannot read a commit from it: %s", task->file_name, strerror(-failed));
    }
    if (failed == 0)
        failed = failover_fill_regions_(task, file, &stored, bank);
    if (file >= 0)
        close(file);
    free(stored.entries);
    if (failed != 0)
        return failed;
    memcpy(task->robot, begin->robot, sizeof task->robot);
    failover_tell_(task, record.number, begin->generation, begin->age_ns, reasons[begin->why]);
    return 0;
}

/* Begin as the guard says, when it says so. */
static inline int failover_begin_guarded_(failover_task_ *task)
{
    failover_packet_ packet;
    int descriptors[2] = {-1, -1};
    memset(&packet, 0, sizeof packet);
    snprintf(task->file_name, sizeof task->file_name, "the agent's checkpoint");
    int failed = failover_hear_begin_(task, &packet, descriptors);
    const char *token = getenv("FAILOVER_EPOCH");
    task->token = token != NULL && strlen(token) == (size_t)FAILOVER_DIGITS_ ? token : NULL;
    task->epoch = packet.begin.epoch;
    if (failed == 0)
        failed = failover_count_output_(task, &packet.begin, descriptors[0]);
    if (failed == 0 && packet.begin.why != 0)
        failed = failover_load_handed_(task, &packet.begin, descriptors[1]);
    for (int index = 0; index < 2; index++)
        if (descriptors[index] >= 0)
            close(descriptors[index]);
    return failed;
}

/* --- Open and close ---------------------------------------------------------------------------------------------------------------------- */

static inline void failover_release_(failover_task_ *task)
{
    const int files[] = {task->segment, task->source, task->folder, task->file, task->fresh, task->guard};
    const bool is_registered = task->is_registered;
    failover_stop_following_(task);
    for (size_t index = 0; index < sizeof files / sizeof *files; index++)
        if (files[index] >= 0)
            close(files[index]);
    if (task->map != NULL)
        munmap(task->map, task->layout.head.size);
    if (task->counters != NULL)
        munmap((void *)(uintptr_t)task->counters, FAILOVER_PAGE_);
    free(task->kept);
    free(task->layout.entries);
    free(task->versions);
    free(task->sums);
    free(task->stamps);
    free(task->chunk);
    memset(task, 0, sizeof *task);
    task->is_registered = is_registered;
}

static inline void failover_forking_(void) { pthread_mutex_lock(&failover_files_); }

static inline void failover_fork_made_(void) { pthread_mutex_unlock(&failover_files_); }

/* In a child: give up descriptors, since locks belong to openings, which it shares with its parent. */
static inline void failover_forked_(void)
{
    failover_task_ *task = &failover_the_task_;
    pthread_mutex_unlock(&failover_files_);
    if (!task->has_descriptors || task->is_forked)
        return;
    const int files[] = {task->segment, task->source, task->folder, task->file, task->fresh, task->faults, task->pagemap, task->guard};
    task->is_forked = true;
    for (size_t index = 0; index < sizeof files / sizeof *files; index++)
        if (files[index] >= 0)
            close(files[index]);
}

static inline int failover_close(void)
{
    failover_task_ *task = &failover_the_task_;
    if (!task->is_open || task->is_forked)
        return 0;
    int outcome = 0;
    __atomic_store_n(&task->closing, 1, __ATOMIC_RELEASE);
    failover_wake_(&task->pulse);
    failover_wake_(&task->hurry);
    if (task->has_recorder)
        pthread_join(task->recorder, NULL);
    if (task->guard < 0 && task->durable < task->number)
        outcome = failover_not_safe_(task, task->trouble != 0 ? (int)task->trouble : EIO, task->number);
    failover_release_(task);
    return outcome;
}

static inline void failover_at_exit_(void) { failover_close(); }

/* Start the recorder with all signals blocked: they are the program's. */
static inline int failover_start_recorder_(failover_task_ *task)
{
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    int failed = pthread_create(&task->recorder, NULL, failover_record_all_, task);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    task->has_recorder = failed == 0;
    return failed == 0 ? 0 : failover_fail_(failed, "cannot start the thread that writes %s: %s", task->file_name, strerror(failed));
}

/* A state in a file beside the program: read what is there, and start the recorder. */
static inline int failover_begin_beside_(failover_task_ *task, const char *name)
{
    const char *folder = getenv("FAILOVER_STATE"), *chosen = getenv("FAILOVER_COMPONENT");
    const uint64_t pages = task->layout.head.pages;
    int failed = failover_name_file_(task, chosen != NULL && *chosen != '\0' ? chosen : name);
    if (failed != 0)
        return failed;
    folder = folder != NULL && *folder != '\0' ? folder : ".";
    task->folder = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (task->folder < 0)
        return failover_fail_(errno, "cannot keep a state in folder %.200s: %s", folder, strerror(errno));
    task->table_sum = failover_table_sum_(&task->layout);
    task->sums = (uint64_t *)calloc(pages, sizeof(uint64_t));
    task->stamps = (uint64_t *)calloc(pages, sizeof(uint64_t));
    task->chunk = (unsigned char *)malloc(FAILOVER_CHUNK_PAGES_ * FAILOVER_PAGE_);
    if (task->sums == NULL || task->stamps == NULL || task->chunk == NULL)
        return failover_fail_(ENOMEM, "cannot keep %llu pages: no memory", (unsigned long long)pages);
    task->generation = 1;
    failed = failover_own_file_(task);
    if (failed == 1)
        failed = failover_load_(task);
    return failed != 0 ? failed : failover_start_recorder_(task);
}

static inline int failover_set_out_(failover_task_ *task, const char *name)
{
    int failed = failover_lay_out_(task);
    if (failed == 0)
        failed = failover_make_segment_(task);
    if (failed == 0)
        failed = failover_connect_(task);
    if (failed != 0)
        return failed < 0 ? failed : failover_begin_guarded_(task);
    return failover_begin_beside_(task, name);
}

static inline int failover_open(const char *name)
{
    failover_task_ *task = &failover_the_task_;
    if (task->is_open)
        return failover_fail_(EBUSY, "cannot open state '%.200s': one is open, and a process keeps one", name == NULL ? "" : name);
    task->segment = task->source = task->folder = task->file = task->fresh = task->faults = task->pagemap = task->guard = -1;
    task->has_descriptors = true;
    if (!task->is_registered) {
        task->is_registered = true;
        pthread_atfork(failover_forking_, failover_fork_made_, failover_forked_);
        atexit(failover_at_exit_);
    }
    int failed = task->refusal != 0 ? failover_fail_(-task->refusal, "%s", task->refused) : 0;
    if (failed == 0 && task->count == 0)
        failed = failover_fail_(EINVAL, "cannot open state '%.200s': no region is registered", name == NULL ? "" : name);
    if (failed == 0)
        failed = failover_set_out_(task, name == NULL ? "" : name);
    if (failed != 0) {
        failover_release_(task);
        return failed;
    }
    failover_follow_(task);
    task->is_open = true;
    if (task->is_resumed && task->on_resume != NULL)
        task->on_resume(&task->resumption, task->context);
    return task->is_resumed;
}

#ifdef __cplusplus
} /* extern "C" */

/* --- C++ ----------------------------------------------------------------------------------------------------------------------------------
 *
 *     failover::kept<Pid> pid("pid", Pid{20.0, 0.0});
 *     failover::task task("heater");
 *     if (!task)
 *         std::cerr << failover_error() << '\n';
 *     for (;;) {
 *         step(*pid);
 *         task.commit();
 *     }
 */

#include <type_traits>

namespace failover {

/* A value that survives. It is made before the task and outlives it, as the order of declaration has it. */
template <class T> class kept {
    static_assert(std::is_trivially_copyable<T>::value, "what is kept is copied byte by byte: no strings, vectors, pointers to elsewhere");

  public:
    explicit kept(const char *name, const T &initial = T()) : value_(initial) { failover_region(&value_, sizeof value_, name); }
    kept(const kept &) = delete;
    kept &operator=(const kept &) = delete;
    kept &operator=(const T &value)
    {
        value_ = value;
        return *this;
    }
    T &operator*() { return value_; }
    const T &operator*() const { return value_; }
    T *operator->() { return &value_; }
    const T *operator->() const { return &value_; }

  private:
    T value_;
};

/* Say that `count` values at `memory` must survive: the content of a vector that keeps its size, say. */
template <class T> inline int region(T *memory, size_t count, const char *name)
{
    static_assert(std::is_trivially_copyable<T>::value, "what is kept is copied byte by byte");
    return failover_region(memory, count * sizeof(T), name);
}

/* The state of this process, from its opening to the end of the scope. Errors are answered, not thrown. */
class task {
  public:
    explicit task(const char *name) : outcome_(failover_open(name)) {}
    ~task()
    {
        if (outcome_ >= 0)
            failover_close();
    }
    task(const task &) = delete;
    task &operator=(const task &) = delete;
    explicit operator bool() const { return outcome_ >= 0; }
    int outcome() const { return outcome_; }
    const failover_resumption *resumed() const { return outcome_ > 0 ? failover_resumed() : nullptr; }
    int64_t commit() { return failover_commit(); }
    int wait(int timeout_ms = -1) { return failover_wait(timeout_ms); }
    uint64_t epoch() const { return failover_epoch(); }

  private:
    int outcome_;
};

} // namespace failover
#endif

#endif
