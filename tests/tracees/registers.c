/* Every register that a program can see, held in a loop of three instructions that makes no system call.
 *
 * The loop ends when the SIGUSR1 handler stores to `told`; the registers are then written out and compared.
 */
#include "tracee.h"

struct seen {
    uint64_t general[16]; /* rax rbx rcx rdx rsi rdi rbp r8..r15, flags */
    uint8_t sse[16][16];
    uint8_t x87[108];
    uint32_t mxcsr;
} __attribute__((aligned(64)));

static struct seen seen;
static uint8_t sse_in[16][16] __attribute__((aligned(64)));
static const long double pushed[5] = {1.25L, -3.0e4000L, 0.1L, 7.0L, -0.0L};
static const uint32_t mxcsr_in = 0x7fa4;    /* round toward zero, flush to zero, two sticky flags */
static const uint16_t control_in = 0x0e7f;  /* round up, 53 bits */

int main(void) {
    uint64_t stack_pointer;
    listen_for_signal();
    fill(sse_in, sizeof sse_in, 77);
    ready();
    __asm__ volatile(
        "sub $256, %%rsp\n\t" /* the red zone is the compiler's */
        "push %%rbp\n\t"
        "push %%rbx\n\t"
        "mov %%rsp, %[stack]\n\t"
        "fninit\n\t"
        "fldcw %[control]\n\t"
        "fldt 0+%[pushed]\n\t"
        "fldt 16+%[pushed]\n\t"
        "fldt 32+%[pushed]\n\t"
        "fldt 48+%[pushed]\n\t"
        "fldt 64+%[pushed]\n\t"
        "ldmxcsr %[mxcsr]\n\t"
        "lea %[sse], %%rax\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "movdqa \\n*16(%%rax), %%xmm\\n\n\t"
        ".endr\n\t"
        "mov $0x1111111111111111, %%rax\n\t"
        "mov $0x2222222222222222, %%rbx\n\t"
        "mov $0x3333333333333333, %%rcx\n\t"
        "mov $0x4444444444444444, %%rdx\n\t"
        "mov $0x5555555555555555, %%rsi\n\t"
        "mov $0x6666666666666666, %%rdi\n\t"
        "mov $0x7777777777777777, %%rbp\n\t"
        "mov $0x8888888888888888, %%r8\n\t"
        "mov $0x9999999999999999, %%r9\n\t"
        "mov $0xaaaaaaaaaaaaaaaa, %%r10\n\t"
        "mov $0xbbbbbbbbbbbbbbbb, %%r11\n\t"
        "mov $0xcccccccccccccccc, %%r12\n\t"
        "mov $0xdddddddddddddddd, %%r13\n\t"
        "mov $0xeeeeeeeeeeeeeeee, %%r14\n\t"
        "mov $0xf0f0f0f0f0f0f0f0, %%r15\n\t"
        "std\n\t"
        "1: cmpl $0, %[told]\n\t"
        "je 1b\n\t"
        "mov %%rax, 0+%[seen]\n\t"
        "pushfq\n\t"
        "pop %%rax\n\t"
        "cld\n\t"
        "mov %%rax, 120+%[seen]\n\t"
        "mov %%rbx, 8+%[seen]\n\t"
        "mov %%rcx, 16+%[seen]\n\t"
        "mov %%rdx, 24+%[seen]\n\t"
        "mov %%rsi, 32+%[seen]\n\t"
        "mov %%rdi, 40+%[seen]\n\t"
        "mov %%rbp, 48+%[seen]\n\t"
        "mov %%r8, 56+%[seen]\n\t"
        "mov %%r9, 64+%[seen]\n\t"
        "mov %%r10, 72+%[seen]\n\t"
        "mov %%r11, 80+%[seen]\n\t"
        "mov %%r12, 88+%[seen]\n\t"
        "mov %%r13, 96+%[seen]\n\t"
        "mov %%r14, 104+%[seen]\n\t"
        "mov %%r15, 112+%[seen]\n\t"
        "lea 128+%[seen], %%rax\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "movdqa %%xmm\\n, \\n*16(%%rax)\n\t"
        ".endr\n\t"
        "stmxcsr 492+%[seen]\n\t"
        "fnsave 384+%[seen]\n\t"
        "movl $0x1f80, -8(%%rsp)\n\t"
        "ldmxcsr -8(%%rsp)\n\t"
        "pop %%rbx\n\t"
        "pop %%rbp\n\t"
        "add $256, %%rsp\n\t"
        : [stack] "=m"(stack_pointer), [seen] "+m"(seen)
        : [told] "m"(told), [sse] "m"(sse_in), [mxcsr] "m"(mxcsr_in), [control] "m"(control_in),
          [pushed] "m"(pushed)
        : "rax", "rcx", "rdx", "rsi", "rdi", "r8", "r9", "r10", "r11", "r12", "r13", "r14", "r15", "memory", "cc",
          "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9", "xmm10", "xmm11", "xmm12",
          "xmm13", "xmm14", "xmm15", "st");
    static const char *const names[15] = {"rax", "rbx", "rcx", "rdx", "rsi", "rdi", "rbp", "r8",
                                          "r9",  "r10", "r11", "r12", "r13", "r14", "r15"};
    for (uint64_t index = 0; index < 14; index++)
        EXPECT_EQUAL(names[index], seen.general[index], (index + 1) * 0x1111111111111111ULL);
    EXPECT_EQUAL("r15", seen.general[14], 0xf0f0f0f0f0f0f0f0ULL);
    EXPECT(seen.general[15] & 0x400, "the direction flag is clear");
    expect_filled("an SSE register", seen.sse, sizeof seen.sse, 77);
    EXPECT_EQUAL("MXCSR", seen.mxcsr, mxcsr_in);
    EXPECT_EQUAL("x87 control word", *(uint16_t *)seen.x87 & 0xf7f, control_in & 0xf7f);
    EXPECT_EQUAL("x87 stack top", (*(uint16_t *)(seen.x87 + 4) >> 11) & 7, 3);
    EXPECT_EQUAL("x87 tags", *(uint16_t *)(seen.x87 + 8), 0x007f); /* five in use, one of them zero */
    for (int index = 0; index < 5; index++)
        EXPECT(!memcmp(seen.x87 + 28 + 10 * index, &pushed[4 - index], 10), "x87 register %d is wrong", index);
    return finish();
}
