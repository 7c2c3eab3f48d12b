/* Looks the vdso's functions up by the auxiliary vector, late, as a run-time of its own does, and calls them: same as the kernel.
 *
 * It asks the C library for no time: that has addresses of the image that it was born with, which a test replaces. */
#include "tracee.h"

#include <elf.h>
#include <sys/auxv.h>

static void *function(const char *name) {
    const char *image = (const char *)getauxval(AT_SYSINFO_EHDR);
    const Elf64_Ehdr *header = (const Elf64_Ehdr *)image;
    const Elf64_Phdr *segment = (const Elf64_Phdr *)(image + header->e_phoff);
    const Elf64_Dyn *dynamic = NULL;
    for (int index = 0; index < header->e_phnum; index++)
        if (segment[index].p_type == PT_DYNAMIC) dynamic = (const Elf64_Dyn *)(image + segment[index].p_vaddr);
    const Elf64_Sym *symbol = NULL, *end;
    const char *names = NULL;
    for (; dynamic && dynamic->d_tag != DT_NULL; dynamic++) {
        if (dynamic->d_tag == DT_SYMTAB) symbol = (const Elf64_Sym *)(image + dynamic->d_un.d_ptr);
        if (dynamic->d_tag == DT_STRTAB) names = image + dynamic->d_un.d_ptr;
    }
    for (end = (const Elf64_Sym *)names; symbol && symbol < end; symbol++)
        if (symbol->st_shndx && !strcmp(names + symbol->st_name, name)) return (void *)(image + symbol->st_value);
    return NULL;
}

#ifdef __aarch64__
#define CALLED "__kernel_"
#define HAS_TIME 0
#else
#define CALLED "__vdso_"
#define HAS_TIME 1
#endif

static struct timespec reading;

/* Where a thread goes on that was in the middle of clock_gettime(CLOCK_MONOTONIC, &reading). */
static void landed(void) {
    struct timespec kernel;
    syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &kernel);
    int64_t read = reading.tv_sec * SECOND + reading.tv_nsec, now = kernel.tv_sec * SECOND + kernel.tv_nsec;
    EXPECT(read <= now && read + 60 * SECOND > now, "%lld was read, it is %lld", (long long)read, (long long)now);
    exit(finish());
}

int main(int count, char **arguments) {
    (void)count;
    printf("%p %p\n", (void *)landed, (void *)&reading);
    ready();
    while (!is_told(arguments[1])) {
        struct timespec nap = {0, 2000000};
        syscall(SYS_nanosleep, &nap, NULL);
    }
    int (*gettime)(clockid_t, struct timespec *) = (int (*)(clockid_t, struct timespec *))function(CALLED "clock_gettime");
    time_t (*get_time)(time_t *) = (time_t(*)(time_t *))function(CALLED "time");
    int (*get_processor)(unsigned *, unsigned *, void *) =
        (int (*)(unsigned *, unsigned *, void *))function(CALLED "getcpu");
    if (!gettime || (HAS_TIME && !get_time)) {
        differs("the image has no functions any more");
        return finish();
    }
    for (clockid_t clock = CLOCK_REALTIME; clock <= CLOCK_TAI; clock++) {
        struct timespec before, between, after;
        if (clock == 8 || clock == 9 || clock == 10 || clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID) continue;
        syscall(SYS_clock_gettime, clock, &before);
        EXPECT_EQUAL("clock_gettime of the vdso", gettime(clock, &between), 0);
        syscall(SYS_clock_gettime, clock, &after);
        int64_t first = before.tv_sec * SECOND + before.tv_nsec, last = after.tv_sec * SECOND + after.tv_nsec;
        int64_t read = between.tv_sec * SECOND + between.tv_nsec;
        EXPECT(first <= read && read <= last, "clock %d: %lld is not from %lld to %lld", clock, (long long)read,
               (long long)first, (long long)last);
    }
#ifdef SYS_time
    time_t now = get_time(NULL);
    time_t kernel = syscall(SYS_time, NULL);
    EXPECT(now && now <= kernel && now + 2 >= kernel, "time(2) is %lld, not %lld", (long long)now, (long long)kernel);
#endif
    unsigned processor = -1;
    EXPECT(!get_processor || (get_processor(&processor, NULL, NULL) == 0 && processor < 4096), "getcpu says %u", processor);
    return finish();
}
