/* The upper halves of the AVX registers, held in a loop without system calls. */
#include "tracee.h"

static uint8_t in[16][32] __attribute__((aligned(64)));
static uint8_t out[16][32] __attribute__((aligned(64)));

int main(void) {
    if (!__builtin_cpu_supports("avx")) cannot("find AVX in this processor");
    listen_for_signal();
    fill(in, sizeof in, 5);
    ready();
    __asm__ volatile(
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "vmovdqa \\n*32+%[in], %%ymm\\n\n\t"
        ".endr\n\t"
        "1: cmpl $0, %[told]\n\t"
        "je 1b\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "vmovdqa %%ymm\\n, \\n*32+%[out]\n\t"
        ".endr\n\t"
        "vzeroupper\n\t"
        : [out] "=m"(out)
        : [in] "m"(in), [told] "m"(told)
        : "memory", "cc", "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9", "xmm10",
          "xmm11", "xmm12", "xmm13", "xmm14", "xmm15");
    expect_filled("the AVX registers", out, sizeof out, 5);
    return finish();
}
