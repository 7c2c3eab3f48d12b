/* A guard page still bites, at the address where it stood; "advised" asks for the kernel's lightweight guards. */
#include "tracee.h"

#include <setjmp.h>

#ifndef MADV_GUARD_INSTALL
#define MADV_GUARD_INSTALL 102
#endif

static sigjmp_buf back;
static void *volatile bitten;

static void bite(int signal_number, siginfo_t *about, void *context) {
    (void)signal_number, (void)context;
    bitten = about->si_addr;
    siglongjmp(back, 1);
}

static void expect_bite(const char *what, unsigned char *address) {
    bitten = NULL;
    if (sigsetjmp(back, 1) == 0) *(volatile unsigned char *)address = 1;
    EXPECT(bitten == address, "%s: stored at %p, bitten at %p", what, (void *)address, (void *)bitten);
}

int main(int count, char **arguments) {
    struct sigaction action = {.sa_sigaction = bite, .sa_flags = SA_SIGINFO};
    sigaction(SIGSEGV, &action, NULL);
    unsigned char *area = map_pages(8, PROT_READ | PROT_WRITE, 0);
    fill(area, 8 * PAGE, 3);
    if (count > 2) {
        if (madvise(area, PAGE, MADV_GUARD_INSTALL) || madvise(area + 7 * PAGE, PAGE, MADV_GUARD_INSTALL))
            cannot("install guards by madvise");
    } else {
        mprotect(area, PAGE, PROT_NONE);
        mprotect(area + 7 * PAGE, PAGE, PROT_NONE);
    }
    ready();
    wait_for_go(arguments[1]);
    expect_bite("lower guard", area);
    expect_bite("upper guard", area + 7 * PAGE);
    unsigned char whole[1];
    memcpy(whole, area + PAGE, 1);
    EXPECT(*(uint64_t *)(area + PAGE) == mix(3 + PAGE / 8), "between the guards is wrong");
    return finish();
}
