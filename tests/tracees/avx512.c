/* The AVX-512 registers and masks, held in a loop without system calls. */
#include "tracee.h"

static uint8_t in[32][64] __attribute__((aligned(64)));
static uint8_t out[32][64] __attribute__((aligned(64)));
static uint16_t masks[8];

__attribute__((target("avx512f"))) static void hold(void) {
    __asm__ volatile(
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "vmovdqa64 \\n*64+%[in], %%zmm\\n\n\t"
        ".endr\n\t"
        ".irp n,0,1,2,3,4,5,6,7\n\t"
        "mov $0x1230+\\n, %%eax\n\t"
        "kmovw %%eax, %%k\\n\n\t"
        ".endr\n\t"
        "1: cmpl $0, %[told]\n\t"
        "je 1b\n\t"
        ".irp n,0,1,2,3,4,5,6,7\n\t"
        "kmovw %%k\\n, %%eax\n\t"
        "mov %%ax, \\n*2+%[masks]\n\t"
        ".endr\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "vmovdqa64 %%zmm\\n, \\n*64+%[out]\n\t"
        ".endr\n\t"
        "vzeroupper\n\t"
        : [out] "=m"(out), [masks] "=m"(masks)
        : [in] "m"(in), [told] "m"(told)
        : "rax", "memory", "cc");
}

int main(void) {
    if (!__builtin_cpu_supports("avx512f")) cannot("find AVX-512 in this processor");
    listen_for_signal();
    fill(in, sizeof in, 6);
    ready();
    hold();
    expect_filled("the AVX-512 registers", out, sizeof out, 6);
    for (int index = 0; index < 8; index++) EXPECT_EQUAL("a mask register", masks[index], 0x1230 + index);
    return finish();
}
