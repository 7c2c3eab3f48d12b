/* The bases of fs (thread-local storage) and gs. */
#include "tracee.h"

#include <asm/prctl.h>

static __thread uint64_t local = 11;
static __thread uint64_t untouched;

int main(int count, char **arguments) {
    (void)count;
    uint64_t *area = (uint64_t *)map_pages(1, PROT_READ | PROT_WRITE, 0), fs, gs, again, value;
    area[1] = 0xfeedULL;
    if (syscall(SYS_arch_prctl, ARCH_SET_GS, area)) cannot("set the base of gs");
    syscall(SYS_arch_prctl, ARCH_GET_FS, &fs);
    local = 12;
    ready();
    wait_for_go(arguments[1]);
    syscall(SYS_arch_prctl, ARCH_GET_FS, &again);
    syscall(SYS_arch_prctl, ARCH_GET_GS, &gs);
    EXPECT_EQUAL("base of fs", again, fs);
    EXPECT_EQUAL("base of gs", gs, (uintptr_t)area);
    __asm__ volatile("mov %%gs:8, %0" : "=r"(value));
    EXPECT_EQUAL("a word behind gs", value, 0xfeed);
    EXPECT_EQUAL("a thread-local variable", local, 12);
    EXPECT_EQUAL("an untouched thread-local variable", untouched, 0);
    return finish();
}
