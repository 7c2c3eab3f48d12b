/* Every register that a program can see, held in a loop of two instructions that makes no system call; as registers.c.
 *
 * x0 leads to `told`, x1 holds what stands there; all others hold values of their own until the SIGUSR1 handler stores to it.
 */
#include "tracee.h"

struct {
    uint64_t general[31];
    uint64_t stack_pointers[2];
    uint64_t flags, control, status, thread_pointers[2];
    uint8_t vectors[32][16];
} seen __attribute__((aligned(16)));
uint8_t vectors_in[32][16] __attribute__((aligned(16)));

int main(void) {
    listen_for_signal();
    fill(vectors_in, sizeof vectors_in, 77);
    ready();
    __asm__ volatile(
        "stp x29, x30, [sp, #-16]!\n\t"
        "adrp x0, seen\n\t"
        "add x0, x0, :lo12:seen\n\t"
        "mov x1, sp\n\t"
        "str x1, [x0, #248]\n\t"
        "mrs x1, tpidr_el0\n\t"
        "str x1, [x0, #288]\n\t"
        "adrp x0, vectors_in\n\t"
        "add x0, x0, :lo12:vectors_in\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "ldr q\\n, [x0, #16*\\n]\n\t"
        ".endr\n\t"
        "mov x0, #0xc00000\n\t" /* round toward zero */
        "msr fpcr, x0\n\t"
        "mov x0, #0x15\n\t" /* three sticky flags */
        "msr fpsr, x0\n\t"
        "mov x0, #0x90000000\n\t" /* negative, overflow */
        "msr nzcv, x0\n\t"
        ".irp n,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30\n\t"
        "movz x\\n, #0x1100+\\n\n\t"
        "movk x\\n, #0x2200+\\n, lsl #16\n\t"
        "movk x\\n, #0x3300+\\n, lsl #32\n\t"
        "movk x\\n, #0xff00+\\n, lsl #48\n\t"
        ".endr\n\t"
        "adrp x0, told\n\t"
        "add x0, x0, :lo12:told\n\t"
        "1: ldr w1, [x0]\n\t"
        "cbz w1, 1b\n\t"
        "adrp x0, seen\n\t"
        "add x0, x0, :lo12:seen\n\t"
        ".irp n,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30\n\t"
        "str x\\n, [x0, #8*\\n]\n\t"
        ".endr\n\t"
        "mov x1, sp\n\t"
        "str x1, [x0, #256]\n\t"
        "mrs x1, nzcv\n\t"
        "str x1, [x0, #264]\n\t"
        "mrs x1, fpcr\n\t"
        "str x1, [x0, #272]\n\t"
        "mrs x1, fpsr\n\t"
        "str x1, [x0, #280]\n\t"
        "mrs x1, tpidr_el0\n\t"
        "str x1, [x0, #296]\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "str q\\n, [x0, #304+16*\\n]\n\t"
        ".endr\n\t"
        "msr fpcr, xzr\n\t"
        "ldp x29, x30, [sp], #16\n\t"
        :
        :
        : "x0", "x1", "x2", "x3", "x4", "x5", "x6", "x7", "x8", "x9", "x10", "x11", "x12", "x13", "x14", "x15", "x16", "x17",
          "x18", "x19", "x20", "x21", "x22", "x23", "x24", "x25", "x26", "x27", "x28", "x30", "memory", "cc", "v0", "v1", "v2",
          "v3", "v4", "v5", "v6", "v7", "v8", "v9", "v10", "v11", "v12", "v13", "v14", "v15", "v16", "v17", "v18", "v19", "v20",
          "v21", "v22", "v23", "v24", "v25", "v26", "v27", "v28", "v29", "v30", "v31");
    for (uint64_t index = 2; index < 31; index++) {
        uint64_t wanted = (0xff00 + index) << 48 | (0x3300 + index) << 32 | (0x2200 + index) << 16 | (0x1100 + index);
        char name[8];
        snprintf(name, sizeof name, "x%d", (int)index);
        EXPECT_EQUAL(name, seen.general[index], wanted);
    }
    EXPECT_EQUAL("the stack pointer", seen.stack_pointers[1], seen.stack_pointers[0]);
    EXPECT_EQUAL("the thread pointer", seen.thread_pointers[1], seen.thread_pointers[0]);
    EXPECT_EQUAL("the flags", seen.flags, 0x90000000ULL);
    EXPECT_EQUAL("FPCR", seen.control, 0xc00000ULL);
    EXPECT_EQUAL("FPSR", seen.status, 0x15ULL);
    expect_filled("a vector register", seen.vectors, sizeof seen.vectors, 77);
    return finish();
}
