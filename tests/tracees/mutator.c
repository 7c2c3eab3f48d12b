/* Changes its memory in every way that can hide a write from a tracker, and knows what it must find there.
 *
 * Usage: mutator GO OPERATIONS SEED ROUNDS NAP_US. Each letter of OPERATIONS is one way (see the table below). After
 * every round each page is compared with the sum that was noted when it was last changed, and one line with the sum of
 * everything is printed, so the transcript of two runs with the same seed is the same, line for line. It ends after
 * ROUNDS rounds, or with the round in which GO appears.
 */
#include "tracee.h"

#define COUNT 384           /* pages of the arena */
#define BREAK_COUNT 64      /* pages of heap, at most */
#define HUGE_COUNT 1024     /* two huge pages */
#define GUARD_COUNT 256     /* pages of which some are guards (MADV_GUARD_INSTALL, Linux 6.13) */
#define OPERATIONS_A_ROUND 12

#ifndef MADV_GUARD_INSTALL
#define MADV_GUARD_INSTALL 102
#define MADV_GUARD_REMOVE 103
#endif

static unsigned char *arena, *elsewhere, *broken, *shared, *large, *mapped, *guarded;
static uint64_t expected[COUNT], expected_shared[16], expected_large[HUGE_COUNT], expected_break[BREAK_COUNT],
    expected_mapped[16], expected_guarded[GUARD_COUNT];
static char is_guard[GUARD_COUNT];
static char last[COUNT];
static int break_count, scratch;
static uint64_t state;

static uint64_t dice(uint64_t sides) {
    state = mix(state);
    return state % sides;
}

static uint64_t sum_of(const unsigned char *page) {
    const uint64_t *words = (const uint64_t *)page;
    uint64_t sum = 0;
    for (size_t index = 0; index < PAGE / 8; index++) sum = (sum ^ words[index]) * 0x100000001b3ULL + (sum >> 29);
    return sum;
}

static void note(int first, int count, char operation) {
    for (int index = first; index < first + count; index++) {
        expected[index] = sum_of(arena + index * PAGE);
        last[index] = operation;
    }
}

static void must(int condition, const char *what) {
    if (!condition) {
        differs("%s failed: %s", what, strerror(errno));
        finish();
        _exit(1);
    }
}

static void map_at(unsigned char *place, size_t count) {
    must(mmap(place, count * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED, -1, 0) == place,
         "mmap at the same address");
}

static void write_pages(unsigned char *place, int count) { fill(place, count * PAGE, dice(1 << 30)); }
static void patch_word(unsigned char *place, int count) { ((uint64_t *)place)[dice(count * PAGE / 8)] = dice(~0ULL); }
static void zero_pages(unsigned char *place, int count) { memset(place, 0, count * PAGE); }

static void forget(unsigned char *place, int count) {
    must(madvise(place, count * PAGE, MADV_DONTNEED) == 0, "MADV_DONTNEED");
}

static void forget_and_write(unsigned char *place, int count) {
    forget(place, count);
    patch_word(place, count);
}

static void remap_empty(unsigned char *place, int count) {
    must(munmap(place, count * PAGE) == 0, "munmap");
    map_at(place, count);
}

static void remap_and_write(unsigned char *place, int count) {
    remap_empty(place, count);
    fill(place, PAGE, dice(1 << 30));
}

static void map_over(unsigned char *place, int count) {
    map_at(place, count);
    patch_word(place, count);
}

/* One page: across the edge of what is write-protected mremap fails, a known exception (README). */
static void move_and_back(unsigned char *place, int count) {
    (void)count;
    must(mremap(place, PAGE, PAGE, MREMAP_MAYMOVE | MREMAP_FIXED, elsewhere) == elsewhere, "mremap away");
    patch_word(elsewhere, 1);
    must(mremap(elsewhere, PAGE, PAGE, MREMAP_MAYMOVE | MREMAP_FIXED, place) == place, "mremap back");
}

static void swap_pages(unsigned char *place, int count) {
    unsigned char *other = arena + dice(COUNT - count) * PAGE; /* two pages change places without a store */
    size_t size = PAGE;
    if (other >= place && other < place + count * PAGE) return;
    must(mremap(place, size, size, MREMAP_MAYMOVE | MREMAP_FIXED, elsewhere) == elsewhere, "mremap the first");
    must(mremap(other, size, size, MREMAP_MAYMOVE | MREMAP_FIXED, place) == place, "mremap the second");
    must(mremap(elsewhere, size, size, MREMAP_MAYMOVE | MREMAP_FIXED, other) == other, "mremap the first again");
    note((other - arena) / PAGE, 1, 'S');
}

static void write_sealed(unsigned char *place, int count) {
    must(mprotect(place, count * PAGE, PROT_READ | PROT_WRITE) == 0, "unseal");
    patch_word(place, count);
    must(mprotect(place, count * PAGE, PROT_READ) == 0, "seal");
    if (dice(2)) must(mprotect(place, count * PAGE, PROT_READ | PROT_WRITE) == 0, "unseal again");
}

static void write_by_kernel(unsigned char *place, int count) {
    off_t offset = dice(60) * 512;
    must(mprotect(place, count * PAGE, PROT_READ | PROT_WRITE) == 0, "unseal");
    must(pread(scratch, place, PAGE, offset) == (ssize_t)PAGE, "pread into a page");
}

static void write_through_proc(unsigned char *place, int count) {
    uint64_t value = dice(~0ULL); /* also reaches pages that are read-only at the moment */
    int memory = open("/proc/self/mem", O_RDWR);
    (void)count;
    must(pwrite(memory, &value, 8, (off_t)(uintptr_t)place + 64) == 8, "write through /proc/self/mem");
    close(memory);
}

static void churn(unsigned char *place, int count) {
    unsigned char *fresh = map_pages(3, PROT_READ | PROT_WRITE, 0);
    (void)count;
    fill(fresh, 3 * PAGE, dice(1 << 30));
    memcpy(place, fresh + PAGE, PAGE);
    munmap(fresh, 3 * PAGE);
}

static const struct way {
    char letter;
    int keeps_protection;
    void (*act)(unsigned char *place, int count);
} ways[] = {{'w', 0, write_pages},   {'p', 0, patch_word},      {'z', 0, zero_pages},     {'d', 0, forget},
            {'D', 0, forget_and_write}, {'m', 0, remap_empty},  {'M', 0, remap_and_write}, {'o', 0, map_over},
            {'r', 0, move_and_back}, {'S', 0, swap_pages},      {'j', 1, write_sealed},   {'x', 1, write_by_kernel},
            {'v', 1, write_through_proc}, {'c', 0, churn}};

static void change_break(void) {
    int wanted = dice(BREAK_COUNT);
    must(brk(broken + wanted * PAGE) == 0, "brk");
    for (int index = break_count; index < wanted; index++) {
        if (index % 3) fill(broken + index * PAGE, PAGE, dice(1 << 30));
        expected_break[index] = sum_of(broken + index * PAGE);
    }
    break_count = wanted;
}

static void guard_or_write(void) {
    int first = dice(GUARD_COUNT), size = 1 + dice(dice(4) ? 4 : 100), way = dice(3);
    unsigned char *place = guarded + first * PAGE;
    if (size > GUARD_COUNT - first) size = GUARD_COUNT - first;
    if (way < 2) must(madvise(place, size * PAGE, way ? MADV_GUARD_INSTALL : MADV_GUARD_REMOVE) == 0, "madvise of guards");
    for (int index = first; index < first + size; index++) {
        if (way < 2) is_guard[index] = way;
        if (is_guard[index]) continue;
        if (way == 2) patch_word(guarded + index * PAGE, 1);
        expected_guarded[index] = sum_of(guarded + index * PAGE);
    }
}

/* The kernel reads the page for us, as the name of a file, and says EFAULT instead of sending SIGSEGV. */
static int bites(int index) { return access((char *)guarded + index * PAGE, F_OK) != 0 && errno == EFAULT; }

static void change_others(char letter) {
    if (letter == 'b') change_break();
    if (letter == 'g') guard_or_write();
    if (letter == 's') {
        int index = dice(16);
        patch_word(shared + index * PAGE, 1);
        expected_shared[index] = sum_of(shared + index * PAGE);
    }
    if (letter == 'h') {
        int index = dice(HUGE_COUNT);
        patch_word(large + index * PAGE, 1);
        expected_large[index] = sum_of(large + index * PAGE);
    }
    if (letter == 'H') {
        int index = dice(HUGE_COUNT / 2) + HUGE_COUNT / 4;
        must(madvise(large + index * PAGE, PAGE, MADV_DONTNEED) == 0, "MADV_DONTNEED in a huge page");
        expected_large[index] = sum_of(large + index * PAGE);
    }
    if (letter == 'K') { /* the mapping's file loses its name, as when a package is upgraded */
        int index = dice(16);
        if (!dice(8)) unlink("mutator.bin");
        patch_word(mapped + index * PAGE, 1);
        expected_mapped[index] = sum_of(mapped + index * PAGE);
    }
    if (letter == 'k') {
        int index = dice(16);
        if (dice(3))
            patch_word(mapped + index * PAGE, 1);
        else
            must(madvise(mapped + index * PAGE, PAGE, MADV_DONTNEED) == 0, "MADV_DONTNEED on a file");
        expected_mapped[index] = sum_of(mapped + index * PAGE);
    }
}

static void operate(const char *letters) {
    char letter = letters[dice(strlen(letters))];
    int first = dice(COUNT - 8), count = 1 + dice(6);
    unsigned char *place = arena + first * PAGE;
    for (size_t index = 0; index < sizeof ways / sizeof *ways; index++)
        if (ways[index].letter == letter) {
            if (!ways[index].keeps_protection) mprotect(place, count * PAGE, PROT_READ | PROT_WRITE);
            if (letter == 'S') mprotect(arena, COUNT * PAGE, PROT_READ | PROT_WRITE);
            ways[index].act(place, count);
            note(first, count, letter);
            return;
        }
    change_others(letter);
}

static uint64_t compare(const char *what, const unsigned char *place, const uint64_t *wanted, int count) {
    uint64_t total = 0;
    for (int index = 0; index < count; index++) {
        uint64_t sum = sum_of(place + index * PAGE);
        total = mix(total ^ sum);
        if (sum != wanted[index] && differences < 20)
            differs("%s page %d is not what was last written there (by %c)", what, index,
                    wanted == expected ? last[index] : '-');
    }
    return total;
}

static uint64_t compare_guarded(void) {
    uint64_t total = 0;
    for (int index = 0; index < GUARD_COUNT; index++) {
        total = mix(total ^ is_guard[index]);
        if (bites(index) != is_guard[index])
            differs("page %d is %s guard", index, is_guard[index] ? "no longer a" : "now a");
        else if (!is_guard[index])
            total ^= compare("guarded", guarded + index * PAGE, expected_guarded + index, 1);
    }
    return total;
}

static uint64_t compare_all(void) {
    uint64_t total = compare("arena", arena, expected, COUNT);
    if (guarded) total = mix(total ^ compare_guarded());
    total = mix(total ^ compare("shared", shared, expected_shared, 16));
    total = mix(total ^ compare("huge", large, expected_large, HUGE_COUNT));
    total = mix(total ^ compare("file", mapped, expected_mapped, 16));
    return mix(total ^ compare("heap", broken, expected_break, break_count));
}

static void set_stage(const char *letters) {
    arena = map_pages(COUNT + 2, PROT_READ | PROT_WRITE, 0) + PAGE;
    elsewhere = map_pages(16, PROT_NONE, 0);
    large = map_pages(2 * HUGE_COUNT, PROT_READ | PROT_WRITE, 0);
    large = (unsigned char *)(((uintptr_t)large + HUGE_COUNT * PAGE / 2) & ~(HUGE_COUNT * PAGE / 2 - 1));
    madvise(large, HUGE_COUNT * PAGE, MADV_HUGEPAGE);
    shared = mmap(NULL, 16 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    broken = (unsigned char *)(((uintptr_t)sbrk(0) + 2 * PAGE) & ~(PAGE - 1));
    brk(broken);
    scratch = open("mutator.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    for (int index = 0; index < 16; index++) {
        fill(large, PAGE, 500 + index);
        must(write(scratch, large, PAGE) == (ssize_t)PAGE, "write the file");
    }
    mapped = mmap(NULL, 16 * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE, scratch, 0);
    for (int index = 0; index < COUNT; index++) fill(arena + index * PAGE, PAGE * (index % 4 != 0), index);
    note(0, COUNT, 'i');
    if (strchr(letters, 'g')) {
        guarded = map_pages(GUARD_COUNT, PROT_READ | PROT_WRITE, 0);
        if (madvise(guarded, PAGE, MADV_GUARD_INSTALL) || madvise(guarded, PAGE, MADV_GUARD_REMOVE))
            cannot("install guards by madvise");
        for (int index = 0; index < GUARD_COUNT; index++) expected_guarded[index] = sum_of(guarded + index * PAGE);
    }
    for (int index = 0; index < 16; index++) expected_shared[index] = sum_of(shared + index * PAGE);
    for (int index = 0; index < 16; index++) expected_mapped[index] = sum_of(mapped + index * PAGE);
    for (int index = 0; index < HUGE_COUNT; index++) expected_large[index] = sum_of(large + index * PAGE);
}

int main(int count, char **arguments) {
    if (count < 6) cannot("run without GO OPERATIONS SEED ROUNDS NAP_US");
    const char *letters = arguments[2];
    long rounds = atol(arguments[4]), nap_us = atol(arguments[5]);
    struct timespec nap = {0, nap_us * 1000};
    state = strtoull(arguments[3], NULL, 0);
    static char buffer[4096]; /* the heap belongs to the experiment */
    setvbuf(stdout, buffer, _IOFBF, sizeof buffer);
    set_stage(letters);
    ready();
    for (long round = 0; round < rounds && !is_told(arguments[1]); round++) {
        for (int step = 0; step < OPERATIONS_A_ROUND; step++) operate(letters);
        printf("%ld %016llx\n", round, (unsigned long long)compare_all());
        fflush(stdout);
        if (differences) break;
        if (nap_us) nanosleep(&nap, NULL);
    }
    return finish();
}
