/* failover_board.h: the team's board from C or C++. One header; needs libc and Linux, nothing else.
 *
 *     typedef struct { float x, y; uint32_t seen; } Ball;
 *
 *     fb_board *board = fb_open(NULL);                                 this robot's board
 *     fb_item *ball = fb_find(board, "ball", sizeof(Ball), 0);         an item of it
 *     fb_put(ball, &mine);                                             this robot's value
 *     int64_t age = fb_get(ball, FB_ROBOT("robot2"), &theirs, &age_max);
 *     if (age < 0)
 *         fprintf(stderr, "%s\n", fb_error());
 *
 * An item is a state: a put replaces the value, a get reads the newest one. No put and no get waits for another process, and a value is
 * never torn, whichever process is killed. Compile with -pthread. In C, include this header before all others or define _GNU_SOURCE.
 * docs/c.md is the manual; BOARD.md (in failover/core/board/) says what the bytes are.
 *
 * Functions that return int or int64_t return a negative errno when they fail; those that return a pointer return NULL and set errno.
 * fb_error() then says in a sentence what was tried, on what, why not. Nothing here prints or aborts.
 *
 * Threads: any number may get and wait, also by one handle. Puts of one item come from one thread at a time. fb_close() comes last.
 *
 * Whenever the board is another one (its agent made it anew, or the program goes on on another robot after a takeover), the next call opens
 * the board of the robot where the program runs then, finds the item there and takes its lock anew.
 *
 * SPDX-License-Identifier: MIT */

#ifndef FAILOVER_BOARD_H
#define FAILOVER_BOARD_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1
#endif

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>

#ifndef F_OFD_SETLK
#error "failover_board.h: include it before all other headers, or compile with -D_GNU_SOURCE"
#endif
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "failover_board.h: this machine stores the high byte first, which boards do not"
#endif

#ifndef FB_SUMS
/* 1: write a sum with each put, and examine that of each get. Readers in Python need it where processors reorder loads. */
#if defined(__x86_64__) || defined(__i386__)
#define FB_SUMS 0
#else
#define FB_SUMS 1
#endif
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* --- The contract --------------------------------------------------------------------------------------------------------------- */

typedef struct fb_board fb_board;
typedef struct fb_item fb_item;
typedef struct fb_component fb_component;

/* Whose item: a robot by its name; this robot's own. */
#define FB_ROBOT(name) (name)
#define FB_OWN ((const char *)NULL)

enum { FB_BYTES = 0, FB_STRUCT = 1, FB_MSGPACK = 2, FB_JSON = 3 }; /* kinds of values */
enum { FB_URGENT = 1, FB_NOT_SENT = 2, FB_KEPT = 4, FB_FINITE = 16 }; /* flags of an item */

/* What a get finds besides the value. Ages are in nanoseconds since the value was produced. */
typedef struct fb_reading {
    int64_t age_ns;     /* at least */
    int64_t age_max_ns; /* at most; INT64_MAX where no bound is known */
    uint64_t number;    /* of the put; to be given to fb_wait() */
    uint32_t size;      /* bytes of the value */
    bool stale;         /* it may be older than the item's bound */
} fb_reading;

/* An item to add. All that is 0 has its default. */
typedef struct fb_declaration {
    const char *name; /* 1 to 63 bytes of UTF-8 */
    uint32_t size;    /* most bytes of a value: 1 to 4096; of a private item up to 65536 */
    uint32_t kind;    /* FB_BYTES … */
    uint32_t banks;   /* 2 to 8; 0: 2. More, where large values are put very often */
    uint32_t period, phase; /* in rounds of the radio; period 0: 1 */
    uint32_t flags;         /* FB_URGENT … */
    bool is_private;        /* other robots do not get it */
    int64_t bound_ns;       /* past it a reading is stale; 0: by the formula */
    const char *type;       /* of an FB_STRUCT: its text, "{x:f4,y:f4,seen:u4}" (BOARD.md); NULL for the other kinds */
} fb_declaration;

/* Open this robot's board. `directory`: where it is; NULL: $FAILOVER_BOARD, else the agent's, else one that programs of this user share
 * without an agent: the first user makes it, the last one removes it. NULL on failure. */
static inline fb_board *fb_open(const char *directory);

/* A handle of an item, good until fb_close(). `size`: bytes of your type: of a struct exactly those that are declared, of other kinds as many
 * as the item may hold. `digest`: of the type, from `failover board header`; 0: not examined. NULL on failure. */
static inline fb_item *fb_find(fb_board *board, const char *name, size_t size, uint64_t digest);

/* Read a robot's newest value. Returns its age in ns (at least); `age_max`, unless NULL, gets the most that it can be.
 * -ENODATA: never written. -EAGAIN: it was written 16 times meanwhile (give it more banks). -ENOENT: no such robot, or the robot has no such
 * item. -EACCES: it is for a user whom this robot does not have. */
static inline int64_t fb_get(fb_item *item, const char *robot, void *value, int64_t *age_max);

/* The same; 0, and more about the value. */
static inline int fb_get_reading(fb_item *item, const char *robot, void *value, fb_reading *reading);

/* Put a value of this robot: 0. -EBUSY: another process writes this item. -EACCES: team.toml names another user, who alone may put it. */
static inline int fb_put(fb_item *item, const void *value);

/* The same of a value that was measured at an instant: ns of CLOCK_BOOTTIME, as this process reads that clock. */
static inline int fb_put_at(fb_item *item, const void *value, int64_t measured_ns);

/* The same of a value of fewer bytes than the item may hold. `measured_ns`: FB_NOW, or as above. */
#define FB_NOW INT64_MIN
static inline int fb_put_sized(fb_item *item, const void *value, size_t size, int64_t measured_ns);

/* Wait until the item's newest put is another one than number `after` (0: until there is one): 0. -ETIMEDOUT. `timeout` NULL: no limit. */
static inline int fb_wait(fb_item *item, const char *robot, uint64_t after, const struct timespec *timeout);

/* An item to wait for among others. */
typedef struct fb_watched {
    fb_item *item;
    const char *robot; /* FB_ROBOT("robot2"), or FB_OWN */
    uint64_t after;    /* number of the newest put that is known; 0: of none */
} fb_watched;

/* Wait, in one sleep, until the newest put of any of 1 to 128 items is another one than its `after`: the place of such an item, from 0. The
 * look begins behind the one that this thread got last: of items that are put all the time each has its turn. -ETIMEDOUT. `timeout` NULL: no
 * limit. */
static inline int fb_wait_any(const fb_watched *watched, size_t count, const struct timespec *timeout);

/* Read the value with the least age, of this robot and all that are running: 0. `robot`, unless NULL, has 65 bytes and gets the name of the
 * robot. -ENODATA: none of them has put it. */
static inline int fb_youngest(fb_item *item, void *value, fb_reading *reading, char *robot);

/* Read all items of all robots that were ever put: `told` is called for each, when all are read. Each value is whole; all ages are of one
 * instant. Returns how many there were. `value` has `reading->size` bytes, and is the caller's during the call only. */
typedef void fb_told(void *context, const char *robot, const char *item, const void *value, const fb_reading *reading);
static inline int fb_snapshot(fb_board *board, fb_told *told, void *context);

/* Declare an item while the board is in use: 0, also where it is declared alike already. -EEXIST: declared otherwise. */
static inline int fb_add(fb_board *board, const fb_declaration *wanted);

/* Take an item of this robot off the board: 0. Its name is free then, and other robots lose it. -ENOENT: there is none. -EACCES: this user
 * may not. A handle of it finds an item again that is added under its name. */
static inline int fb_remove(fb_board *board, const char *name);

/* An item at the robot that runs a component, wherever that is: to read; it follows a takeover. `item`: from fb_find(); `component`: its
 * path, "/lab/robot1/mapper". Good until fb_close(), for one thread at a time. An agent is needed. NULL on failure. */
static inline fb_component *fb_of(fb_item *item, const char *component);

/* The component's newest value: 0. Between a takeover and the first put of the new copy it is what the copy before put last, as old as
 * it is. -ENODATA: the copy that runs has not put it, and this handle has read none of a copy before. -ENOENT: the agent knows no
 * robot that runs the component, or no agent runs here. */
static inline int fb_component_get(fb_component *component, void *value, fb_reading *reading);

/* The same once its number is another one than `after` (0: once there is a value); it follows a takeover meanwhile. -ETIMEDOUT. */
static inline int fb_component_wait(fb_component *component, void *value, fb_reading *reading, uint64_t after,
                                    const struct timespec *timeout);

/* The robot of the last reading; "" before the first. */
static inline const char *fb_component_robot(const fb_component *component);

/* Name of this robot; copied to `name`, which has `size` bytes. */
static inline int fb_robot(fb_board *board, char *name, size_t size);

/* Be no user of the board any more; its handles are gone. NULL is allowed. */
static inline void fb_close(fb_board *board);

/* Why the last call of this thread that failed did so: a sentence. */
static inline const char *fb_error(void);

/* --- Bytes (BOARD.md) ----------------------------------------------------------------------------------------------------------------- */

#define FB_MAGIC_ "\x89" "FOBRD\r\n"

enum {
    FB_VERSION_ = 1,
    FB_PRIVATE_ = 1,
    FB_OWN_ = 2,
    FB_PEER_ = 4,
    FB_ALONE_ = 8,
    FB_ADDED_ = 8,
    FB_ITEMS_MAX_ = 1024,
    FB_SIZE_MAX_ = 65536,
    FB_SHARED_SIZE_MAX_ = 4096, /* of what travels to other robots */
    FB_FILE_SIZE_MAX_ = 16 << 20,
    FB_USERS_MAX_ = 256,
    FB_BANKS_MAX_ = 8,
    FB_NAME_MAX_ = 63,
    FB_TEXT_MAX_ = 65535,
    FB_LINE_ = 64,
    FB_GENERATION_AT_ = 16,
    FB_COUNT_AT_ = 24,
    FB_SIZE_AT_ = 32,
    FB_CHANGED_AT_ = 128,
    FB_STATE_AT_ = 140,
    FB_RUN_ = 2,                /* the state of a robot that is there */
    FB_USERS_AT_ = 4096,
    FB_USER_SIZE_ = 64,
    FB_RECORDS_AT_ = 20480,
    FB_RECORD_SIZE_ = 192,
    FB_BANKS_ = 6,   /* in a record */
    FB_NEWEST_ = 64,
    FB_WAITERS_ = 72,
    FB_PID_ = 76,
    FB_REFUSED_ = 80,
    FB_FORMULA_ = 152,
    FB_BANK_HEAD_ = 32,
    FB_RETRIES_ = 16,
    FB_WATCHED_MAX_ = 128,      /* words on which the kernel sleeps at once */
    FB_FUTEX_WAITV_ = 449,      /* on every machine, since Linux 5.16 */
    FB_FUTEX_32_ = 2,
    FB_POLL_NS_ = 10000000,     /* where it cannot sleep on several words */
    FB_ROBOTS_MAX_ = 64,
    FB_TURNS_ = 100,            /* of a call whose board is made anew each time it looks */
    FB_EPOCH_BITS_ = 40,        /* numbers of puts under epoch e begin above e << 40 */
    FB_FOLLOW_NS_ = 20000000,   /* the longest sleep without a look at who is the primary */
    FB_SLICE_NS_ = 100000000,   /* the longest sleep without a look: a wake-up may be lost */
    FB_TABLE_WAIT_MS_ = 5000,   /* for a process that changes a table, which takes microseconds */
    FB_GONE_MS_ = 2000,         /* for an agent that makes the board anew */
    FB_MAPS_ = 4096             /* mappings that are guarded against files that become shorter */
};

#define FB_AGENT_ "/" /* in place of a robot: the agent's own file; no robot is called so */
#define FB_HOLE_ ((uint64_t)0)
#define FB_GONE_ UINT64_MAX
#define FB_USER_LOCKS_ ((int64_t)1 << 40)
#define FB_WRITER_LOCKS_ ((int64_t)1 << 41)
#define FB_TABLE_LOCK_ ((int64_t)1 << 62)
#define FB_UNKNOWN_ ((uint64_t)1) /* a generation that no file has at rest */

typedef struct fb_header_ {
    char magic[8];
    uint32_t version, flags;
    uint64_t generation;
    uint32_t count, capacity;
    uint64_t size;
    uint8_t boot_id[16];
    uint64_t roster;
    char robot[64];
    uint64_t changed;
    uint32_t rank, state;
    uint64_t heard;
} fb_header_;

typedef struct fb_record_ {
    uint32_t id;
    uint16_t kind, banks;
    uint64_t offset;
    uint32_t size, stride, period, phase;
    uint64_t digest, name, bound;
    uint32_t flags, unused;
} fb_record_;

typedef char fb_header_has_152_bytes_[sizeof(fb_header_) == 152 ? 1 : -1];
typedef char fb_record_has_64_bytes_[sizeof(fb_record_) == 64 ? 1 : -1];

/* --- What this process keeps ------------------------------------------------------------------------------------------------------ */

/* One mapped file. Once an item was found in it, it stays mapped until fb_close(): a thread may be reading it. */
typedef struct fb_area_ {
    struct fb_area_ *next;
    unsigned char *map;
    int file;    /* for locks and sizes; -1: closed; atomic */
    int telling; /* threads that use `file` without the guard; atomic */
    bool is_writable, is_peer, always_wakes, is_used;
    uint32_t flags, rank;
    char robot[65], name[NAME_MAX + 1];
} fb_area_;

/* Where one robot's item lies. All but what is marked stays as it is made. */
typedef struct fb_place_ {
    struct fb_place_ *next, *older; /* of this item; of all that were given up */
    fb_area_ *area;
    const uint64_t *generation;
    uint64_t *newest;
    unsigned char *record, *banks;
    uint64_t remembered; /* atomic */
    uint64_t stride, limit, bound, skew;
    uint32_t count, index;
    fb_record_ declared;
    bool is_own;
    bool has_lock;   /* the putting thread's, with the guard */
    uint64_t number; /* the putting thread's: of its newest put */
    char robot[65];
} fb_place_;

struct fb_item {
    fb_item *next;
    fb_board *board;
    fb_place_ *own, *peers; /* atomic */
    uint64_t size, digest;
    char name[FB_NAME_MAX_ + 1];
};

/* Which robot runs a component, as the agent saw it in put `seen` of its table. */
struct fb_component {
    fb_component *next; /* of its board */
    fb_item *item, *primaries;
    uint64_t seen, epoch, since;
    uint64_t last;                   /* number of the last reading */
    char primary[65], robot[65];     /* now; of the last reading */
    unsigned char *table;            /* FB_SIZE_MAX_ bytes; behind them as many as the item has, for a value that may not be given */
    char path[256];
};

typedef struct fb_added_ {
    struct fb_added_ *next;
    fb_declaration wanted;
    char name[FB_NAME_MAX_ + 1];
} fb_added_;

struct fb_board {
    fb_board *next;
    pthread_mutex_t guard; /* held while files are opened, mapped or examined */
    char *chosen;          /* the directory that the caller named, or NULL */
    char directory[PATH_MAX];
    fb_area_ *areas, *left; /* in use; given up */
    fb_area_ *own;          /* NULL: not open */
    fb_place_ *given_up;
    fb_item *items;
    fb_component *components;
    fb_added_ *added;
    uint32_t user;
    int64_t skew, gone; /* gone: since when the agent has not replaced the board that it is to make anew, or 0 */
    bool is_forked;
};

/* One of each in a program, however many of its files include this one. */
__attribute__((weak)) fb_board *fb_boards_;
__attribute__((weak)) pthread_mutex_t fb_boards_guard_ = PTHREAD_MUTEX_INITIALIZER;
__attribute__((weak)) bool fb_is_registered_;
__attribute__((weak)) uintptr_t fb_maps_[FB_MAPS_]; /* atomic */
__attribute__((weak)) struct sigaction fb_before_;
__attribute__((weak)) __thread char fb_sentence_[768];
__attribute__((weak)) __thread size_t fb_turn_; /* of fb_wait_any: where its look begins */

static inline const char *fb_error(void) { return fb_sentence_; }

__attribute__((format(printf, 2, 3))) static inline int fb_fail_(int code, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(fb_sentence_, sizeof fb_sentence_, format, arguments);
    va_end(arguments);
    errno = code;
    return -code;
}

static inline uint64_t fb_load_(const uint64_t *word) { return __atomic_load_n(word, __ATOMIC_ACQUIRE); }

static inline bool fb_is_lost_(uint64_t generation) { return generation == FB_HOLE_ || generation == FB_GONE_; }

/* --- XXH3-64, with seed 0 ----------------------------------------------------------------------------------------------------------------
 *
 * Source: the specification of XXH3 (doc/xxhash_spec.md of xxHash). */

__extension__ typedef unsigned __int128 fb_wide_;

static inline uint64_t fb_word_(const unsigned char *from)
{
    uint64_t word;
    memcpy(&word, from, 8);
    return word;
}

static inline uint32_t fb_half_(const unsigned char *from)
{
    uint32_t half;
    memcpy(&half, from, 4);
    return half;
}

static inline const unsigned char *fb_secret_(void)
{
    static const unsigned char secret[192] = {
        0xb8, 0xfe, 0x6c, 0x39, 0x23, 0xa4, 0x4b, 0xbe, 0x7c, 0x01, 0x81, 0x2c, 0xf7, 0x21, 0xad, 0x1c, 0xde, 0xd4, 0x6d, 0xe9,
        0x83, 0x90, 0x97, 0xdb, 0x72, 0x40, 0xa4, 0xa4, 0xb7, 0xb3, 0x67, 0x1f, 0xcb, 0x79, 0xe6, 0x4e, 0xcc, 0xc0, 0xe5, 0x78,
        0x82, 0x5a, 0xd0, 0x7d, 0xcc, 0xff, 0x72, 0x21, 0xb8, 0x08, 0x46, 0x74, 0xf7, 0x43, 0x24, 0x8e, 0xe0, 0x35, 0x90, 0xe6,
        0x81, 0x3a, 0x26, 0x4c, 0x3c, 0x28, 0x52, 0xbb, 0x91, 0xc3, 0x00, 0xcb, 0x88, 0xd0, 0x65, 0x8b, 0x1b, 0x53, 0x2e, 0xa3,
        0x71, 0x64, 0x48, 0x97, 0xa2, 0x0d, 0xf9, 0x4e, 0x38, 0x19, 0xef, 0x46, 0xa9, 0xde, 0xac, 0xd8, 0xa8, 0xfa, 0x76, 0x3f,
        0xe3, 0x9c, 0x34, 0x3f, 0xf9, 0xdc, 0xbb, 0xc7, 0xc7, 0x0b, 0x4f, 0x1d, 0x8a, 0x51, 0xe0, 0x4b, 0xcd, 0xb4, 0x59, 0x31,
        0xc8, 0x9f, 0x7e, 0xc9, 0xd9, 0x78, 0x73, 0x64, 0xea, 0xc5, 0xac, 0x83, 0x34, 0xd3, 0xeb, 0xc3, 0xc5, 0x81, 0xa0, 0xff,
        0xfa, 0x13, 0x63, 0xeb, 0x17, 0x0d, 0xdd, 0x51, 0xb7, 0xf0, 0xda, 0x49, 0xd3, 0x16, 0x55, 0x26, 0x29, 0xd4, 0x68, 0x9e,
        0x2b, 0x16, 0xbe, 0x58, 0x7d, 0x47, 0xa1, 0xfc, 0x8f, 0xf8, 0xb8, 0xd1, 0x7a, 0xd0, 0x31, 0xce, 0x45, 0xcb, 0x3a, 0x8f,
        0x95, 0x16, 0x04, 0x28, 0xaf, 0xd7, 0xfb, 0xca, 0xbb, 0x4b, 0x40, 0x7e};
    return secret;
}

#define FB_PRIME32_1_ UINT64_C(0x9E3779B1)
#define FB_PRIME32_2_ UINT64_C(0x85EBCA77)
#define FB_PRIME32_3_ UINT64_C(0xC2B2AE3D)
#define FB_PRIME64_1_ UINT64_C(0x9E3779B185EBCA87)
#define FB_PRIME64_2_ UINT64_C(0xC2B2AE3D27D4EB4F)
#define FB_PRIME64_3_ UINT64_C(0x165667B19E3779F9)
#define FB_PRIME64_4_ UINT64_C(0x85EBCA77C2B2AE63)
#define FB_PRIME64_5_ UINT64_C(0x27D4EB2F165667C5)
#define FB_MIX_1_ UINT64_C(0x165667919E3779F9)
#define FB_MIX_2_ UINT64_C(0x9FB21C651E98DF25)

static inline uint64_t fb_folded_(uint64_t one, uint64_t other)
{
    fb_wide_ product = (fb_wide_)one * other;
    return (uint64_t)product ^ (uint64_t)(product >> 64);
}

static inline uint64_t fb_turned_(uint64_t word, int count) { return word << count | word >> (64 - count); }

static inline uint64_t fb_spread_(uint64_t word)
{
    word = (word ^ word >> 37) * FB_MIX_1_;
    return word ^ word >> 32;
}

static inline uint64_t fb_spread_short_(uint64_t word)
{
    word = (word ^ word >> 33) * FB_PRIME64_2_;
    word = (word ^ word >> 29) * FB_PRIME64_3_;
    return word ^ word >> 32;
}

static inline uint64_t fb_mixed_(const unsigned char *at, const unsigned char *secret)
{
    return fb_folded_(fb_word_(at) ^ fb_word_(secret), fb_word_(at + 8) ^ fb_word_(secret + 8));
}

static inline uint64_t fb_digest_to_16_(const unsigned char *at, uint64_t size)
{
    const unsigned char *secret = fb_secret_();
    if (size > 8) {
        uint64_t low = fb_word_(at) ^ fb_word_(secret + 24) ^ fb_word_(secret + 32);
        uint64_t high = fb_word_(at + size - 8) ^ fb_word_(secret + 40) ^ fb_word_(secret + 48);
        return fb_spread_(size + __builtin_bswap64(low) + high + fb_folded_(low, high));
    }
    if (size > 3) {
        uint64_t word = fb_half_(at + size - 4) + ((uint64_t)fb_half_(at) << 32);
        word ^= fb_word_(secret + 8) ^ fb_word_(secret + 16);
        word ^= fb_turned_(word, 49) ^ fb_turned_(word, 24);
        word *= FB_MIX_2_;
        word = (word ^ ((word >> 35) + size)) * FB_MIX_2_;
        return word ^ word >> 28;
    }
    if (size > 0) {
        uint64_t word = (uint64_t)at[0] << 16 | (uint64_t)at[size >> 1] << 24 | at[size - 1] | size << 8;
        return fb_spread_short_(word ^ (uint64_t)(fb_half_(secret) ^ fb_half_(secret + 4)));
    }
    return fb_spread_short_(fb_word_(secret + 56) ^ fb_word_(secret + 64));
}

static inline uint64_t fb_digest_to_240_(const unsigned char *at, uint64_t size)
{
    const unsigned char *secret = fb_secret_();
    uint64_t sum = size * FB_PRIME64_1_, turn;
    if (size <= 128) {
        for (turn = (size - 1) / 32 + 1; turn-- > 0;)
            sum += fb_mixed_(at + 16 * turn, secret + 32 * turn) + fb_mixed_(at + size - 16 * (turn + 1), secret + 32 * turn + 16);
        return fb_spread_(sum);
    }
    for (turn = 0; turn < 8; turn++)
        sum += fb_mixed_(at + 16 * turn, secret + 16 * turn);
    sum = fb_spread_(sum);
    for (; turn < size / 16; turn++)
        sum += fb_mixed_(at + 16 * turn, secret + 16 * (turn - 8) + 3);
    return fb_spread_(sum + fb_mixed_(at + size - 16, secret + 119));
}

static inline void fb_taken_in_(uint64_t *sums, const unsigned char *at, const unsigned char *secret)
{
    for (int lane = 0; lane < 8; lane++) {
        uint64_t word = fb_word_(at + 8 * lane), key = word ^ fb_word_(secret + 8 * lane);
        sums[lane ^ 1] += word;
        sums[lane] += (key & 0xFFFFFFFF) * (key >> 32);
    }
}

static inline uint64_t fb_digest_long_(const unsigned char *at, uint64_t size)
{
    const unsigned char *secret = fb_secret_();
    uint64_t sums[8] = {FB_PRIME32_3_, FB_PRIME64_1_, FB_PRIME64_2_, FB_PRIME64_3_, FB_PRIME64_4_, FB_PRIME32_2_, FB_PRIME64_5_, FB_PRIME32_1_};
    uint64_t stripes = (size - 1) / 64, result = size * FB_PRIME64_1_;
    for (uint64_t stripe = 0; stripe < stripes; stripe++) {
        fb_taken_in_(sums, at + 64 * stripe, secret + 8 * (stripe % 16));
        for (int lane = 0; stripe % 16 == 15 && lane < 8; lane++) {
            sums[lane] ^= sums[lane] >> 47;
            sums[lane] = (sums[lane] ^ fb_word_(secret + 128 + 8 * lane)) * FB_PRIME32_1_;
        }
    }
    fb_taken_in_(sums, at + size - 64, secret + 121);
    for (int pair = 0; pair < 4; pair++)
        result += fb_folded_(sums[2 * pair] ^ fb_word_(secret + 11 + 16 * pair), sums[2 * pair + 1] ^ fb_word_(secret + 19 + 16 * pair));
    return fb_spread_(result);
}

/* XXH3-64 of some bytes. */
static inline uint64_t fb_digest_(const void *at, uint64_t size)
{
    const unsigned char *bytes = (const unsigned char *)at;
    return size <= 16 ? fb_digest_to_16_(bytes, size) : size <= 240 ? fb_digest_to_240_(bytes, size) : fb_digest_long_(bytes, size);
}

/* --- Clock and kernel ---------------------------------------------------------------------------------------------------------------- */

/* What a clock of this process, "boottime" or "monotonic", is ahead of the machine's: a protected program may live in a time namespace. 0 without those. */
static inline int64_t fb_skew_of_(const char *clock)
{
    char line[128];
    long long seconds = 0, nanoseconds = 0;
    FILE *file = fopen("/proc/self/timens_offsets", "re");
    if (file == NULL)
        return 0;
    while (fgets(line, sizeof line, file) != NULL)
        if (strncmp(line, clock, strlen(clock)) == 0 && sscanf(line + strlen(clock), "%lld %lld", &seconds, &nanoseconds) == 2)
            break;
        else
            seconds = nanoseconds = 0;
    fclose(file);
    return (int64_t)seconds * 1000000000 + nanoseconds;
}

static inline int64_t fb_skew_(void) { return fb_skew_of_("boottime"); }

static inline int64_t fb_clock_(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Sixteen bytes that name this boot; all zeros where they cannot be read. */
static inline void fb_boot_id_(uint8_t *id)
{
    char text[64] = "";
    unsigned digits = 0;
    int file = open("/proc/sys/kernel/random/boot_id", O_RDONLY | O_CLOEXEC);
    ssize_t size = file < 0 ? 0 : read(file, text, sizeof text - 1);
    memset(id, 0, 16);
    for (ssize_t index = 0; index < size && digits < 32; index++) {
        const char *found = text[index] == '\0' ? NULL : strchr("0123456789abcdef", text[index]);
        if (found != NULL && *found != '\0') {
            id[digits / 2] = (uint8_t)(id[digits / 2] << 4 | (found - "0123456789abcdef"));
            digits++;
        }
    }
    if (file >= 0)
        close(file);
}

/* The fencing token: the agent renews its digits in the environment. 0 without an agent. */
static inline uint64_t fb_epoch_(void)
{
    const char *told = getenv("FAILOVER_EPOCH");
    char *end = NULL;
    unsigned long long epoch = told == NULL ? 0 : strtoull(told, &end, 10);
    return told == NULL || *told < '0' || *told > '9' || *end != '\0' ? 0 : epoch;
}

/* fcntl(2) about one byte or more, of the opening that `file` is of; never waits. 0 or -errno. */
static inline int fb_lock_(int file, int command, struct flock *lock, short kind, int64_t byte, int64_t count)
{
    memset(lock, 0, sizeof *lock);
    lock->l_type = kind;
    lock->l_whence = SEEK_SET;
    lock->l_start = (off_t)byte;
    lock->l_len = (off_t)count;
    return fcntl(file, command, lock) == 0 ? 0 : -errno;
}

static inline bool fb_take_(int file, int64_t byte)
{
    struct flock lock;
    return fb_lock_(file, F_OFD_SETLK, &lock, F_WRLCK, byte, 1) == 0;
}

static inline void fb_give_(int file, int64_t byte)
{
    struct flock lock;
    fb_lock_(file, F_OFD_SETLK, &lock, F_UNLCK, byte, 1);
}

/* Whether another opening has one of these bytes. */
static inline bool fb_is_taken_(int file, int64_t byte, int64_t count)
{
    struct flock lock;
    return fb_lock_(file, F_OFD_GETLK, &lock, F_WRLCK, byte, count) != 0 || lock.l_type != F_UNLCK;
}

/* Hold the table lock of a file. 0, or -EBUSY when another process has held it for 5 s. */
static inline int fb_take_table_(int file, const char *directory)
{
    const struct timespec pause = {0, 1000000};
    for (int turn = 0; turn < FB_TABLE_WAIT_MS_; turn++) {
        if (fb_take_(file, FB_TABLE_LOCK_))
            return 0;
        nanosleep(&pause, NULL);
    }
    return fb_fail_(EBUSY, "board %.200s: another process has held the lock of the table for 5 s; is it stopped?", directory);
}

static inline void fb_wake_(const void *word) { syscall(SYS_futex, word, 1 /* FUTEX_WAKE */, INT_MAX, NULL, NULL, 0); }

static inline void fb_sleep_(const void *word, uint32_t value, int64_t ns)
{
    struct timespec limit;
    limit.tv_sec = (time_t)(ns / 1000000000);
    limit.tv_nsec = (long)(ns % 1000000000);
    syscall(SYS_futex, word, 0 /* FUTEX_WAIT */, value, &limit, NULL, 0);
}

/* struct futex_waitv */
typedef struct fb_sleeper_ {
    uint64_t value, address;
    uint32_t flags, unused;
} fb_sleeper_;

/* The same on several words. A kernel before 5.16 sleeps on the first one, and not for long. */
static inline void fb_sleep_any_(const fb_sleeper_ *sleepers, unsigned count, int64_t ns)
{
    if (count > 1) {
        const int64_t end = fb_clock_(CLOCK_MONOTONIC) + ns;
        struct timespec limit;
        limit.tv_sec = (time_t)(end / 1000000000);
        limit.tv_nsec = (long)(end % 1000000000);
        if (syscall(FB_FUTEX_WAITV_, sleepers, count, 0, &limit, CLOCK_MONOTONIC) >= 0 || (errno != ENOSYS && errno != EPERM))
            return;
        ns = ns > (int64_t)FB_POLL_NS_ ? (int64_t)FB_POLL_NS_ : ns;
    }
    fb_sleep_((const void *)(uintptr_t)sleepers[0].address, (uint32_t)sleepers[0].value, ns);
}

/* --- Files that become shorter ------------------------------------------------------------------------------------------------------------
 *
 * Who may write a board's file may also make it shorter; a touch of what is lost raises SIGBUS. Then zeros take the place of that
 * file's mapping, as after a restore: a generation of 0 has the next call open the board anew. Other SIGBUSes go to the handler that had the signal
 * before. FB_NO_SIGBUS leaves the signal alone. */

static inline void fb_bus_error_(int number, siginfo_t *about, void *context)
{
    const uintptr_t at = (uintptr_t)about->si_addr;
    const int saved = errno;
    for (int index = 0; index < FB_MAPS_; index++) {
        uintptr_t start = __atomic_load_n(&fb_maps_[index], __ATOMIC_ACQUIRE);
        if (start != 0 && at >= start && at - start < FB_FILE_SIZE_MAX_) {
            void *made = mmap((void *)start, FB_FILE_SIZE_MAX_, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED | MAP_NORESERVE, -1, 0);
            errno = saved;
            if (made != MAP_FAILED)
                return;
            break;
        }
    }
    if ((fb_before_.sa_flags & SA_SIGINFO) != 0 && fb_before_.sa_sigaction != NULL)
        fb_before_.sa_sigaction(number, about, context);
    else if (fb_before_.sa_handler != SIG_DFL && fb_before_.sa_handler != SIG_IGN)
        fb_before_.sa_handler(number);
    else
        signal(number, SIG_DFL); /* it comes again at once */
}

static inline void fb_guard_(void)
{
#ifndef FB_NO_SIGBUS
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_sigaction = fb_bus_error_;
    action.sa_flags = SA_SIGINFO | SA_ONSTACK | SA_RESTART;
    sigaction(SIGBUS, &action, &fb_before_);
#endif
}

static inline void fb_noted_(const unsigned char *map, bool is_there)
{
    for (int index = 0; index < FB_MAPS_; index++) {
        uintptr_t expected = is_there ? 0 : (uintptr_t)map, wanted = is_there ? (uintptr_t)map : 0;
        if (__atomic_compare_exchange_n(&fb_maps_[index], &expected, wanted, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED))
            return;
    }
}

/* --- What a file says --------------------------------------------------------------------------------------------------------------------- */

static inline uint64_t fb_aligned_(uint64_t size) { return (size + FB_LINE_ - 1) / FB_LINE_ * FB_LINE_; }

static inline uint64_t fb_names_at_(uint32_t capacity) { return fb_aligned_(FB_RECORDS_AT_ + (uint64_t)capacity * FB_RECORD_SIZE_); }

/* Bytes of a file that can be touched. */
static inline uint64_t fb_reach_(const fb_area_ *area)
{
    struct stat about;
    if (area->file < 0 || fstat(area->file, &about) != 0 || about.st_size < 0)
        return 0;
    return about.st_size > FB_FILE_SIZE_MAX_ ? (uint64_t)FB_FILE_SIZE_MAX_ : (uint64_t)about.st_size;
}

/* Copy a header and examine it: 0, -ESTALE where the board was made anew, -EBADMSG. */
static inline int fb_examined_(const fb_area_ *area, uint64_t reach, fb_header_ *header)
{
    if (reach < FB_RECORDS_AT_)
        return fb_fail_(EBADMSG, "board: %s has %llu bytes: it is no board", area->name, (unsigned long long)reach);
    memcpy(header, area->map, sizeof *header);
    header->generation = fb_load_((const uint64_t *)(const void *)(area->map + FB_GENERATION_AT_));
    if (header->generation == FB_GONE_ || header->generation == FB_HOLE_)
        return fb_fail_(ESTALE, "board: %s was made anew, or removed", area->name);
    if (memcmp(header->magic, FB_MAGIC_, 8) != 0)
        return fb_fail_(EBADMSG, "board: %s is no board: it begins otherwise", area->name);
    if (header->version != FB_VERSION_)
        return fb_fail_(EBADMSG, "board: %s has version %u, this program knows version %d; update the older of the two", area->name,
                        header->version, FB_VERSION_);
    const uint32_t which = header->flags & 7;
    if (which == 0 || (which & (which - 1)) != 0 || header->flags > 15 || header->capacity < 1 || header->capacity > FB_ITEMS_MAX_ ||
        header->count > header->capacity || fb_names_at_(header->capacity) > reach)
        return fb_fail_(EBADMSG, "board: %s is damaged: flags %#x, %u records, room for %u, %llu bytes", area->name, header->flags,
                        header->count, header->capacity, (unsigned long long)reach);
    return 0;
}

/* Copy a record and examine it: 1; 0 for a hole; -EBADMSG. All that it names lies inside of `reach`. */
static inline int fb_record_at_(const fb_area_ *area, uint64_t reach, const fb_header_ *header, uint32_t index, fb_record_ *record,
                                const unsigned char **name, uint32_t *name_size)
{
    const uint64_t low = fb_names_at_(header->capacity);
    uint16_t size;
    memcpy(record, area->map + FB_RECORDS_AT_ + (uint64_t)index * FB_RECORD_SIZE_, sizeof *record);
    if (record->banks == 0)
        return 0;
    if (record->kind > FB_JSON || record->banks < 2 || record->banks > FB_BANKS_MAX_ || record->size < 1 || record->size > FB_SIZE_MAX_ ||
        record->stride % FB_LINE_ != 0 || record->stride < FB_BANK_HEAD_ + record->size || record->stride > reach ||
        record->offset % FB_LINE_ != 0 || record->offset < low || record->offset > reach ||
        (uint64_t)record->banks * record->stride > reach - record->offset || record->period == 0 || record->phase >= record->period ||
        record->name < low || record->name > reach || reach - record->name < 2)
        return fb_fail_(EBADMSG, "board: %s is damaged: record %u", area->name, index);
    memcpy(&size, area->map + record->name, 2);
    if (size < 1 || size > FB_NAME_MAX_ || size > reach - record->name - 2)
        return fb_fail_(EBADMSG, "board: %s is damaged: the name of record %u", area->name, index);
    *name = area->map + record->name + 2;
    *name_size = size;
    return 1;
}

/* Find an item: by its name, or, where that is NULL, by its number. Index, -ENOENT, or another error. */
static inline int fb_search_(const fb_area_ *area, const char *wanted, uint32_t id, fb_record_ *record)
{
    const uint64_t reach = fb_reach_(area);
    fb_header_ header;
    int outcome = fb_examined_(area, reach, &header);
    for (uint32_t index = 0; outcome >= 0 && index < header.count; index++) {
        const unsigned char *name = NULL;
        uint32_t size = 0;
        outcome = fb_record_at_(area, reach, &header, index, record, &name, &size);
        if (outcome > 0 && (wanted != NULL ? strlen(wanted) == size && memcmp(wanted, name, size) == 0 : record->id == id))
            return (int)index;
    }
    return outcome < 0 ? outcome : -ENOENT;
}

/* Whether a record is still the item that it was. */
static inline bool fb_holds_(const fb_place_ *place, const fb_item *item)
{
    const uint64_t reach = fb_reach_(place->area);
    const unsigned char *name = NULL;
    uint32_t size = 0;
    fb_header_ header;
    fb_record_ record;
    return fb_examined_(place->area, reach, &header) == 0 && place->index < header.count &&
           fb_record_at_(place->area, reach, &header, place->index, &record, &name, &size) == 1 &&
           memcmp(&record, &place->declared, sizeof record) == 0 && strlen(item->name) == size && memcmp(item->name, name, size) == 0;
}

/* --- Files ----------------------------------------------------------------------------------------------------------------------------- */

/* Map a file of the board. `file`: an opening of it that this keeps; -1: it is opened here. NULL on failure: then `file` is the caller's. */
static inline fb_area_ *fb_mapped_(fb_board *board, const char *name, int file)
{
    char path[PATH_MAX + NAME_MAX + 2];
    fb_header_ header;
    fb_area_ *area = (fb_area_ *)calloc(1, sizeof *area);
    const bool is_peer = strncmp(name, "peer-", 5) == 0 || strcmp(name, "agent") == 0, is_given = file >= 0;
    int failed = 0;
    if (area == NULL || strlen(name) > NAME_MAX) {
        free(area);
        fb_fail_(area == NULL ? ENOMEM : ENAMETOOLONG, "cannot open the board: %s", strerror(area == NULL ? ENOMEM : ENAMETOOLONG));
        return NULL;
    }
    snprintf(path, sizeof path, "%s/%s", board->directory, name);
    area->is_writable = !is_peer;
    if (!is_given && !is_peer)
        file = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (!is_given && file < 0 && (is_peer || errno == EACCES)) {
        area->is_writable = false;
        file = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    }
    if (file < 0) {
        failed = fb_fail_(errno, "cannot open %.400s: %s", path, strerror(errno));
        free(area);
        errno = -failed;
        return NULL;
    }
    area->file = file;
    snprintf(area->name, sizeof area->name, "%.*s", NAME_MAX, name);
    area->is_peer = is_peer;
    area->always_wakes = strncmp(name, "own+", 4) == 0;
    void *map = mmap(NULL, FB_FILE_SIZE_MAX_, PROT_READ | (area->is_writable ? PROT_WRITE : 0), MAP_SHARED | MAP_NORESERVE, file, 0);
    if (map == MAP_FAILED) {
        failed = fb_fail_(errno, "cannot map %.400s: %s", path, strerror(errno));
    } else {
        area->map = (unsigned char *)map;
        fb_noted_(area->map, true);
        failed = fb_examined_(area, fb_reach_(area), &header);
    }
    if (failed != 0) {
        if (area->map != NULL) {
            fb_noted_(area->map, false);
            munmap(area->map, FB_FILE_SIZE_MAX_);
        }
        if (!is_given)
            close(file);
        free(area);
        errno = -failed;
        return NULL;
    }
    area->flags = header.flags;
    area->rank = header.rank;
    memcpy(area->robot, header.robot, 64);
    area->next = board->areas;
    board->areas = area;
    return area;
}

/* Tell the agent of an urgent put; what the kernel refuses goes with the round. The guard need not be held. */
static inline void fb_tell_(fb_area_ *area)
{
    __atomic_fetch_add(&area->telling, 1, __ATOMIC_SEQ_CST);
    const int file = __atomic_load_n(&area->file, __ATOMIC_SEQ_CST);
    if (file >= 0)
        futimens(file, NULL);
    __atomic_fetch_sub(&area->telling, 1, __ATOMIC_SEQ_CST);
}

/* Close a file and give its locks back; no thread uses its number afterwards, which may soon be another file's. */
static inline void fb_shut_(fb_area_ *area)
{
    const struct timespec pause = {0, 100000};
    const int file = __atomic_exchange_n(&area->file, -1, __ATOMIC_SEQ_CST);
    while (__atomic_load_n(&area->telling, __ATOMIC_SEQ_CST) > 0)
        nanosleep(&pause, NULL);
    if (file >= 0)
        close(file);
}

static inline void fb_unmap_(fb_area_ *area)
{
    fb_noted_(area->map, false);
    munmap(area->map, FB_FILE_SIZE_MAX_);
    free(area);
}

static inline bool fb_is_there_(const fb_area_ *area)
{
    return !fb_is_lost_(fb_load_((const uint64_t *)(const void *)(area->map + FB_GENERATION_AT_)));
}

/* Take a file out of those in use. */
static inline void fb_leave_(fb_board *board, fb_area_ **link)
{
    fb_area_ *area = *link;
    struct flock lock;
    *link = area->next;
    if (area->file >= 0)
        fb_lock_(area->file, F_OFD_SETLK, &lock, F_UNLCK, 0, 0); /* all of them: what is mapped keeps the opening, and that its locks */
    fb_shut_(area);
    if (area->is_used) {
        area->next = board->left;
        board->left = area;
    } else {
        fb_unmap_(area);
    }
}

/* Give a board's files up, and all places in them; their locks are given back. */
static inline void fb_give_up_(fb_board *board)
{
    for (fb_item *item = board->items; item != NULL; item = item->next) {
        fb_place_ *places = __atomic_exchange_n(&item->peers, NULL, __ATOMIC_ACQ_REL), *own = __atomic_exchange_n(&item->own, NULL, __ATOMIC_ACQ_REL);
        if (own != NULL) {
            own->has_lock = false;
            own->older = board->given_up;
            board->given_up = own;
        }
        for (; places != NULL; places = places->next) {
            places->older = board->given_up;
            board->given_up = places;
        }
    }
    while (board->areas != NULL)
        fb_leave_(board, &board->areas);
    board->own = NULL;
}

/* Forget the files of other robots, and of one user, that were removed or made anew, and all places in them; the others stay as they are.
 * Whether there was one. The guard is held. */
static inline bool fb_forget_gone_(fb_board *board)
{
    bool is_one = false;
    for (fb_area_ **link = &board->areas; *link != NULL;) {
        fb_area_ *area = *link;
        if ((!area->is_peer && !area->always_wakes) || fb_is_there_(area)) {
            link = &area->next;
            continue;
        }
        for (fb_item *item = board->items; item != NULL; item = item->next) {
            if (item->own != NULL && item->own->area == area) {
                fb_place_ *own = __atomic_exchange_n(&item->own, NULL, __ATOMIC_ACQ_REL);
                own->has_lock = false;
                own->older = board->given_up;
                board->given_up = own;
            }
            for (fb_place_ **at = &item->peers; *at != NULL;) {
                fb_place_ *place = *at;
                if (place->area != area) {
                    at = &place->next;
                    continue;
                }
                __atomic_store_n(at, place->next, __ATOMIC_RELEASE); /* its own `next` stays: a thread may stand there */
                place->older = board->given_up;
                board->given_up = place;
            }
        }
        fb_leave_(board, link);
        is_one = true;
    }
    return is_one;
}

/* What lies beside the agent's socket under a name; `path` has PATH_MAX bytes. */
static inline void fb_beside_socket_(char *path, const char *name)
{
    const char *socket = getenv("FAILOVER_SOCKET"), *runtime = getenv("XDG_RUNTIME_DIR");
    char *slash;
    if (socket != NULL && *socket != '\0') {
        snprintf(path, PATH_MAX, "%s", socket);
    } else {
        snprintf(path, PATH_MAX, "%s/failover/control.sock", runtime == NULL ? "" : runtime);
        if (runtime == NULL || *runtime == '\0' || access(path, F_OK) != 0)
            snprintf(path, PATH_MAX, "/run/failover/control.sock");
    }
    slash = strrchr(path, '/');
    slash = slash == NULL ? path : slash + 1;
    snprintf(slash, PATH_MAX - (size_t)(slash - path), "%s", name);
}

/* Where this program's board is, as BOARD.md says. `is_named`: by the caller or the environment. */
static inline int fb_find_directory_(fb_board *board, bool *is_named)
{
    char path[PATH_MAX], robot[65] = "robot";
    const char *named = board->chosen != NULL ? board->chosen : getenv("FAILOVER_BOARD");
    *is_named = named != NULL && *named != '\0';
    if (*is_named) {
        snprintf(path, sizeof path, "%s", named);
    } else {
        fb_beside_socket_(path, "board");
        if (access(path, F_OK) != 0) {
            gethostname(robot, sizeof robot - 1);
            for (const char *at = robot; *at != '\0'; at++)
                if (*at <= ' ' || *at == '/' || *at == 127)
                    memcpy(robot, "robot", 6);
            snprintf(path, sizeof path, "/dev/shm/failover-u%u-%s", (unsigned)geteuid(), *robot == '\0' ? "robot" : robot);
        }
    }
    if (strlen(path) + NAME_MAX + 2 > PATH_MAX)
        return fb_fail_(ENAMETOOLONG, "cannot open the board: the name of its directory is too long");
    if (realpath(path, board->directory) == NULL)
        snprintf(board->directory, sizeof board->directory, "%s", path);
    return 0;
}

/* Make one file of a board without an agent, whole at its place. Its opening, which is user 0 and has the table lock; or -errno. */
static inline int fb_make_file_(fb_board *board, const char *name, uint32_t flags)
{
    char path[PATH_MAX + NAME_MAX + 2], made_at[40];
    fb_header_ header;
    int outcome = 0, made = open(board->directory, O_TMPFILE | O_RDWR | O_CLOEXEC, 0600);
    if (made < 0)
        return -errno;
    memset(&header, 0, sizeof header);
    memcpy(header.magic, FB_MAGIC_, 8);
    header.version = FB_VERSION_;
    header.flags = flags;
    header.generation = 2;
    header.capacity = FB_ITEMS_MAX_;
    header.size = fb_names_at_(FB_ITEMS_MAX_);
    fb_boot_id_(header.boot_id);
    header.state = 2;
    gethostname(header.robot, sizeof header.robot - 1);
    for (const char *at = header.robot; *at != '\0'; at++)
        if (*at <= ' ' || *at == '/' || *at == 127)
            memcpy(header.robot, "robot", 6);
    if (header.robot[0] == '\0')
        memcpy(header.robot, "robot", 6);
    snprintf(path, sizeof path, "%s/%s", board->directory, name);
    snprintf(made_at, sizeof made_at, "/proc/self/fd/%d", made);
    if (fchmod(made, 0600) != 0 || ftruncate(made, (off_t)header.size) != 0 || pwrite(made, &header, sizeof header, 0) != sizeof header ||
        !fb_take_(made, FB_TABLE_LOCK_) || !fb_take_(made, FB_USER_LOCKS_) || linkat(AT_FDCWD, made_at, AT_FDCWD, path, AT_SYMLINK_FOLLOW) != 0)
        outcome = -errno;
    if (outcome != 0)
        close(made);
    return outcome != 0 ? outcome : made;
}

static inline bool fb_is_still_(const char *path, int file)
{
    struct stat opened, there;
    return fstat(file, &opened) == 0 && lstat(path, &there) == 0 && opened.st_dev == there.st_dev && opened.st_ino == there.st_ino;
}

/* Whether a board is to be removed: made without an agent, and without users, of an earlier boot, or gone already. */
static inline bool fb_is_abandoned_(int file)
{
    fb_header_ header;
    uint8_t boot_id[16];
    if (pread(file, &header, sizeof header, 0) != sizeof header || memcmp(header.magic, FB_MAGIC_, 8) != 0 || (header.flags & FB_ALONE_) == 0)
        return false;
    fb_boot_id_(boot_id);
    return header.generation == FB_GONE_ || memcmp(boot_id, header.boot_id, 16) != 0 || !fb_is_taken_(file, FB_USER_LOCKS_, FB_USERS_MAX_);
}

/* Tell all who have the files open, and unlink them, `own` last; the table lock of `own` is held. */
static inline void fb_remove_(const fb_board *board, int own)
{
    const uint64_t gone = FB_GONE_;
    char path[PATH_MAX + NAME_MAX + 2];
    DIR *folder = opendir(board->directory);
    if (pwrite(own, &gone, 8, FB_GENERATION_AT_) != 8)
        return;
    for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); entry != NULL; entry = readdir(folder)) {
        if (strcmp(entry->d_name, "private") != 0 && strcmp(entry->d_name, "schedule") != 0 && strncmp(entry->d_name, "own+", 4) != 0 && strncmp(entry->d_name, "peer-", 5) != 0 &&
            strncmp(entry->d_name, "guest-", 6) != 0)
            continue;
        snprintf(path, sizeof path, "%s/%s", board->directory, entry->d_name);
        int file = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
        if (file >= 0) {
            if (pwrite(file, &gone, 8, FB_GENERATION_AT_) != 8)
                errno = 0; /* it is unlinked all the same */
            close(file);
        }
        unlink(path);
    }
    if (folder != NULL)
        closedir(folder);
    snprintf(path, sizeof path, "%s/own", board->directory);
    unlink(path);
    rmdir(board->directory);
}

/* Make a board without an agent: the opening of its `own`; -EEXIST where another process was quicker; another error. */
static inline int fb_make_(fb_board *board, bool is_named)
{
    struct stat about;
    int made;
    if (mkdir(board->directory, 0700) != 0 && errno != EEXIST)
        return fb_fail_(errno, "cannot make the board %.400s: %s; FAILOVER_BOARD names another place", board->directory, strerror(errno));
    if (lstat(board->directory, &about) != 0)
        return -EEXIST; /* removed meanwhile */
    if (!is_named && (!S_ISDIR(about.st_mode) || (about.st_uid != 0 && about.st_uid != geteuid())))
        return fb_fail_(EPERM, "cannot make the board %.400s: it belongs to uid %u; remove it, or name another place in FAILOVER_BOARD",
                        board->directory, (unsigned)about.st_uid);
    made = fb_make_file_(board, "private", FB_PRIVATE_ | FB_ALONE_);
    if (made >= 0)
        close(made);
    else if (made == -ENOENT)
        return -EEXIST;
    else if (made != -EEXIST)
        return fb_fail_(-made, "cannot make the board %.400s: %s; FAILOVER_BOARD names another place", board->directory, strerror(-made));
    made = fb_make_file_(board, "own", FB_OWN_ | FB_ALONE_);
    if (made < 0 && made != -EEXIST && made != -ENOENT)
        return fb_fail_(-made, "cannot make the board %.400s: %s; FAILOVER_BOARD names another place", board->directory, strerror(-made));
    return made >= 0 ? made : -EEXIST;
}

/* Take the first free byte among the users, and leave a row about this program. 0 or -errno. */
static inline int fb_be_user_(fb_board *board)
{
    struct {
        uint32_t pid, uid;
        char name[56];
    } row;
    const char *name = getenv("FAILOVER_COMPONENT");
    memset(&row, 0, sizeof row);
    row.pid = (uint32_t)getpid();
    row.uid = (uint32_t)geteuid();
    name = name != NULL && *name != '\0' ? name : program_invocation_short_name;
    memcpy(row.name, name, strnlen(name, sizeof row.name));
    for (uint32_t user = 0; user < FB_USERS_MAX_; user++)
        if (fb_take_(board->own->file, FB_USER_LOCKS_ + user)) {
            board->user = user;
            memcpy(board->own->map + FB_USERS_AT_ + user * FB_USER_SIZE_, &row, sizeof row);
            return 0;
        }
    return fb_fail_(EUSERS, "cannot use the board %.400s: %d programs use it already; end some of them", board->directory, FB_USERS_MAX_);
}

/* Open `own`, or make the board: 0; 1: others made or removed it meanwhile, look again; -errno. */
static inline int fb_enter_(fb_board *board, bool is_named)
{
    char path[PATH_MAX + 8];
    int outcome = 0, file;
    snprintf(path, sizeof path, "%s/own", board->directory);
    file = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (file < 0 && errno == ENOENT) {
        file = fb_make_(board, is_named);
        if (file < 0)
            return file == -EEXIST ? 1 : file;
    } else if (file < 0) {
        return fb_fail_(errno, "cannot open the board %.400s: %s; its user or group may (the group of [board] in team.toml)", board->directory,
                        strerror(errno));
    } else {
        outcome = fb_take_table_(file, board->directory);
        if (outcome == 0 && !fb_is_still_(path, file))
            outcome = 1;
        if (outcome == 0 && fb_is_abandoned_(file)) {
            fb_remove_(board, file);
            outcome = 1;
        }
    }
    if (outcome == 0) {
        board->own = fb_mapped_(board, "own", file);
        outcome = board->own == NULL ? -errno : fb_be_user_(board);
    }
    if (board->own == NULL)
        close(file);
    else if (outcome == 0)
        fb_give_(file, FB_TABLE_LOCK_);
    return outcome;
}

/* Open the other files with items of this robot. */
static inline void fb_open_others_(fb_board *board)
{
    DIR *folder = opendir(board->directory);
    for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); entry != NULL; entry = readdir(folder))
        if (strcmp(entry->d_name, "private") == 0 || strncmp(entry->d_name, "own+", 4) == 0)
            fb_mapped_(board, entry->d_name, -1);
    if (folder != NULL)
        closedir(folder);
}

static inline int fb_add_again_(fb_board *board, const fb_declaration *wanted);

/* The board is open, of this robot and this process: 0 or -errno. The guard is held. */
static inline int fb_ensure_(fb_board *board)
{
    const struct timespec pause = {0, 1000000};
    bool is_named = false;
    int outcome = 1;
    if (board->own != NULL && !board->is_forked &&
        !fb_is_lost_(fb_load_((const uint64_t *)(const void *)(board->own->map + FB_GENERATION_AT_))))
        return 0;
    fb_give_up_(board);
    board->is_forked = false;
    board->skew = fb_skew_();
    outcome = fb_find_directory_(board, &is_named);
    for (int turn = 0; outcome >= 0 && turn < FB_TURNS_ * 10 + FB_GONE_MS_; turn++) {
        outcome = fb_enter_(board, is_named);
        if (outcome == 0)
            break;
        fb_give_up_(board);
        if (outcome == -ESTALE) {
            const int64_t now = fb_clock_(CLOCK_MONOTONIC);
            board->gone = board->gone == 0 ? now : board->gone;
            if (now - board->gone < (int64_t)FB_GONE_MS_ * 1000000) {
                nanosleep(&pause, NULL);
                outcome = 1;
            }
        }
    }
    board->gone = outcome == 0 ? 0 : board->gone;
    if (outcome == 1)
        outcome = fb_fail_(ESTALE, "cannot open the board %.400s: others make and remove it meanwhile; try again", board->directory);
    if (outcome != 0)
        return outcome;
    fb_open_others_(board);
    for (fb_added_ *added = board->added; added != NULL; added = added->next)
        fb_add_again_(board, &added->wanted); /* what is refused there is told when it is used */
    return 0;
}

/* --- Items of one user ------------------------------------------------------------------------------------------------------------------
 *
 * BOARD.md, "Files of one user": the agent's table says whose items are whose; what a file says otherwise of itself is not believed. */

typedef struct fb_owner_ {
    char name[FB_NAME_MAX_ + 1], user[FB_NAME_MAX_ + 2], file[24]; /* `file`: "" where no program of this robot can put it */
} fb_owner_;

static inline fb_area_ *fb_peer_(fb_board *board, const char *robot);
static inline void fb_lies_(fb_place_ *place, fb_area_ *area, uint32_t index, const fb_record_ *record, uint64_t skew);
static inline int fb_copy_(const char *name, const fb_place_ *place, void *value, fb_reading *reading, uint64_t *stamp, uint32_t *error_us);

/* Find an item in a table, by its name, or, where that is NULL, by its number: 1, 0 or -EBADMSG. */
static inline int fb_owner_in_(char *table, const char *name, uint32_t id, fb_owner_ *owner)
{
    const size_t size = name == NULL ? 0 : strlen(name);
    for (char *line = table, *end = strchr(line, '\n'); end != NULL; line = end + 1, end = strchr(line, '\n')) {
        char uid[12];
        unsigned number;
        *end = '\0';
        if (name != NULL && (strncmp(line, name, size) != 0 || line[size] != ' '))
            continue;
        if (sscanf(line, "%63s %u %11s %64s", owner->name, &number, uid, owner->user) != 4)
            return fb_fail_(EBADMSG, "damaged: the agent's table of items of one user");
        snprintf(owner->file, sizeof owner->file, "%s%s", *uid == '-' ? "" : "own+", *uid == '-' ? "" : uid);
        if (name != NULL || number == id)
            return 1;
    }
    return 0;
}

/* Whose an item is: 1, one user's alone; 0, nobody's; -ENODATA: the agent tells nothing of that; another error. The guard is held. */
static inline int fb_whose_(fb_board *board, const char *name, uint32_t id, fb_owner_ *owner)
{
    fb_area_ *area;
    fb_record_ record;
    fb_reading reading;
    fb_place_ place;
    uint64_t stamp;
    uint32_t error_us;
    char *table;
    int index;
    if ((board->own->flags & FB_ALONE_) != 0)
        return -ENODATA;
    area = fb_peer_(board, FB_AGENT_);
    if (area == NULL)
        return errno == ENOENT ? -ENODATA : -errno;
    index = fb_search_(area, "owners", 0, &record);
    if (index < 0)
        return index == -ENOENT ? -ENODATA : index;
    table = (char *)calloc(1, (size_t)record.size + 1);
    if (table == NULL)
        return fb_fail_(ENOMEM, "cannot look an item up: no memory");
    fb_lies_(&place, area, (uint32_t)index, &record, 0);
    index = fb_copy_("owners", &place, table, &reading, &stamp, &error_us);
    index = index == 0 ? fb_owner_in_(table, name, id, owner) : index;
    free(table);
    return index;
}

/* Whether an item may stand in one of this robot's files: 1, 0 or an error. */
static inline int fb_is_rightful_(fb_board *board, const fb_area_ *area, const char *name)
{
    fb_owner_ owner;
    const int whose = fb_whose_(board, name, 0, &owner);
    if (whose < 0)
        return whose == -ENODATA ? 1 : whose;
    return whose == 0 ? !area->always_wakes : strcmp(area->name, owner.file) == 0;
}

/* The file of one user, opened if it is not open; NULL, with errno, where there is none. */
static inline fb_area_ *fb_of_user_(fb_board *board, const char *file)
{
    for (fb_area_ *area = board->areas; area != NULL; area = area->next)
        if (strcmp(area->name, file) == 0)
            return area;
    return fb_mapped_(board, file, -1);
}

/* Find this robot's item, by its name, or, where that is NULL, by its number, in the files where it may stand. Index, -ENOENT, or another
 * error. The guard is held. */
static inline int fb_search_own_(fb_board *board, const char *name, uint32_t id, fb_record_ *record, fb_area_ **found)
{
    fb_owner_ owner;
    const int whose = fb_whose_(board, name, id, &owner);
    int index = -ENOENT;
    if (whose < 0 && whose != -ENODATA)
        return whose;
    if (whose > 0 && *owner.file == '\0')
        return fb_fail_(EACCES, "item %s is for user %s alone; no program of %s can put it: failover status says why, or its robots in "
                        "team.toml leave %s out", owner.name, owner.user, board->own->robot, board->own->robot);
    if (whose > 0) {
        *found = fb_of_user_(board, owner.file);
        return *found == NULL ? -errno : fb_search_(*found, owner.name, 0, record);
    }
    for (fb_area_ *area = board->areas; index == -ENOENT && area != NULL; area = area->next) {
        index = area->is_peer || (whose == 0 && area->always_wakes) ? -ENOENT : fb_search_(area, name, id, record);
        *found = area;
    }
    return index;
}

/* --- Adding items ---------------------------------------------------------------------------------------------------------------------- */

/* Begin to change a table: its lock is held, its generation is odd. */
static inline int fb_begin_change_(fb_board *board, fb_area_ *area)
{
    uint64_t *generation = (uint64_t *)(void *)(area->map + FB_GENERATION_AT_), now;
    int failed = fb_take_table_(area->file, board->directory);
    if (failed != 0)
        return failed;
    now = fb_load_(generation);
    if (fb_is_lost_(now)) {
        fb_give_(area->file, FB_TABLE_LOCK_);
        return -ESTALE;
    }
    __atomic_store_n(generation, now + now % 2 + 1, __ATOMIC_SEQ_CST);
    return 0;
}

static inline void fb_end_change_(fb_area_ *area)
{
    uint64_t *generation = (uint64_t *)(void *)(area->map + FB_GENERATION_AT_), now = fb_load_(generation);
    if (!fb_is_lost_(now) && now % 2 != 0)
        __atomic_store_n(generation, now + 1, __ATOMIC_SEQ_CST);
    fb_give_(area->file, FB_TABLE_LOCK_);
}

/* Write name, text and record of one more item; the table may be changed. */
static inline int fb_append_(fb_area_ *area, const fb_record_ *wanted, const char *name, const char *text)
{
    const uint64_t reach = fb_reach_(area);
    const uint16_t name_size = (uint16_t)strlen(name), text_size = (uint16_t)strlen(text);
    unsigned char *slot;
    fb_record_ record = *wanted;
    fb_header_ header;
    uint64_t begin, size;
    uint32_t first, index;
    int failed = fb_examined_(area, reach, &header);
    if (failed != 0)
        return failed;
    begin = header.size;
    if (header.count >= header.capacity)
        return fb_fail_(ENOSPC, "cannot add item %s: the table has %u records and no room for more; start the board anew", name, header.count);
    if (begin < fb_names_at_(header.capacity) || begin > FB_FILE_SIZE_MAX_)
        return fb_fail_(EBADMSG, "cannot add item %s: the file says that it has %llu bytes", name, (unsigned long long)begin);
    record.name = begin;
    record.offset = fb_aligned_(begin + 4 + name_size + text_size);
    size = record.offset + (uint64_t)record.banks * record.stride;
    if (size > FB_FILE_SIZE_MAX_)
        return fb_fail_(ENOSPC, "cannot add item %s: the file would have %llu bytes; %d are possible", name, (unsigned long long)size,
                        FB_FILE_SIZE_MAX_);
    first = FB_ITEMS_MAX_ * (header.rank + 1);
    record.id = first;
    for (index = 0; index < header.count; index++) {
        const uint32_t id = fb_half_(area->map + FB_RECORDS_AT_ + (uint64_t)index * FB_RECORD_SIZE_);
        record.id = id >= record.id && id != UINT32_MAX ? id + 1 : record.id;
    }
    if (ftruncate(area->file, (off_t)(size > reach ? size : reach)) != 0)
        return fb_fail_(errno, "cannot add item %s: %s", name, strerror(errno));
    memcpy(area->map + begin, &name_size, 2);
    memcpy(area->map + begin + 2, name, name_size);
    memcpy(area->map + begin + 2 + name_size, &text_size, 2);
    memcpy(area->map + begin + 4 + name_size, text, text_size);
    slot = area->map + FB_RECORDS_AT_ + (uint64_t)header.count * FB_RECORD_SIZE_;
    memset(slot, 0, FB_RECORD_SIZE_);
    memcpy(slot, &record, sizeof record);
    __atomic_store_n((uint64_t *)(void *)(area->map + FB_SIZE_AT_), size, __ATOMIC_RELEASE);
    __atomic_store_n((uint32_t *)(void *)(area->map + FB_COUNT_AT_), header.count + 1, __ATOMIC_RELEASE);
    return 0;
}

static inline int fb_add_again_(fb_board *board, const fb_declaration *wanted)
{
    const char *text = wanted->type;
    fb_area_ *target = board->own, *where = NULL;
    fb_record_ record, found;
    int outcome;
    memset(&record, 0, sizeof record);
    record.kind = (uint16_t)wanted->kind;
    record.banks = (uint16_t)(wanted->banks == 0 ? 2 : wanted->banks);
    record.size = wanted->size;
    record.stride = (uint32_t)fb_aligned_((uint64_t)FB_BANK_HEAD_ + wanted->size);
    record.period = wanted->period == 0 ? 1 : wanted->period;
    record.phase = wanted->phase;
    record.digest = fb_digest_(text, strlen(text));
    record.bound = (uint64_t)wanted->bound_ns;
    record.flags = (wanted->flags & (FB_URGENT | FB_NOT_SENT | FB_KEPT | FB_FINITE)) | FB_ADDED_;
    for (fb_area_ *area = board->areas; wanted->is_private && area != NULL; area = area->next)
        target = (area->flags & FB_PRIVATE_) != 0 ? area : target;
    if (wanted->is_private && (target->flags & FB_PRIVATE_) == 0)
        return fb_fail_(ENOENT, "cannot add item %s: the board %.300s has no file for private items", wanted->name, board->directory);
    if (!target->is_writable)
        return fb_fail_(EACCES, "cannot add item %s: %s may only be read by uid %u", wanted->name, target->name, (unsigned)geteuid());
    outcome = fb_begin_change_(board, target);
    if (outcome != 0)
        return outcome;
    outcome = fb_search_own_(board, wanted->name, 0, &found, &where);
    if (outcome >= 0 && ((where != target && !where->always_wakes) || found.kind != record.kind || found.banks != record.banks ||
                         found.size != record.size || found.period != record.period || found.phase != record.phase ||
                         found.bound != record.bound || found.digest != record.digest))
        outcome = fb_fail_(EEXIST, "cannot add item %s: it is declared otherwise already in %s (%u bytes, period %u, banks %u)", wanted->name,
                           where->name, found.size, found.period, found.banks);
    outcome = outcome == -ENOENT ? fb_append_(target, &record, wanted->name, text) : outcome < 0 ? outcome : 0;
    fb_end_change_(target);
    return outcome;
}

static inline int fb_add(fb_board *board, const fb_declaration *wanted)
{
    static const char *const kinds[] = {"bytes", "struct", "msgpack", "json"};
    const char *name = wanted->name == NULL ? "" : wanted->name, *type = wanted->type;
    char opaque[32];
    size_t text_size;
    fb_added_ *added;
    int outcome;
    if (wanted->kind > FB_JSON || (wanted->kind == FB_STRUCT) != (type != NULL))
        return fb_fail_(EINVAL, "cannot add item %.80s: a struct has a type in words, other kinds have none", name);
    if (type == NULL) {
        snprintf(opaque, sizeof opaque, "%s[%u]", kinds[wanted->kind], wanted->size);
        type = opaque;
    }
    text_size = strlen(type);
    if (*name == '\0' || strlen(name) > FB_NAME_MAX_ || text_size > FB_TEXT_MAX_)
        return fb_fail_(EINVAL, "cannot add item %.80s: a name has 1 to %d bytes and a type at most %d", name, FB_NAME_MAX_, FB_TEXT_MAX_);
    if (wanted->size < 1 || wanted->size > FB_SIZE_MAX_ || (wanted->banks != 0 && wanted->banks < 2) ||
        wanted->banks > FB_BANKS_MAX_ || wanted->phase >= (wanted->period == 0 ? 1 : wanted->period) || wanted->bound_ns < 0)
        return fb_fail_(EINVAL, "cannot add item %s: 1 to %d bytes, 2 to %d banks, a phase below the period, a bound from 0 are possible", name,
                        FB_SIZE_MAX_, FB_BANKS_MAX_);
    if (!wanted->is_private && wanted->size > FB_SHARED_SIZE_MAX_)
        return fb_fail_(EINVAL, "cannot add item %s: a shared item holds at most %d bytes; make it private, or split it", name,
                        FB_SHARED_SIZE_MAX_);
    added = (fb_added_ *)calloc(1, sizeof *added + text_size + 1);
    if (added == NULL)
        return fb_fail_(ENOMEM, "cannot add item %s: no memory", name);
    added->wanted = *wanted;
    memcpy(added->name, name, strlen(name));
    added->wanted.name = added->name;
    added->wanted.type = (const char *)memcpy((char *)(added + 1), type, text_size + 1);
    pthread_mutex_lock(&board->guard);
    outcome = -ESTALE;
    for (int turn = 0; outcome == -ESTALE && turn < FB_TURNS_; turn++) {
        if (turn > 0)
            fb_forget_gone_(board);
        outcome = fb_ensure_(board);
        outcome = outcome == 0 ? fb_add_again_(board, &added->wanted) : outcome;
    }
    if (outcome == 0) {
        added->next = board->added;
        board->added = added;
    }
    pthread_mutex_unlock(&board->guard);
    if (outcome != 0)
        free(added);
    return outcome;
}

static inline int fb_remove(fb_board *board, const char *name)
{
    fb_record_ record;
    int outcome = -ESTALE;
    if (name == NULL || *name == '\0' || strlen(name) > FB_NAME_MAX_)
        return fb_fail_(EINVAL, "cannot remove item %.80s: a name has 1 to %d bytes", name == NULL ? "" : name, FB_NAME_MAX_);
    pthread_mutex_lock(&board->guard);
    for (int turn = 0; outcome == -ESTALE && turn < FB_TURNS_; turn++) {
        fb_area_ *found = NULL;
        int index = -ENOENT;
        if (turn > 0)
            fb_forget_gone_(board);
        outcome = fb_ensure_(board);
        if (outcome == 0)
            index = fb_search_own_(board, name, 0, &record, &found);
        if (outcome == 0 && index == -ENOENT)
            outcome = fb_fail_(ENOENT, "cannot remove item %s: this robot has none on the board %.300s", name, board->directory);
        else if (outcome == 0 && index < 0)
            outcome = index;
        else if (outcome == 0 && !found->is_writable)
            outcome = fb_fail_(EACCES, "cannot remove item %s: %s may only be read by uid %u", name, found->name, (unsigned)geteuid());
        if (outcome != 0)
            continue;
        outcome = fb_begin_change_(board, found);
        if (outcome != 0)
            continue;
        index = fb_search_(found, name, 0, &record); /* another process may have removed it since */
        if (index >= 0)
            __atomic_store_n((uint16_t *)(void *)(found->map + FB_RECORDS_AT_ + (uint64_t)index * FB_RECORD_SIZE_ + FB_BANKS_), 0, __ATOMIC_RELEASE);
        fb_end_change_(found);
        outcome = index < 0 && index != -ENOENT ? index : 0;
    }
    for (fb_added_ **link = &board->added; outcome == 0 && *link != NULL;) {
        fb_added_ *added = *link;
        if (strcmp(added->name, name) == 0) {
            *link = added->next;
            free(added);
        } else {
            link = &added->next;
        }
    }
    pthread_mutex_unlock(&board->guard);
    return outcome;
}

/* --- Places of items --------------------------------------------------------------------------------------------------------------------- */

/* The place of a robot's item as far as it is known. */
static inline fb_place_ *fb_known_(fb_item *item, const char *robot)
{
    fb_place_ *place;
    if (robot == NULL)
        return __atomic_load_n(&item->own, __ATOMIC_ACQUIRE);
    for (place = __atomic_load_n(&item->peers, __ATOMIC_ACQUIRE); place != NULL; place = __atomic_load_n(&place->next, __ATOMIC_ACQUIRE))
        if (strcmp(place->robot, robot) == 0)
            return place;
    return NULL;
}

/* Whether an item is of the type that the caller means: 0 or -EPROTOTYPE. */
static inline int fb_fits_(const fb_item *item, const fb_record_ *record, const char *robot)
{
    if (item->digest != 0 && record->digest != item->digest)
        return fb_fail_(EPROTOTYPE, "item %s of %s has another type (digest %016llx) than this program was compiled for (%016llx)", item->name,
                        robot, (unsigned long long)record->digest, (unsigned long long)item->digest);
    if (record->kind == FB_STRUCT ? record->size != item->size : record->size > item->size)
        return fb_fail_(EPROTOTYPE, "item %s of %s has values of %u bytes; this program means %llu", item->name, robot, record->size,
                        (unsigned long long)item->size);
    return 0;
}

/* The file of another robot's items. NULL, with errno, where there is none. */
static inline fb_area_ *fb_peer_(fb_board *board, const char *robot)
{
    char name[80];
    const bool is_agents = strcmp(robot, FB_AGENT_) == 0, is_none = *robot == '\0' || strlen(robot) > 64 || (!is_agents && strchr(robot, '/') != NULL);
    snprintf(name, sizeof name, "%s%.64s", is_agents ? "agent" : "peer-", is_agents ? "" : robot);
    for (fb_area_ *area = board->areas; area != NULL && !is_none; area = area->next)
        if (area->is_peer && strcmp(area->name, name) == 0)
            return area;
    if (is_none || fb_mapped_(board, name, -1) == NULL) {
        if (is_agents && errno == ENOENT)
            fb_fail_(ENOENT, "no agent has made the board %.300s: it alone knows which robot runs a component; read the item of a robot by its name",
                     board->directory);
        else if (is_none || errno == ENOENT)
            fb_fail_(ENOENT, "there is no robot %.80s on the board %.300s", robot, board->directory);
        return NULL;
    }
    return board->areas;
}

/* Where the item of a record lies. */
static inline void fb_lies_(fb_place_ *place, fb_area_ *area, uint32_t index, const fb_record_ *record, uint64_t skew)
{
    place->area = area;
    place->generation = (const uint64_t *)(const void *)(area->map + FB_GENERATION_AT_);
    place->record = area->map + FB_RECORDS_AT_ + (uint64_t)index * FB_RECORD_SIZE_;
    place->newest = (uint64_t *)(void *)(place->record + FB_NEWEST_);
    place->banks = area->map + record->offset;
    place->stride = record->stride;
    place->count = record->banks;
    place->limit = record->size;
    place->bound = record->bound;
    place->skew = skew;
    place->index = index;
    place->declared = *record;
    place->remembered = FB_UNKNOWN_;
}

/* Find out where an item lies; the guard is held. */
static inline int fb_bind_(fb_item *item, const char *robot)
{
    fb_board *board = item->board;
    const bool is_own = robot == NULL || strcmp(robot, board->own->robot) == 0;
    const char *whose = is_own ? board->own->robot : robot;
    fb_area_ *found = NULL;
    fb_record_ record;
    fb_place_ *place;
    int index = -ENOENT;
    if (is_own) {
        index = fb_search_own_(board, item->name, 0, &record, &found);
    } else {
        found = fb_peer_(board, robot);
        if (found == NULL)
            return -errno;
        index = fb_search_(found, item->name, 0, &record);
    }
    if (index == -ENOENT)
        return fb_fail_(ENOENT, "%s has no item %s on the board %.300s; declare it in team.toml, or with fb_add()", whose, item->name,
                        board->directory);
    if (index < 0)
        return index;
    index = fb_fits_(item, &record, whose) != 0 ? -EPROTOTYPE : index;
    if (index < 0)
        return index;
    place = (fb_place_ *)calloc(1, sizeof *place);
    if (place == NULL)
        return fb_fail_(ENOMEM, "cannot use item %s: no memory", item->name);
    found->is_used = true;
    fb_lies_(place, found, (uint32_t)index, &record, (uint64_t)board->skew);
    place->is_own = is_own;
    if (robot != NULL)
        snprintf(place->robot, sizeof place->robot, "%.64s", robot);
    if (robot == NULL) {
        __atomic_store_n(&item->own, place, __ATOMIC_RELEASE);
    } else {
        place->next = item->peers;
        __atomic_store_n(&item->peers, place, __ATOMIC_RELEASE);
    }
    return 0;
}

/* Forget where an item lay: another one is there. */
static inline void fb_unbind_(fb_item *item, fb_place_ *place)
{
    fb_place_ **link = &item->peers;
    if (place == item->own) {
        if (place->has_lock)
            fb_give_(place->area->file, FB_WRITER_LOCKS_ + place->index);
        place->has_lock = false;
        __atomic_store_n(&item->own, NULL, __ATOMIC_RELEASE);
    } else {
        while (*link != place)
            link = &(*link)->next;
        __atomic_store_n(link, place->next, __ATOMIC_RELEASE); /* its own `next` stays: a thread may stand there */
    }
    place->older = item->board->given_up;
    item->board->given_up = place;
}

/* Become the only writer of an item: 0 or -EBUSY. */
static inline int fb_take_item_(fb_item *item, fb_place_ *place)
{
    uint64_t newest, begin = fb_epoch_() << FB_EPOCH_BITS_;
    uint32_t pid = (uint32_t)getpid();
    fb_owner_ owner;
    if (!place->is_own)
        return fb_fail_(EPERM, "item %s of %s is another robot's: it can only be read here", item->name, place->robot);
    if (!place->area->is_writable && place->area->always_wakes && fb_whose_(item->board, item->name, 0, &owner) == 1)
        return fb_fail_(EACCES, "item %s cannot be put: user %s (uid %s) alone may put it, and this program runs as uid %u", item->name,
                        owner.user, place->area->name + 4, (unsigned)geteuid());
    if (!place->area->is_writable)
        return fb_fail_(EACCES, "item %s may only be read by uid %u", item->name, (unsigned)geteuid());
    if (!fb_take_(place->area->file, FB_WRITER_LOCKS_ + place->index))
        return fb_fail_(EBUSY, "item %s is written by pid %u: an item has one writer", item->name, fb_half_(place->record + FB_PID_));
    memcpy(place->record + FB_PID_, &pid, 4);
    newest = fb_load_(place->newest);
    place->number = newest > begin ? newest : begin;
    if (newest != 0 && (place->number + 1) % place->count == newest % place->count)
        place->number++; /* the first put must not go into the bank that is read meanwhile */
    place->has_lock = true;
    return 0;
}

/* Forget what was removed or made anew; the whole board only where a file is lost in which all have items. The guard is held. */
static inline void fb_forget_lost_(fb_board *board)
{
    fb_forget_gone_(board);
    for (const fb_area_ *area = board->areas; area != NULL; area = area->next)
        if (!area->is_peer && !area->always_wakes && !fb_is_there_(area)) {
            fb_give_up_(board);
            return;
        }
}

/* Examine what is not as it was remembered, and give the place of an item: 0 or -errno. */
static inline int fb_settle_(fb_item *item, const char *robot, bool to_put, fb_place_ **found)
{
    fb_board *board = item->board;
    int lost = 0, outcome;
    pthread_mutex_lock(&board->guard);
    outcome = fb_fail_(ESTALE, "item %s: the board %.300s was made anew %d times meanwhile", item->name, board->directory, FB_TURNS_);
    for (int turn = 0; turn < FB_TURNS_; turn++) {
        int failed = fb_ensure_(board);
        fb_place_ *place = fb_known_(item, robot);
        if (failed == 0 && place == NULL) {
            failed = fb_bind_(item, robot);
            place = fb_known_(item, robot);
        }
        if (failed == -ESTALE && ++lost < 3) { /* made anew since it was opened; or that file alone is gone, and stays so */
            fb_forget_lost_(board);
            continue;
        }
        if (failed != 0) {
            outcome = failed;
            break;
        }
        const uint64_t generation = fb_load_(place->generation);
        if (fb_is_lost_(generation)) {
            fb_forget_lost_(board);
            continue;
        }
        if (generation != place->remembered) {
            if (!fb_holds_(place, item)) {
                fb_unbind_(item, place);
                continue;
            }
            if (generation % 2 == 0) {
                __atomic_store_n(&place->remembered, generation, __ATOMIC_RELEASE);
            } else if (place->area->is_writable && fb_take_(place->area->file, FB_TABLE_LOCK_)) { /* the process that made it odd has died */
                fb_end_change_(place->area);
            }
        }
        outcome = to_put && !place->has_lock ? fb_take_item_(item, place) : 0;
        *found = place;
        break;
    }
    pthread_mutex_unlock(&board->guard);
    return outcome;
}

/* --- Get, put, wait ------------------------------------------------------------------------------------------------------------------------ */

static inline bool fb_is_good_(const fb_place_ *place)
{
    return place != NULL && fb_load_(place->generation) == __atomic_load_n(&place->remembered, __ATOMIC_RELAXED);
}

/* How old a value is at an instant of the machine's clock; the rest of the reading is there. */
static inline void fb_age_(const fb_place_ *place, uint64_t stamp, uint32_t error_us, uint64_t now, fb_reading *reading)
{
    const int64_t age = (int64_t)(now - stamp);
    const uint64_t bound = place->bound != 0 ? place->bound : __atomic_load_n((const uint64_t *)(const void *)(place->record + FB_FORMULA_), __ATOMIC_RELAXED);
    reading->age_ns = age < 0 ? 0 : age;
    reading->age_max_ns = error_us == UINT32_MAX || reading->age_ns > INT64_MAX - (int64_t)error_us * 1000
                              ? INT64_MAX
                              : reading->age_ns + (int64_t)error_us * 1000;
    reading->stale = bound != 0 && (uint64_t)reading->age_max_ns > bound;
}

static inline uint64_t fb_now_(uint64_t skew) { return (uint64_t)fb_clock_(CLOCK_BOOTTIME) - skew; }

/* The newest value at a place, whole, with its number and size; `stamp` and `error_us` as the bank has them. */
static inline int fb_copy_(const char *name, const fb_place_ *place, void *value, fb_reading *reading, uint64_t *stamp, uint32_t *error_us)
{
    for (int turn = 0; turn < FB_RETRIES_; turn++) {
        const uint64_t number = fb_load_(place->newest);
        if (number == 0)
            return fb_fail_(ENODATA, "item %s was never written: start its writer, or try again later", name);
        const unsigned char *bank = place->banks + (place->count == 2 ? number & 1 : number % place->count) * place->stride;
        *stamp = __atomic_load_n((const uint64_t *)(const void *)(bank + 8), __ATOMIC_RELAXED);
        const uint64_t sum = __atomic_load_n((const uint64_t *)(const void *)(bank + 16), __ATOMIC_RELAXED);
        const uint64_t said = __atomic_load_n((const uint64_t *)(const void *)(bank + 24), __ATOMIC_RELAXED);
        const uint32_t size = (uint32_t)said;
        if (size <= place->limit)
            memcpy(value, bank + FB_BANK_HEAD_, size);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        if (__atomic_load_n((const uint64_t *)(const void *)bank, __ATOMIC_RELAXED) != number)
            continue;
        if (size > place->limit)
            return fb_fail_(EBADMSG, "damaged: item %s: a value of %u bytes where %llu are the most; its writer must put it anew", name, size,
                            (unsigned long long)place->limit);
        if (FB_SUMS && sum != 0 && sum != (fb_digest_(value, size) ^ *stamp ^ number))
            continue;
        *error_us = (uint32_t)(said >> 32);
        reading->number = number;
        reading->size = size;
        return 0;
    }
    return fb_fail_(EAGAIN, "item %s was written %d times while it was read, or by two at once: give it more banks than %u, or put less often", name,
                    FB_RETRIES_, place->count);
}

/* The newest value at a place, whole, and its age. */
static inline int fb_read_(const fb_item *item, const fb_place_ *place, void *value, fb_reading *reading)
{
    uint64_t stamp = 0;
    uint32_t error_us = 0;
    const int outcome = fb_copy_(item->name, place, value, reading, &stamp, &error_us);
    if (outcome == 0)
        fb_age_(place, stamp, error_us, fb_now_(place->skew), reading);
    return outcome;
}

static inline int fb_get_reading(fb_item *item, const char *robot, void *value, fb_reading *reading)
{
    int outcome = -ESTALE;
    for (int turn = 0; turn < FB_TURNS_; turn++) {
        fb_place_ *place = fb_known_(item, robot);
        if (!fb_is_good_(place)) {
            outcome = fb_settle_(item, robot, false, &place);
            if (outcome != 0)
                return outcome;
        }
        outcome = fb_read_(item, place, value, reading);
        if (outcome == 0 || !fb_is_lost_(fb_load_(place->generation)))
            return outcome;
    }
    return outcome;
}

static inline int64_t fb_get(fb_item *item, const char *robot, void *value, int64_t *age_max)
{
    fb_reading reading;
    int outcome = fb_get_reading(item, robot, value, &reading);
    if (outcome != 0)
        return outcome;
    if (age_max != NULL)
        *age_max = reading.age_max_ns;
    return reading.age_ns;
}

/* Wake those that wait for an item, or for any of several. */
static inline void fb_woken_(fb_place_ *place, uint64_t stamp)
{
    unsigned char *waiters = place->record + FB_WAITERS_;
    const unsigned char for_item = __atomic_exchange_n(waiters, 0, __ATOMIC_SEQ_CST), for_any = __atomic_exchange_n(waiters + 1, 0, __ATOMIC_SEQ_CST);
    if (for_any != 0 && (place->declared.flags & FB_URGENT) != 0)
        fb_tell_(place->area);
    if (for_item != 0 || place->area->always_wakes)
        fb_wake_(place->newest);
    if (for_any != 0) {
        __atomic_store_n((uint64_t *)(void *)(place->area->map + FB_CHANGED_AT_), stamp, __ATOMIC_SEQ_CST);
        fb_wake_(place->area->map + FB_CHANGED_AT_);
    }
}

/* Store one value; the item's lock is held. */
static inline void fb_store_(fb_place_ *place, const void *value, uint32_t size, uint64_t stamp)
{
    const uint64_t number = ++place->number;
    unsigned char *bank = place->banks + (place->count == 2 ? number & 1 : number % place->count) * place->stride;
    __atomic_store_n((uint64_t *)(void *)bank, 0, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    __atomic_store_n((uint64_t *)(void *)(bank + 8), stamp, __ATOMIC_RELAXED);
    __atomic_store_n((uint64_t *)(void *)(bank + 16), FB_SUMS ? fb_digest_(value, size) ^ stamp ^ number : 0, __ATOMIC_RELAXED);
    __atomic_store_n((uint64_t *)(void *)(bank + 24), (uint64_t)size, __ATOMIC_RELAXED);
    memcpy(bank + FB_BANK_HEAD_, value, size);
    __atomic_store_n((uint64_t *)(void *)bank, number, __ATOMIC_RELEASE);
    __atomic_store_n(place->newest, number, __ATOMIC_RELEASE);
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    if (__atomic_load_n((uint16_t *)(void *)(place->record + FB_WAITERS_), __ATOMIC_RELAXED) != 0 || place->area->always_wakes)
        fb_woken_(place, stamp);
}

/* Count a put that is refused, and say why. */
static inline int fb_refused_(const fb_item *item, const fb_place_ *place, size_t size, bool is_late)
{
    __atomic_fetch_add((uint64_t *)(void *)(place->record + FB_REFUSED_), 1, __ATOMIC_RELAXED);
    if (!is_late)
        return fb_fail_(EMSGSIZE, "item %s: a value of %zu bytes; the item holds %llu", item->name, size, (unsigned long long)place->limit);
    return fb_fail_(EINVAL, "item %s: it was measured in the future, or before the machine started; give ns of CLOCK_BOOTTIME", item->name);
}

static inline int fb_put_sized(fb_item *item, const void *value, size_t size, int64_t measured_ns)
{
    int outcome = -ESTALE;
    for (int turn = 0; turn < FB_TURNS_; turn++) {
        fb_place_ *place = __atomic_load_n(&item->own, __ATOMIC_ACQUIRE);
        if (!fb_is_good_(place) || !place->has_lock) {
            outcome = fb_settle_(item, NULL, true, &place);
            if (outcome != 0)
                return outcome;
        }
        const uint64_t now = (uint64_t)fb_clock_(CLOCK_BOOTTIME) - place->skew;
        const uint64_t stamp = measured_ns == FB_NOW ? now : (uint64_t)measured_ns - place->skew;
        if (size > place->limit || (place->declared.kind == FB_STRUCT && size != place->limit) || stamp > now)
            return fb_refused_(item, place, size, stamp > now);
        fb_store_(place, value, (uint32_t)size, stamp);
        if (!fb_is_lost_(fb_load_(place->generation)))
            return 0;
        outcome = -ESTALE; /* the board was another one meanwhile: put it there */
    }
    return outcome;
}

static inline int fb_put(fb_item *item, const void *value) { return fb_put_sized(item, value, (size_t)item->size, FB_NOW); }

static inline int fb_put_at(fb_item *item, const void *value, int64_t measured_ns)
{
    return fb_put_sized(item, value, (size_t)item->size, measured_ns);
}

static inline int fb_wait(fb_item *item, const char *robot, uint64_t after, const struct timespec *timeout)
{
    const int64_t limit = timeout == NULL ? INT64_MAX : (int64_t)timeout->tv_sec * 1000000000 + timeout->tv_nsec;
    const int64_t begin = fb_clock_(CLOCK_MONOTONIC);
    for (;;) {
        fb_place_ *place = fb_known_(item, robot);
        int64_t left = limit == INT64_MAX ? INT64_MAX : limit - (fb_clock_(CLOCK_MONOTONIC) - begin);
        if (!fb_is_good_(place)) {
            int failed = fb_settle_(item, robot, false, &place);
            if (failed != 0)
                return failed;
        }
        const unsigned char *changed = place->area->map + FB_CHANGED_AT_;
        const uint32_t change = __atomic_load_n((const uint32_t *)(const void *)changed, __ATOMIC_ACQUIRE);
        const uint64_t newest = fb_load_(place->newest);
        if (newest != 0 && newest != after && !fb_is_lost_(fb_load_(place->generation)))
            return 0;
        if (left <= 0)
            return fb_fail_(ETIMEDOUT, "item %s was not put in time", item->name);
        if (place->area->is_writable) {
            __atomic_store_n(place->record + FB_WAITERS_, 1, __ATOMIC_SEQ_CST);
            if (__atomic_load_n(place->newest, __ATOMIC_SEQ_CST) != newest)
                continue;
        }
        if (left > (int64_t)FB_SLICE_NS_)
            left = (int64_t)FB_SLICE_NS_;
        if (place->area->is_peer) /* one word for all items that a frame brings */
            fb_sleep_(changed, change, left);
        else
            fb_sleep_(place->newest, (uint32_t)newest, left);
    }
}

static inline int fb_wait_any(const fb_watched *watched, size_t count, const struct timespec *timeout)
{
    const int64_t limit = timeout == NULL ? INT64_MAX : (int64_t)timeout->tv_sec * 1000000000 + timeout->tv_nsec;
    const int64_t begin = fb_clock_(CLOCK_MONOTONIC);
    fb_sleeper_ sleepers[FB_WATCHED_MAX_];
    if (count < 1 || count > FB_WATCHED_MAX_)
        return fb_fail_(EINVAL, "cannot wait for %zu items; give 1 to %d", count, FB_WATCHED_MAX_);
    for (;;) {
        int64_t left = limit == INT64_MAX ? INT64_MAX : limit - (fb_clock_(CLOCK_MONOTONIC) - begin);
        unsigned words = 0;
        bool is_put = false;
        for (size_t step = 0; step < count; step++) {
            const size_t index = (fb_turn_ + step) % count;
            const fb_watched *one = &watched[index];
            fb_place_ *place = fb_known_(one->item, one->robot);
            unsigned word = 0;
            if (!fb_is_good_(place)) {
                int failed = fb_settle_(one->item, one->robot, false, &place);
                if (failed != 0)
                    return failed;
            }
            const unsigned char *changed = place->area->map + FB_CHANGED_AT_;
            const uint32_t change = __atomic_load_n((const uint32_t *)(const void *)changed, __ATOMIC_ACQUIRE);
            const uint64_t newest = fb_load_(place->newest);
            if (newest != 0 && newest != one->after && !fb_is_lost_(fb_load_(place->generation))) {
                fb_turn_ = index + 1;
                return (int)index;
            }
            const bool is_alone = place->area->always_wakes && !place->area->is_writable; /* its writer wakes for this item only */
            const uint64_t address = is_alone ? (uint64_t)(uintptr_t)place->newest : (uint64_t)(uintptr_t)changed;
            while (word < words && sleepers[word].address != address)
                word++;
            if (word == words) { /* one word for all items of a file, as it was before the first of them was looked at */
                sleepers[words].value = is_alone ? (uint32_t)newest : change;
                sleepers[words].address = address;
                sleepers[words].flags = FB_FUTEX_32_;
                sleepers[words++].unused = 0;
            }
            if (place->area->is_writable) {
                __atomic_store_n(place->record + FB_WAITERS_ + 1, 1, __ATOMIC_SEQ_CST);
                is_put = is_put || __atomic_load_n(place->newest, __ATOMIC_SEQ_CST) != newest;
            }
        }
        if (left <= 0)
            return fb_fail_(ETIMEDOUT, "none of the %zu items was put in time", count);
        if (!is_put)
            fb_sleep_any_(sleepers, words, left > (int64_t)FB_SLICE_NS_ ? (int64_t)FB_SLICE_NS_ : left);
    }
}

/* --- All robots ------------------------------------------------------------------------------------------------------------------------ */

/* Have this robot's files and those of all others open; the guard is held. 0 or -errno. */
static inline int fb_open_all_(fb_board *board)
{
    const int outcome = fb_ensure_(board);
    DIR *folder;
    if (outcome != 0)
        return outcome;
    fb_forget_gone_(board); /* those that were made anew are opened again */
    folder = opendir(board->directory);
    for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); entry != NULL; entry = readdir(folder))
        if (strncmp(entry->d_name, "peer-", 5) == 0)
            fb_peer_(board, entry->d_name + 5); /* one that is gone meanwhile is none */
        else if (strncmp(entry->d_name, "own+", 4) == 0)
            fb_of_user_(board, entry->d_name);
    if (folder != NULL)
        closedir(folder);
    return 0;
}

static inline int fb_youngest(fb_item *item, void *value, fb_reading *reading, char *robot)
{
    fb_board *board = item->board;
    char robots[FB_ROBOTS_MAX_][65];
    fb_reading other;
    unsigned count = 0;
    int outcome;
    memset(reading, 0, sizeof *reading);
    void *copied = malloc(item->size == 0 ? 1 : (size_t)item->size);
    if (copied == NULL)
        return fb_fail_(ENOMEM, "cannot read item %s: no memory", item->name);
    pthread_mutex_lock(&board->guard);
    outcome = fb_open_all_(board);
    if (outcome == 0)
        snprintf(robots[count++], sizeof robots[0], "%.64s", board->own->robot);
    for (const fb_area_ *area = board->areas; outcome == 0 && area != NULL && count < FB_ROBOTS_MAX_; area = area->next)
        if (strncmp(area->name, "peer-", 5) == 0 && fb_is_there_(area) &&
            __atomic_load_n((const uint32_t *)(const void *)(area->map + FB_STATE_AT_), __ATOMIC_RELAXED) == FB_RUN_)
            snprintf(robots[count++], sizeof robots[0], "%.64s", area->name + 5);
    pthread_mutex_unlock(&board->guard);
    outcome = outcome == 0 ? -ENODATA : outcome;
    for (unsigned index = 0; index < count && (outcome == 0 || outcome == -ENODATA); index++) {
        int found = fb_get_reading(item, index == 0 ? FB_OWN : robots[index], copied, &other);
        if (found == 0 && (outcome != 0 || other.age_ns < reading->age_ns)) {
            memcpy(value, copied, other.size);
            *reading = other;
            if (robot != NULL)
                memcpy(robot, robots[index], sizeof robots[index]);
            outcome = 0;
        } else if (found != 0 && found != -ENODATA && found != -ENOENT && found != -ESTALE && !(found == -EACCES && index == 0)) {
            outcome = found;
        }
    }
    free(copied);
    return outcome == -ENODATA ? fb_fail_(ENODATA, "item %s: no robot that is running has put it", item->name) : outcome;
}

/* A value of a snapshot. */
typedef struct fb_taken_ {
    struct fb_taken_ *next;
    fb_place_ place;
    fb_reading reading;
    uint64_t stamp;
    uint32_t error_us;
    char robot[65], name[FB_NAME_MAX_ + 1];
} fb_taken_; /* the value follows it */

/* Copy all items of a file that were ever put; the guard is held. Where the list goes on, or NULL: then `outcome` says why. */
static inline fb_taken_ **fb_taken_of_(fb_board *board, fb_area_ *area, fb_taken_ **end, int *outcome)
{
    const uint64_t reach = fb_reach_(area);
    fb_header_ header;
    *outcome = fb_examined_(area, reach, &header);
    for (uint32_t index = 0; *outcome >= 0 && index < header.count; index++) {
        const unsigned char *name = NULL;
        uint32_t size = 0;
        fb_record_ record;
        *outcome = fb_record_at_(area, reach, &header, index, &record, &name, &size);
        if (*outcome <= 0)
            continue;
        fb_taken_ *taken = (fb_taken_ *)calloc(1, sizeof *taken + record.size);
        if (taken == NULL) {
            *outcome = fb_fail_(ENOMEM, "cannot read the board %.300s: no memory", board->directory);
            break;
        }
        memcpy(taken->name, name, size);
        snprintf(taken->robot, sizeof taken->robot, "%.64s", area->robot);
        fb_lies_(&taken->place, area, index, &record, (uint64_t)board->skew);
        *outcome = area->is_peer ? 1 : fb_is_rightful_(board, area, taken->name);
        if (*outcome > 0)
            *outcome = fb_copy_(taken->name, &taken->place, taken + 1, &taken->reading, &taken->stamp, &taken->error_us);
        else if (*outcome == 0)
            *outcome = -ENODATA;
        if (*outcome != 0) {
            free(taken);
            *outcome = *outcome == -ENODATA || area->always_wakes ? 0 : *outcome;
        } else {
            *end = taken;
            end = &taken->next;
        }
    }
    if (*outcome < 0 && *outcome != -ENOMEM && area->always_wakes) /* its one user has damaged it: to get an item of it says so */
        *outcome = 0;
    return *outcome < 0 ? NULL : end;
}

static inline void fb_free_taken_(fb_taken_ **first)
{
    while (*first != NULL) {
        fb_taken_ *taken = *first;
        *first = taken->next;
        free(taken);
    }
}

/* Copy all items of all files that were ever put; the guard is held. 0 or -errno. */
static inline int fb_take_all_(fb_board *board, fb_taken_ **first)
{
    fb_taken_ **end = first;
    int outcome = fb_open_all_(board);
    for (fb_area_ *area = board->areas; outcome == 0 && area != NULL; area = area->next) {
        if (area->is_peer && (strcmp(area->name, "agent") == 0 || !fb_is_there_(area)))
            continue;
        fb_taken_ **begin = end;
        end = fb_taken_of_(board, area, begin, &outcome);
        outcome = outcome > 0 ? 0 : outcome;
        if (area->is_peer && outcome != 0 && !fb_is_there_(area)) { /* the robot has left meanwhile */
            fb_free_taken_(begin);
            end = begin;
            outcome = 0;
        }
    }
    return outcome;
}

static inline int fb_snapshot(fb_board *board, fb_told *told, void *context)
{
    fb_taken_ *first = NULL;
    int outcome = -ESTALE, count = 0;
    pthread_mutex_lock(&board->guard);
    for (int turn = 0; outcome == -ESTALE && turn < FB_TURNS_; turn++) {
        outcome = fb_take_all_(board, &first);
        if (outcome == -ESTALE) { /* this robot's board was made anew meanwhile */
            fb_free_taken_(&first);
            fb_give_up_(board);
        }
    }
    const uint64_t now = fb_now_((uint64_t)board->skew);
    for (fb_taken_ *taken = first; taken != NULL; taken = taken->next)
        fb_age_(&taken->place, taken->stamp, taken->error_us, now, &taken->reading);
    pthread_mutex_unlock(&board->guard);
    while (first != NULL) {
        fb_taken_ *taken = first;
        first = taken->next;
        if (outcome == 0) {
            told(context, taken->robot, taken->name, taken + 1, &taken->reading);
            count++;
        }
        free(taken);
    }
    return outcome == 0 ? count : outcome;
}

/* --- The item of a component ---------------------------------------------------------------------------------------------------------------
 *
 * The agent's file has one item, `primaries`: msgpack, component -> [robot, epoch, since]. */

/* What is read of msgpack: where it goes on, and what is left of it. A size that is not there makes `left` 0 and `is_bad` true. */
typedef struct fb_pack_ {
    const unsigned char *at;
    uint64_t left;
    bool is_bad;
} fb_pack_;

/* The next `size` bytes as a number, the highest first. */
static inline uint64_t fb_unpacked_(fb_pack_ *pack, uint32_t size)
{
    uint64_t number = 0;
    if (pack->left < size) {
        pack->is_bad = true;
        pack->left = 0;
        return 0;
    }
    for (uint32_t index = 0; index < size; index++)
        number = number << 8 | pack->at[index];
    pack->at += size;
    pack->left -= size;
    return number;
}

/* How many elements a map or an array has. */
static inline uint64_t fb_unpacked_count_(fb_pack_ *pack, uint32_t small, uint32_t wide)
{
    const uint32_t kind = (uint32_t)fb_unpacked_(pack, 1);
    if ((kind & 0xF0) == small)
        return kind & 0x0F;
    pack->is_bad = pack->is_bad || (kind != wide && kind != wide + 1);
    return fb_unpacked_(pack, kind == wide ? 2 : 4);
}

static inline uint64_t fb_unpacked_number_(fb_pack_ *pack)
{
    const uint32_t kind = (uint32_t)fb_unpacked_(pack, 1);
    if (kind < 0x80)
        return kind;
    pack->is_bad = pack->is_bad || kind < 0xCC || kind > 0xCF;
    return pack->is_bad ? 0 : fb_unpacked_(pack, 1u << (kind - 0xCC));
}

/* The next text; its length in `size`. */
static inline const char *fb_unpacked_text_(fb_pack_ *pack, uint64_t *size)
{
    const uint32_t kind = (uint32_t)fb_unpacked_(pack, 1);
    const bool is_small = (kind & 0xE0) == 0xA0;
    const char *text;
    pack->is_bad = pack->is_bad || (!is_small && (kind < 0xD9 || kind > 0xDB));
    *size = is_small ? kind & 0x1F : pack->is_bad ? 0 : fb_unpacked_(pack, 1u << (kind - 0xD9));
    text = (const char *)pack->at;
    if (*size > pack->left) {
        pack->is_bad = true;
        *size = 0;
    }
    pack->at += *size;
    pack->left -= *size;
    return text;
}

/* Find a component in the agent's table. 0, -ENOENT, -EBADMSG. */
static inline int fb_look_up_(fb_component *component, uint32_t size)
{
    fb_pack_ pack = {component->table, size, false};
    const uint64_t count = fb_unpacked_count_(&pack, 0x80, 0xDE);
    for (uint64_t index = 0; index < count && !pack.is_bad; index++) {
        uint64_t name_size, robot_size;
        const char *name = fb_unpacked_text_(&pack, &name_size);
        const bool is_short = fb_unpacked_count_(&pack, 0x90, 0xDC) != 3;
        const char *robot = fb_unpacked_text_(&pack, &robot_size);
        const uint64_t epoch = fb_unpacked_number_(&pack), since = fb_unpacked_number_(&pack);
        pack.is_bad = pack.is_bad || is_short || robot_size > 64;
        if (pack.is_bad || name_size != strlen(component->path) || memcmp(name, component->path, name_size) != 0)
            continue;
        memcpy(component->primary, robot, robot_size);
        component->primary[robot_size] = '\0';
        component->epoch = epoch;
        component->since = since;
        return 0;
    }
    if (pack.is_bad)
        return fb_fail_(EBADMSG, "damaged: the agent's table of primaries");
    return fb_fail_(ENOENT, "the agent knows no robot that runs %s; failover status shows the components of the team", component->path);
}

/* See which robot runs a component now. */
static inline int fb_see_primary_(fb_component *component)
{
    fb_place_ *place = fb_known_(component->primaries, FB_AGENT_);
    fb_reading reading;
    int outcome;
    if (component->seen != 0 && fb_is_good_(place) && fb_load_(place->newest) == component->seen)
        return 0;
    outcome = fb_get_reading(component->primaries, FB_AGENT_, component->table, &reading);
    if (outcome == -ENODATA)
        return fb_fail_(ENOENT, "the agent knows no robot that runs %s: it has just started", component->path);
    outcome = outcome == 0 ? fb_look_up_(component, reading.size) : outcome;
    component->seen = outcome == 0 ? reading.number : 0;
    return outcome;
}

/* What a robot has, behind the component's table: 0; -ENODATA where it has not the item, or has never put it. */
static inline int fb_of_robot_(fb_component *component, const char *robot, fb_reading *found)
{
    const int outcome = fb_get_reading(component->item, robot, component->table + FB_SIZE_MAX_, found);
    return outcome == -ENOENT ? -ENODATA : outcome;
}

static inline void fb_give_value_(const fb_component *component, const fb_reading *found, void *value, fb_reading *reading)
{
    memcpy(value, component->table + FB_SIZE_MAX_, found->size);
    *reading = *found;
}

static inline int fb_component_get(fb_component *component, void *value, fb_reading *reading)
{
    fb_reading found;
    int outcome = fb_see_primary_(component);
    memset(&found, 0, sizeof found);
    if (outcome != 0)
        return outcome;
    outcome = fb_of_robot_(component, component->primary, &found);
    if (outcome != 0 && outcome != -ENODATA)
        return outcome;
    /* Put by the copy that runs now: under its epoch, or since it runs there; its epoch may grow while it runs. */
    const int64_t put_ns = outcome != 0 ? 0 : fb_clock_(CLOCK_BOOTTIME) - component->item->board->skew - found.age_ns;
    if (outcome == 0 && (found.number >> FB_EPOCH_BITS_ >= component->epoch || put_ns >= (int64_t)component->since)) {
        fb_give_value_(component, &found, value, reading);
        component->last = found.number;
        memcpy(component->robot, component->primary, sizeof component->robot);
        return 0;
    }
    if (component->last != 0) {
        outcome = fb_of_robot_(component, component->robot, &found);
        if (outcome == 0 && found.number >= component->last)
            fb_give_value_(component, &found, value, reading);
        if (outcome == 0 ? found.number >= component->last : outcome != -ENODATA)
            return outcome;
    }
    return fb_fail_(ENODATA, "item %s of %s: it runs on %s under epoch %llu, and has not put it there yet", component->item->name,
                    component->path, component->primary, (unsigned long long)component->epoch);
}

static inline int fb_component_wait(fb_component *component, void *value, fb_reading *reading, uint64_t after,
                                    const struct timespec *timeout)
{
    const int64_t limit = timeout == NULL ? INT64_MAX : (int64_t)timeout->tv_sec * 1000000000 + timeout->tv_nsec;
    const int64_t begin = fb_clock_(CLOCK_MONOTONIC);
    for (;;) {
        const int outcome = fb_component_get(component, value, reading);
        const int64_t left = limit == INT64_MAX ? (int64_t)FB_FOLLOW_NS_ : limit - (fb_clock_(CLOCK_MONOTONIC) - begin);
        const struct timespec slice = {0, (long)(left < (int64_t)FB_FOLLOW_NS_ ? left : (int64_t)FB_FOLLOW_NS_)};
        uint64_t newest;
        if (outcome != 0 && outcome != -ENODATA)
            return outcome;
        if (outcome == 0 && reading->number != after)
            return 0;
        if (left <= 0)
            return fb_fail_(ETIMEDOUT, "item %s of %s was not put in time", component->item->name, component->path);
        fb_place_ *place = fb_known_(component->item, component->primary);
        newest = fb_is_good_(place) ? fb_load_(place->newest) : 0;
        if (fb_wait(component->item, component->primary, newest, &slice) == -ENOENT)
            nanosleep(&slice, NULL);
    }
}

static inline const char *fb_component_robot(const fb_component *component) { return component->robot; }

static inline fb_item *fb_new_item_(fb_board *board, const char *name, uint64_t size, uint64_t digest)
{
    fb_item *item = (fb_item *)calloc(1, sizeof *item);
    if (item != NULL) {
        item->board = board;
        item->size = size;
        item->digest = digest;
        memcpy(item->name, name, strlen(name));
    }
    return item;
}

static inline fb_component *fb_of(fb_item *item, const char *component)
{
    fb_board *board = item->board;
    fb_component *made = NULL;
    if (component == NULL || *component == '\0' || strlen(component) >= sizeof made->path) {
        fb_fail_(EINVAL, "cannot follow item %s: a component is named by its path, as in /lab/robot1/mapper", item->name);
        return NULL;
    }
    made = (fb_component *)calloc(1, sizeof *made);
    if (made != NULL) {
        made->item = item;
        made->primaries = fb_new_item_(board, "primaries", FB_SIZE_MAX_, 0);
        made->table = (unsigned char *)malloc(FB_SIZE_MAX_ + (size_t)item->size);
    }
    if (made == NULL || made->primaries == NULL || made->table == NULL) {
        if (made != NULL) {
            free(made->primaries);
            free(made->table);
        }
        free(made);
        fb_fail_(ENOMEM, "cannot follow item %s: no memory", item->name);
        return NULL;
    }
    memcpy(made->path, component, strlen(component));
    pthread_mutex_lock(&board->guard);
    made->next = board->components;
    board->components = made;
    made->primaries->next = board->items;
    board->items = made->primaries;
    pthread_mutex_unlock(&board->guard);
    return made;
}

/* --- Open, find, close ----------------------------------------------------------------------------------------------------------------- */

static inline void fb_forking_(void)
{
    pthread_mutex_lock(&fb_boards_guard_);
    for (fb_board *board = fb_boards_; board != NULL; board = board->next)
        pthread_mutex_lock(&board->guard);
}

static inline void fb_fork_made_(void)
{
    for (fb_board *board = fb_boards_; board != NULL; board = board->next)
        pthread_mutex_unlock(&board->guard);
    pthread_mutex_unlock(&fb_boards_guard_);
}

/* In a child: locks belong to openings, which it shares with its parent. It closes its copies; its next put opens the board anew. */
static inline void fb_forked_(void)
{
    for (fb_board *board = fb_boards_; board != NULL; board = board->next) {
        for (fb_item *item = board->items; item != NULL; item = item->next) {
            if (item->own != NULL) {
                item->own->has_lock = false;
                item->own->remembered = FB_UNKNOWN_;
            }
            for (fb_place_ *place = item->peers; place != NULL; place = place->next)
                place->remembered = FB_UNKNOWN_;
        }
        for (fb_area_ *area = board->areas; area != NULL; area = area->next) {
            area->telling = 0; /* by threads of the parent */
            fb_shut_(area);
        }
        board->is_forked = true;
    }
    fb_fork_made_();
}

/* Free everything but what is open. */
static inline void fb_free_(fb_board *board)
{
    fb_give_up_(board);
    while (board->left != NULL) {
        fb_area_ *area = board->left;
        board->left = area->next;
        fb_unmap_(area);
    }
    while (board->given_up != NULL) {
        fb_place_ *place = board->given_up;
        board->given_up = place->older;
        free(place);
    }
    while (board->components != NULL) {
        fb_component *component = board->components;
        board->components = component->next;
        free(component->table);
        free(component);
    }
    while (board->items != NULL) {
        fb_item *item = board->items;
        board->items = item->next;
        free(item);
    }
    while (board->added != NULL) {
        fb_added_ *added = board->added;
        board->added = added->next;
        free(added);
    }
    pthread_mutex_destroy(&board->guard);
    free(board->chosen);
    free(board);
}

static inline fb_board *fb_open(const char *directory)
{
    fb_board *board = (fb_board *)calloc(1, sizeof *board);
    int failed = 0;
    if (board == NULL || (directory != NULL && (board->chosen = strdup(directory)) == NULL)) {
        free(board);
        fb_fail_(ENOMEM, "cannot open the board: no memory");
        return NULL;
    }
    pthread_mutex_init(&board->guard, NULL);
    pthread_mutex_lock(&fb_boards_guard_);
    if (!fb_is_registered_) {
        fb_is_registered_ = true;
        pthread_atfork(fb_forking_, fb_fork_made_, fb_forked_);
        fb_guard_();
    }
    failed = fb_ensure_(board);
    if (failed == 0) {
        board->next = fb_boards_;
        fb_boards_ = board;
    }
    pthread_mutex_unlock(&fb_boards_guard_);
    if (failed != 0) {
        fb_free_(board);
        errno = -failed;
        return NULL;
    }
    return board;
}

static inline fb_item *fb_find(fb_board *board, const char *name, size_t size, uint64_t digest)
{
    fb_item *item;
    int outcome;
    if (name == NULL || *name == '\0' || strlen(name) > FB_NAME_MAX_ || size > FB_SIZE_MAX_) {
        fb_fail_(EINVAL, "cannot find item %.80s: a name has 1 to %d bytes, a value up to %d", name == NULL ? "" : name, FB_NAME_MAX_, FB_SIZE_MAX_);
        return NULL;
    }
    item = fb_new_item_(board, name, size, digest);
    if (item == NULL) {
        fb_fail_(ENOMEM, "cannot find item %s: no memory", name);
        return NULL;
    }
    pthread_mutex_lock(&board->guard);
    outcome = fb_ensure_(board);
    outcome = outcome == 0 ? fb_bind_(item, NULL) : outcome;
    if (outcome == -ENOENT || outcome == -EACCES) { /* other robots may have it */
        char sentence[sizeof fb_sentence_];
        outcome = -ENOENT;
        DIR *folder = opendir(board->directory);
        memcpy(sentence, fb_sentence_, sizeof sentence);
        for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); outcome == -ENOENT && entry != NULL; entry = readdir(folder))
            if (strncmp(entry->d_name, "peer-", 5) == 0)
                outcome = fb_bind_(item, entry->d_name + 5) == 0 ? 0 : -ENOENT;
        if (folder != NULL)
            closedir(folder);
        if (outcome == -ENOENT)
            memcpy(fb_sentence_, sentence, sizeof sentence);
    }
    if (outcome == 0) {
        item->next = board->items;
        board->items = item;
    }
    pthread_mutex_unlock(&board->guard);
    if (outcome != 0) {
        free(item);
        errno = -outcome;
        return NULL;
    }
    return item;
}

static inline int fb_robot(fb_board *board, char *name, size_t size)
{
    int outcome;
    pthread_mutex_lock(&board->guard);
    outcome = fb_ensure_(board);
    if (outcome == 0)
        snprintf(name, size, "%s", board->own->robot);
    pthread_mutex_unlock(&board->guard);
    return outcome;
}

static inline void fb_close(fb_board *board)
{
    char path[PATH_MAX + 8];
    fb_board **link = &fb_boards_;
    if (board == NULL)
        return;
    pthread_mutex_lock(&fb_boards_guard_);
    while (*link != NULL && *link != board)
        link = &(*link)->next;
    if (*link == board)
        *link = board->next;
    pthread_mutex_unlock(&fb_boards_guard_);
    if (board->own != NULL && !board->is_forked && board->own->file >= 0 && fb_take_table_(board->own->file, board->directory) == 0) {
        snprintf(path, sizeof path, "%s/own", board->directory);
        fb_give_(board->own->file, FB_USER_LOCKS_ + board->user);
        if (fb_is_still_(path, board->own->file) && fb_is_abandoned_(board->own->file))
            fb_remove_(board, board->own->file);
        fb_give_(board->own->file, FB_TABLE_LOCK_);
    }
    fb_free_(board);
}

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif
