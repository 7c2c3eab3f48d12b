/* A counter that is only right when restartable sequences are: kept in a critical section almost all the time.
 *
 * An aborted section must run its abort path and nothing else; an unfinished one must never count.
 */
#include "tracee.h"

#include <sys/rseq.h>

static volatile uint64_t started, committed;
static uint64_t aborted;

static struct rseq_cs section __attribute__((aligned(32)));

/* One try: counts `started` before, `committed` as the last instruction of the section. */
#ifdef __aarch64__
static int attempt(struct rseq *area) {
    int failed = 0;
    __asm__ volatile(
        "adr x9, 1f\n\t"
        "str x9, [%[section], #8]\n\t"
        "adr x10, 2f\n\t"
        "sub x10, x10, x9\n\t"
        "str x10, [%[section], #16]\n\t"
        "adr x9, 4f\n\t"
        "str x9, [%[section], #24]\n\t"
        "str %[section], [%[pointer]]\n\t"
        "1:\n\t"
        "mov w10, #300\n\t"
        "5: subs w10, w10, #1\n\t"
        "b.ne 5b\n\t"
        "ldr x9, [%[committed]]\n\t"
        "add x9, x9, #1\n\t"
        "str x9, [%[committed]]\n\t"
        "2:\n\t"
        "b 6f\n\t"
        ".inst 0xd428bc00\n\t" /* RSEQ_SIG */
        "4:\n\t"
        "mov w9, #1\n\t"
        "str w9, [%[failed]]\n\t"
        "6:\n\t"
        :
        : [failed] "r"(&failed), [committed] "r"(&committed), [section] "r"(&section), [pointer] "r"(&area->rseq_cs)
        : "x9", "x10", "memory", "cc");
    return failed;
}
#else
static int attempt(struct rseq *area) {
    int failed = 0;
    __asm__ volatile(
        "lea 1f(%%rip), %%rax\n\t"
        "mov %%rax, 8+%[section]\n\t"
        "lea 2f(%%rip), %%rcx\n\t"
        "sub %%rax, %%rcx\n\t"
        "mov %%rcx, 16+%[section]\n\t"
        "lea 4f(%%rip), %%rax\n\t"
        "mov %%rax, 24+%[section]\n\t"
        "lea %[section], %%rax\n\t"
        "mov %%rax, %[pointer]\n\t"
        "1:\n\t"
        "mov $300, %%ecx\n\t"
        "5: dec %%ecx\n\t"
        "jnz 5b\n\t"
        "incq %[committed]\n\t"
        "2:\n\t"
        "jmp 6f\n\t"
        ".byte 0x0f, 0xb9, 0x3d\n\t"
        ".long 0x53053053\n\t"
        "4:\n\t"
        "movl $1, %[failed]\n\t"
        "6:\n\t"
        : [failed] "+m"(failed), [committed] "+m"(committed), [section] "+m"(section), [pointer] "=m"(area->rseq_cs)
        :
        : "rax", "rcx", "memory", "cc");
    return failed;
}
#endif

int main(void) {
    if (!__rseq_size) cannot("find a registered rseq area in this C library");
    struct rseq *area = (struct rseq *)((char *)__builtin_thread_pointer() + __rseq_offset);
    listen_for_signal();
    ready();
    while (!told) {
        uint64_t before = committed;
        started++;
        if (attempt(area)) {
            aborted++;
            EXPECT(committed == before, "an aborted section counted");
        } else
            EXPECT(committed == before + 1, "a finished section did not count");
    }
    EXPECT_EQUAL("sections", committed + aborted, started);
    uint32_t length = 32;
    EXPECT(syscall(SYS_rseq, area, length, 0, RSEQ_SIG) == -1 && errno == EBUSY,
           "the area is not registered: %s", strerror(errno));
    cpu_set_t all;
    sched_getaffinity(0, sizeof all, &all);
    for (int processor = 0; processor < CPU_SETSIZE; processor++)
        if (CPU_ISSET(processor, &all)) {
            cpu_set_t one;
            CPU_ZERO(&one);
            CPU_SET(processor, &one);
            sched_setaffinity(0, sizeof one, &one);
            EXPECT_EQUAL("processor in the rseq area", area->cpu_id, processor);
        }
    return finish();
}
