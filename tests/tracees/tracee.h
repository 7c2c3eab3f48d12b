/* What every tracee shares: say ready, wait for go, compare, say ok.
 *
 * A tracee prints "ready", waits until the file named by its first argument exists (or SIGUSR1 came, for those that
 * must not make system calls), compares what it has with what it had, prints each difference on a line of its own,
 * and ends with "ok" and status 0, or "differs" and status 1. It never needs anything outside its working directory.
 */
#ifndef TRACEE_H
#define TRACEE_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#ifndef PAGE /* the compiler is told this machine's: arrays have their sizes by it */
#define PAGE 4096UL
#endif
#define SECOND 1000000000LL

static int differences;
static volatile sig_atomic_t told;

/* One thing is not as it was; says it and goes on. */
__attribute__((format(printf, 1, 2), unused)) static void differs(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vprintf(format, arguments);
    va_end(arguments);
    putchar('\n');
    differences++;
}

/* The program itself could not set the stage: status 77 lets the test skip with this sentence. */
__attribute__((format(printf, 1, 2), unused, noreturn)) static void cannot(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    printf("cannot: ");
    vprintf(format, arguments);
    va_end(arguments);
    printf(" (%s)\n", strerror(errno));
    fflush(stdout);
    _exit(77);
}

#define EXPECT(condition, ...) \
    do { \
        if (!(condition)) differs(__VA_ARGS__); \
    } while (0)

#define EXPECT_EQUAL(what, got, wanted) \
    do { \
        long long got_ = (long long)(got), wanted_ = (long long)(wanted); \
        if (got_ != wanted_) differs("%s: %lld (0x%llx), was %lld (0x%llx)", what, got_, got_, wanted_, wanted_); \
    } while (0)

__attribute__((unused)) static int64_t now_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * SECOND + now.tv_nsec;
}

__attribute__((unused)) static void ready(void) {
    puts("ready");
    fflush(stdout);
}

__attribute__((unused)) static int is_told(const char *go) { return access(go, F_OK) == 0; }

/* Nap until the go file exists; a nap that ends with EINTR is a difference: nobody sent us a signal. */
__attribute__((unused)) static void wait_for_go(const char *go) {
    while (!is_told(go)) {
        struct timespec nap = {0, 2000000};
        if (nanosleep(&nap, NULL) != 0) differs("nanosleep ended early: %s", strerror(errno));
    }
}

__attribute__((unused)) static void hear(int signal_number) {
    (void)signal_number;
    told = 1;
}

/* For tracees that wait without system calls: SIGUSR1 is the go. */
__attribute__((unused)) static void listen_for_signal(void) {
    struct sigaction action = {.sa_handler = hear};
    sigaction(SIGUSR1, &action, NULL);
}

__attribute__((unused)) static int finish(void) {
    puts(differences ? "differs" : "ok");
    fflush(stdout);
    return differences ? 1 : 0;
}

/* splitmix64: the same numbers from the same seed, everywhere. */
__attribute__((unused)) static uint64_t mix(uint64_t seed) {
    seed += 0x9e3779b97f4a7c15ULL;
    seed = (seed ^ (seed >> 30)) * 0xbf58476d1ce4e5b9ULL;
    seed = (seed ^ (seed >> 27)) * 0x94d049bb133111ebULL;
    return seed ^ (seed >> 31);
}

__attribute__((unused)) static void fill(void *start, size_t size, uint64_t seed) {
    uint64_t *words = start;
    for (size_t index = 0; index < size / 8; index++) words[index] = mix(seed + index);
}

/* Whether the bytes are what fill() wrote; says the first offset that is not. */
__attribute__((unused)) static void expect_filled(const char *what, const void *start, size_t size, uint64_t seed) {
    const uint64_t *words = start;
    for (size_t index = 0; index < size / 8; index++)
        if (words[index] != mix(seed + index)) {
            differs("%s: wrong from offset %zu: %016llx", what, index * 8, (unsigned long long)words[index]);
            return;
        }
}

__attribute__((unused)) static void expect_zero(const char *what, const void *start, size_t size) {
    const unsigned char *bytes = start;
    for (size_t index = 0; index < size; index++)
        if (bytes[index]) {
            differs("%s: not zero at offset %zu", what, index);
            return;
        }
}

/* Anonymous private memory, or the end. */
__attribute__((unused)) static unsigned char *map_pages(size_t count, int protection, int more_flags) {
    void *start = mmap(NULL, count * PAGE, protection, MAP_PRIVATE | MAP_ANONYMOUS | more_flags, -1, 0);
    if (start == MAP_FAILED) cannot("map %zu pages", count);
    return start;
}

/* The "perms" column of /proc/self/maps for one address, "" where nothing is mapped. */
__attribute__((unused)) static const char *permissions_at(const void *address) {
    static char permissions[8];
    char line[600];
    FILE *maps = fopen("/proc/self/maps", "r");
    permissions[0] = 0;
    while (maps && fgets(line, sizeof line, maps)) {
        unsigned long start, end;
        char found[8];
        if (sscanf(line, "%lx-%lx %7s", &start, &end, found) == 3 && start <= (unsigned long)address &&
            (unsigned long)address < end)
            strcpy(permissions, found);
    }
    if (maps) fclose(maps);
    return permissions;
}

/* The VmFlags of the mapping at an address, with the named codes only, in the order asked for. */
__attribute__((unused)) static void flags_at(const void *address, const char *codes, char *found) {
    char line[600];
    int inside = 0;
    FILE *smaps = fopen("/proc/self/smaps", "r");
    found[0] = 0;
    while (smaps && fgets(line, sizeof line, smaps)) {
        unsigned long start, end;
        if (sscanf(line, "%lx-%lx %*s", &start, &end) == 2 && strchr(line, '-') < strchr(line, ' '))
            inside = start <= (unsigned long)address && (unsigned long)address < end;
        if (!inside || strncmp(line, "VmFlags:", 8)) continue;
        for (const char *code = codes; *code; code += 3) {
            char wanted[4] = {' ', code[0], code[1], 0};
            if (strstr(line, wanted)) strcat(found, wanted);
        }
    }
    if (smaps) fclose(smaps);
}

#endif
