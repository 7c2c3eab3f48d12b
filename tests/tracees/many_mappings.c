/* Twelve hundred small mappings with holes between them. */
#include "tracee.h"

#define COUNT 1200

int main(int count, char **arguments) {
    (void)count;
    unsigned char *area = map_pages(2 * COUNT, PROT_NONE, 0);
    for (int index = 0; index < COUNT; index++) {
        unsigned char *page = area + 2 * index * PAGE;
        munmap(page + PAGE, PAGE);
        mprotect(page, PAGE, PROT_READ | PROT_WRITE);
        fill(page, PAGE, index);
        if (index % 3 == 0) mprotect(page, PAGE, PROT_READ);
    }
    ready();
    wait_for_go(arguments[1]);
    for (int index = 0; index < COUNT; index++) {
        expect_filled("a small mapping", area + 2 * index * PAGE, PAGE, index);
        EXPECT(msync(area + (2 * index + 1) * PAGE, PAGE, MS_ASYNC) == -1, "a hole is filled");
    }
    return finish();
}
