/* Memory that mmap(2) alone does not make: named by the second argument. */
#include "tracee.h"

#include <pthread.h>
#include <setjmp.h>
#include <sys/prctl.h>
#include <sys/shm.h>

#define HUGE_PAGE (2UL << 20)
#define CODES "ht gb lo lf dp sl wf dd "
#ifndef MAP_DROPPABLE
#define MAP_DROPPABLE 0x08
#endif
#define SYS_MSEAL 462

static const char *go;
static sigjmp_buf back;

static void leap(int signal_number) {
    (void)signal_number;
    siglongjmp(back, 1);
}

/* A signal handler runs with the rights that every thread begins with, and we leap out of it. */
static unsigned rights(void) {
    unsigned low = 0;
#ifdef __x86_64__
    __asm__ volatile("rdpkru" : "=a"(low) : "c"(0) : "edx");
#endif
    return low;
}

static void set_rights(unsigned low) {
#ifdef __x86_64__
    __asm__ volatile("wrpkru" : : "a"(low), "c"(0), "d"(0));
#else
    (void)low;
#endif
}

static int has_keys;

/* Whether a byte can be read, or written, just now. */
static int can_touch(volatile unsigned char *place, int write) {
    struct sigaction action = {.sa_handler = leap}, before;
    sigaction(SIGSEGV, &action, &before);
    volatile int touched = 0;
    volatile unsigned before_touch = has_keys ? rights() : 0;
    if (!sigsetjmp(back, 1)) {
        unsigned char value = *place;
        if (write) *place = value;
        touched = 1;
    }
    if (has_keys) set_rights(before_touch);
    sigaction(SIGSEGV, &before, NULL);
    return touched;
}

static int huge(int sharing) {
    unsigned char *place = mmap(NULL, 2 * HUGE_PAGE, PROT_READ | PROT_WRITE, sharing | MAP_ANONYMOUS | MAP_HUGETLB, -1, 0);
    if (place == MAP_FAILED) cannot("map huge pages");
    fill(place, HUGE_PAGE + PAGE, 3); /* the second one is nearly empty */
    mprotect(place + HUGE_PAGE, HUGE_PAGE, PROT_READ);
    char before[64], after[64];
    flags_at(place, CODES, before);
    ready();
    wait_for_go(go);
    flags_at(place, CODES, after);
    EXPECT(!strcmp(before, after), "flags are%s, were%s", after, before);
    expect_filled("huge pages", place, HUGE_PAGE + PAGE, 3);
    expect_zero("the rest", place + HUGE_PAGE + PAGE, HUGE_PAGE - PAGE);
    EXPECT(!strncmp(permissions_at(place + HUGE_PAGE), "r--", 3), "the second one is %s", permissions_at(place + HUGE_PAGE));
    return finish();
}

static int keys(void) {
    int unused = pkey_alloc(0, 0), first = pkey_alloc(0, 0), second = pkey_alloc(0, PKEY_DISABLE_WRITE);
    if (unused < 0 || first < 0 || second < 0) cannot("allocate protection keys");
    has_keys = 1;
    pkey_free(unused);
    pkey_set(unused, PKEY_DISABLE_ACCESS);
    unsigned char *place = map_pages(8, PROT_READ | PROT_WRITE, 0);
    fill(place, 8 * PAGE, 4);
    unsigned char *only_code = map_pages(1, PROT_EXEC, 0);
    if (pkey_mprotect(place, 4 * PAGE, PROT_READ | PROT_WRITE, first)) cannot("use a key");
    if (pkey_mprotect(place + 4 * PAGE, 4 * PAGE, PROT_READ | PROT_WRITE, second)) cannot("use a key");
    pkey_set(first, PKEY_DISABLE_ACCESS);
    EXPECT(!can_touch(place, 0), "the first key guards nothing");
    ready();
    wait_for_go(go);
    EXPECT(!can_touch(place, 0), "the first key guards nothing any more");
    EXPECT(can_touch(place + 4 * PAGE, 0), "the second key forbids reading");
    EXPECT(!can_touch(place + 4 * PAGE, 1), "the second key lets us write");
    EXPECT_EQUAL("rights of the first key", pkey_get(first), PKEY_DISABLE_ACCESS);
    EXPECT_EQUAL("rights of the second key", pkey_get(second), PKEY_DISABLE_WRITE);
    EXPECT(!can_touch(only_code, 0), "memory to execute only can be read");
    EXPECT_EQUAL("the next key, for the kernel took the unused one for what may only be executed", pkey_alloc(0, 0), second + 1);
    EXPECT(pkey_free(first) == 0 && pkey_free(second) == 0, "the keys were not ours");
    pkey_set(first, 0);
    pkey_set(second, 0);
    expect_filled("guarded memory", place, 8 * PAGE, 4);
    return finish();
}

static int locked_for_ever(int flags) {
    if (mlockall(flags)) cannot("lock everything");
    ready();
    wait_for_go(go);
    char found[64];
    unsigned char *place = map_pages(4, PROT_READ | PROT_WRITE, 0);
    flags_at(place, "lo lf ", found);
    const char *wanted = flags & MCL_ONFAULT ? " lo lf" : " lo";
    EXPECT(!strcmp(found, wanted), "new memory is locked as%s, not as%s", found, wanted);
    return finish();
}

static int locked_late(void) {
    unsigned char *place = map_pages(4, PROT_READ | PROT_WRITE, 0), *other = map_pages(4, PROT_READ, 0);
    ready();
    while (!is_told("second")) usleep(1000); /* it is captured once before */
    if (mlock(place, 4 * PAGE) || madvise(other, 4 * PAGE, MADV_DONTFORK)) cannot("lock or advise");
    puts("advised");
    fflush(stdout);
    wait_for_go(go);
    char found[64];
    flags_at(place, "lo ", found);
    EXPECT(!strcmp(found, " lo"), "the lock that came late is lost");
    flags_at(other, "dc ", found);
    EXPECT(!strcmp(found, " dc"), "the advice that came late is lost");
    return finish();
}

static int droppable(void) {
    unsigned char *place = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_ANONYMOUS | MAP_DROPPABLE, -1, 0);
    if (place == MAP_FAILED) cannot("map droppable memory");
    fill(place, 4 * PAGE, 6);
    char before[64], after[64];
    flags_at(place, CODES, before);
    ready();
    wait_for_go(go);
    flags_at(place, CODES, after);
    EXPECT(!strcmp(before, after), "flags are%s, were%s", after, before);
    expect_zero("droppable memory in its next life", place, 4 * PAGE);
    return finish();
}

static int sealed(void) {
    unsigned char *place = map_pages(4, PROT_READ | PROT_WRITE, 0);
    fill(place, 4 * PAGE, 7);
    mprotect(place + 2 * PAGE, 2 * PAGE, PROT_READ);
    if (syscall(SYS_MSEAL, place, 4 * PAGE, 0)) cannot("seal memory");
    ready();
    wait_for_go(go);
    EXPECT(munmap(place, PAGE) == -1 && errno == EPERM, "sealed memory can be unmapped");
    EXPECT(mprotect(place + 3 * PAGE, PAGE, PROT_READ | PROT_WRITE) == -1, "sealed memory can be opened");
    expect_filled("sealed memory", place, 4 * PAGE, 7);
    place[0]++;
    return finish();
}

/* A mapping that grows downwards, besides the stack. */
static int grows_down(void) {
    unsigned char *room = map_pages(64, PROT_NONE, 0);
    munmap(room, 64 * PAGE);
    unsigned char *top = room + 63 * PAGE;
    if (mmap(top, PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_GROWSDOWN | MAP_FIXED, -1, 0) != top)
        cannot("map what grows down");
    fill(top, PAGE, 8);
    ready();
    wait_for_go(go);
    expect_filled("what grows down", top, PAGE, 8);
    for (unsigned char *place = top - PAGE; place >= top - 5 * PAGE; place -= PAGE)
        EXPECT(can_touch(place, 1), "it does not grow to %p", place);
    return finish();
}

static int paged_out(void) {
    unsigned char *place = map_pages(512, PROT_READ | PROT_WRITE, 0);
    fill(place, 512 * PAGE, 9);
    if (madvise(place, 512 * PAGE, MADV_PAGEOUT)) cannot("page memory out");
    ready();
    wait_for_go(go);
    expect_filled("memory that was paged out", place, 512 * PAGE, 9);
    return finish();
}

/* Two segments: one that others could find by its key, attached twice, and one that goes with the program. */
static int segments(void) {
    key_t key = 0x5e000000 + (getpid() & 0xffffff);
    int named = shmget(key, 4 * PAGE, IPC_CREAT | IPC_EXCL | 0640), passing = shmget(IPC_PRIVATE, 3 * PAGE - 5, 0600);
    unsigned char *place = shmat(named, NULL, 0), *again = shmat(named, NULL, 0), *other = shmat(passing, NULL, 0);
    if (place == (void *)-1 || again == (void *)-1 || other == (void *)-1) cannot("attach shared memory");
    shmctl(passing, IPC_RMID, NULL);
    fill(place, 4 * PAGE, 10);
    fill(other, 3 * PAGE, 11);
    munmap(again, PAGE); /* the other attachment has the whole */
    mprotect(place + 2 * PAGE, PAGE, PROT_READ);
    printf("%d\n", named);
    ready();
    wait_for_go(go);
    expect_filled("the segment", place, 4 * PAGE, 10);
    expect_filled("the segment that goes with us", other, 3 * PAGE, 11);
    EXPECT(!strncmp(permissions_at(place + 2 * PAGE), "r--s", 4), "a page is %s", permissions_at(place + 2 * PAGE));
    EXPECT(!*permissions_at(again), "what was unmapped is there again");
    place[0] ^= 1;
    place[3 * PAGE] ^= 1;
    EXPECT(again[3 * PAGE] == place[3 * PAGE], "the two attachments are not of one segment");
    struct shmid_ds about;
    EXPECT_EQUAL("the id by its key", shmget(key, 0, 0), named);
    EXPECT(shmctl(named, IPC_STAT, &about) == 0, "the segment is not known by its id");
    EXPECT_EQUAL("size", about.shm_segsz, 4 * PAGE);
    EXPECT_EQUAL("permissions", about.shm_perm.mode, 0640);
    EXPECT(shmctl(passing, IPC_STAT, &about) == 0, "the passing segment is not known by its id");
    EXPECT_EQUAL("the passing one's size", about.shm_segsz, 3 * PAGE - 5);
    EXPECT(about.shm_perm.mode & SHM_DEST, "it does not go with us any more");
    unsigned char *anew = shmat(named, NULL, 0);
    EXPECT(anew != (void *)-1 && anew[0] == place[0], "attached anew it is another one");
    shmctl(named, IPC_RMID, NULL);
    return finish();
}

/* Written and paged out before one snapshot, and in part once more before the next. */
static int paged_out_again(void) {
    unsigned char *place = map_pages(512, PROT_READ | PROT_WRITE, 0);
    fill(place, 512 * PAGE, 12);
    if (madvise(place, 512 * PAGE, MADV_PAGEOUT)) cannot("page memory out");
    ready();
    while (!is_told("second")) usleep(1000);
    fill(place, 100 * PAGE, 13);
    madvise(place, 512 * PAGE, MADV_PAGEOUT);
    puts("again");
    fflush(stdout);
    wait_for_go(go);
    expect_filled("what was written again", place, 100 * PAGE, 13);
    fill(place, 100 * PAGE, 12);
    expect_filled("memory that was paged out twice", place, 512 * PAGE, 12);
    return finish();
}

int main(int count, char **arguments) {
    if (count < 3) return 2;
    go = arguments[1];
    const char *kind = arguments[2];
    if (!strcmp(kind, "huge")) return huge(MAP_PRIVATE);
    if (!strcmp(kind, "huge_shared")) return huge(MAP_SHARED);
    if (!strcmp(kind, "segments")) return segments();
    if (!strcmp(kind, "keys")) return keys();
    if (!strcmp(kind, "locked")) return locked_for_ever(MCL_CURRENT | MCL_FUTURE);
    if (!strcmp(kind, "locked_on_fault")) return locked_for_ever(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT);
    if (!strcmp(kind, "locked_late")) return locked_late();
    if (!strcmp(kind, "droppable")) return droppable();
    if (!strcmp(kind, "sealed")) return sealed();
    if (!strcmp(kind, "grows_down")) return grows_down();
    if (!strcmp(kind, "paged_out_again")) return paged_out_again();
    if (!strcmp(kind, "paged_out")) return paged_out();
    return 2;
}
