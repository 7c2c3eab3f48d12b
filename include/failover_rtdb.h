/* failover_rtdb.h: CAMBADA's real-time database (RTDB) over the team's board: its five functions, by the numbers of its configuration.
 *
 * A program that was written against DB_init, DB_free, DB_put, DB_get and Whoami compiles with this header in place of rtdb_api.h. An item's
 * number is its place in the configuration, an agent's number its place among the AGENTS; SELF is the agent where the program runs. What is
 * different: ages come from a clock that no one can set, value and age are of one put, and an item has one writer. docs/c.md has a table.
 *
 * Calls may come from several threads. SPDX-License-Identifier: MIT */

#ifndef FAILOVER_RTDB_H
#define FAILOVER_RTDB_H

#include "failover_board.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifndef SELF
#define SELF 3333 /* as an agent's number: the one where the program runs */
#endif

/* Open this robot's board: 0, or -1 (fb_error() says why). A second call does nothing. */
static inline int DB_init(void);

/* Be no user of it any more. */
static inline void DB_free(void);

/* Put an item of this robot: 0 or -1. */
static inline int DB_put(int id, const void *value);

/* Read an agent's item: its age in ms, at least; or -1. */
static inline int DB_get(int from_agent, int id, void *value);

/* The number of the agent where the program runs, or -1. */
static inline int Whoami(void);

/* --- Inside --------------------------------------------------------------------------------------------------------------------------- */

enum { FB_DB_AGENTS_ = 256, FB_DB_IDS_ = 64 * 1024 + FB_ITEMS_MAX_ };

/* One in a program, however many of its files include this one. */
typedef struct fb_db_ {
    pthread_mutex_t guard;
    fb_board *board;
    fb_item *items[FB_DB_IDS_];         /* atomic */
    char *robots[FB_DB_AGENTS_];        /* atomic: names by rank */
} fb_db_;

__attribute__((weak)) fb_db_ fb_the_db_ = {PTHREAD_MUTEX_INITIALIZER, NULL, {NULL}, {NULL}};

static inline int DB_init(void)
{
    fb_db_ *db = &fb_the_db_;
    int outcome;
    pthread_mutex_lock(&db->guard);
    db->board = db->board == NULL ? fb_open(NULL) : db->board;
    outcome = db->board == NULL ? -1 : 0;
    pthread_mutex_unlock(&db->guard);
    return outcome;
}

static inline void DB_free(void)
{
    fb_db_ *db = &fb_the_db_;
    pthread_mutex_lock(&db->guard);
    fb_close(db->board);
    db->board = NULL;
    memset(db->items, 0, sizeof db->items);
    for (int agent = 0; agent < FB_DB_AGENTS_; agent++) {
        free(db->robots[agent]);
        db->robots[agent] = NULL;
    }
    pthread_mutex_unlock(&db->guard);
}

/* Look for an item's name and size: among this robot's files, then among all others'. 0 or -errno; all guards are held. */
static inline int fb_db_look_(fb_board *board, int id, char *name, size_t *size)
{
    DIR *folder = opendir(board->directory);
    fb_area_ *found = NULL;
    fb_record_ record;
    int index;
    for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); entry != NULL; entry = readdir(folder))
        if (strncmp(entry->d_name, "peer-", 5) == 0)
            fb_peer_(board, entry->d_name + 5);
    if (folder != NULL)
        closedir(folder);
    fb_forget_gone_(board);
    index = fb_search_own_(board, NULL, (uint32_t)id, &record, &found);
    for (fb_area_ *area = board->areas; index < 0 && area != NULL; area = area->next) {
        index = area->is_peer && strcmp(area->name, "agent") != 0 ? fb_search_(area, NULL, (uint32_t)id, &record) : -ENOENT;
        found = area;
    }
    if (index >= 0) {
        const uint32_t length = found->map[record.name] | (uint32_t)found->map[record.name + 1] << 8;
        memset(name, 0, FB_NAME_MAX_ + 1);
        memcpy(name, found->map + record.name + 2, length < FB_NAME_MAX_ ? length : (uint32_t)FB_NAME_MAX_);
        *size = record.size;
    }
    return index >= 0 ? 0 : fb_fail_(ENOENT, "the board %.300s has no item of number %d", board->directory, id);
}

static inline fb_item *fb_db_item_(int id)
{
    fb_db_ *db = &fb_the_db_;
    char name[FB_NAME_MAX_ + 1];
    size_t size = 0;
    fb_item *item;
    int outcome;
    if (id < 0 || id >= FB_DB_IDS_ || db->board == NULL) {
        fb_fail_(EINVAL, db->board == NULL ? "no board is open: call DB_init() first" : "there is no item of number %d", id);
        return NULL;
    }
    item = __atomic_load_n(&db->items[id], __ATOMIC_ACQUIRE);
    if (item != NULL)
        return item;
    pthread_mutex_lock(&db->guard);
    pthread_mutex_lock(&db->board->guard);
    outcome = fb_ensure_(db->board);
    outcome = outcome == 0 ? fb_db_look_(db->board, id, name, &size) : outcome;
    pthread_mutex_unlock(&db->board->guard);
    item = db->items[id];
    if (outcome == 0 && item == NULL)
        item = fb_find(db->board, name, size, 0);
    __atomic_store_n(&db->items[id], item, __ATOMIC_RELEASE);
    pthread_mutex_unlock(&db->guard);
    return item;
}

/* The name of an agent; NULL where the board knows none of that number. The robot of a number may be another one after a takeover, but then
 * a name still says which robot's items are meant; so it is kept. */
static inline const char *fb_db_robot_(int agent)
{
    fb_db_ *db = &fb_the_db_;
    const char *name;
    if (agent < 0 || agent >= FB_DB_AGENTS_) {
        fb_fail_(EINVAL, "there is no agent of number %d", agent);
        return NULL;
    }
    name = __atomic_load_n(&db->robots[agent], __ATOMIC_ACQUIRE);
    if (name != NULL)
        return name;
    pthread_mutex_lock(&db->guard);
    pthread_mutex_lock(&db->board->guard);
    if (fb_ensure_(db->board) == 0) {
        DIR *folder = opendir(db->board->directory);
        for (struct dirent *entry = folder == NULL ? NULL : readdir(folder); entry != NULL; entry = readdir(folder))
            if (strncmp(entry->d_name, "peer-", 5) == 0)
                fb_peer_(db->board, entry->d_name + 5);
        if (folder != NULL)
            closedir(folder);
        for (fb_area_ *area = db->board->areas; area != NULL && db->robots[agent] == NULL; area = area->next)
            if (area->rank == (uint32_t)agent && (area->is_peer || area == db->board->own))
                __atomic_store_n(&db->robots[agent], strdup(area->robot), __ATOMIC_RELEASE);
    }
    name = db->robots[agent];
    if (name == NULL)
        fb_fail_(ENOENT, "the board %.300s has no agent of number %d", db->board->directory, agent);
    pthread_mutex_unlock(&db->board->guard);
    pthread_mutex_unlock(&db->guard);
    return name;
}

static inline int DB_put(int id, const void *value)
{
    fb_item *item = fb_db_item_(id);
    return item == NULL || fb_put(item, value) != 0 ? -1 : 0;
}

static inline int DB_get(int from_agent, int id, void *value)
{
    fb_item *item = fb_db_item_(id);
    const char *robot = item == NULL || from_agent == SELF ? FB_OWN : fb_db_robot_(from_agent);
    int64_t age = item == NULL || (robot == NULL && from_agent != SELF) ? -1 : fb_get(item, robot, value, NULL);
    return age < 0 ? -1 : age / 1000000 > INT_MAX ? INT_MAX : (int)(age / 1000000);
}

static inline int Whoami(void)
{
    fb_db_ *db = &fb_the_db_;
    int rank = -1;
    if (db->board == NULL) {
        fb_fail_(EINVAL, "no board is open: call DB_init() first");
        return -1;
    }
    pthread_mutex_lock(&db->board->guard);
    if (fb_ensure_(db->board) == 0)
        rank = (int)db->board->own->rank;
    pthread_mutex_unlock(&db->board->guard);
    return rank;
}

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif
