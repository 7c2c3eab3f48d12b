/* Sixty-four gigabytes of which a few pages exist: those come back, the rest reads as zero. */
#include "tracee.h"

#define SPAN (64UL << 30)

int main(int count, char **arguments) {
    (void)count;
    unsigned char *area = mmap(NULL, SPAN, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (area == MAP_FAILED) cannot("map 64 GiB");
    madvise(area, SPAN, MADV_NOHUGEPAGE); /* one of them is 32 MiB where pages are 16 KiB */
    for (uint64_t index = 0; index < 40; index++) fill(area + (mix(index) % (SPAN / PAGE)) * PAGE, PAGE, index);
    ready();
    wait_for_go(arguments[1]);
    for (uint64_t index = 0; index < 40; index++) {
        unsigned char *page = area + (mix(index) % (SPAN / PAGE)) * PAGE;
        expect_filled("a page of the sparse mapping", page, PAGE, index);
        expect_zero("a page never written", area + (mix(index + 1000) % (SPAN / PAGE)) * PAGE, PAGE);
    }
    return finish();
}
