/* Shared anonymous memory keeps its bytes, at all places where it is mapped, and is shared with a child born later. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    uint64_t *shared = mmap(NULL, 8 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (shared == MAP_FAILED) cannot("map");
    fill(shared, 4 * PAGE, 7);
    uint64_t *twin = mremap(shared, 0, 8 * PAGE, MREMAP_MAYMOVE), *part = mremap(shared + 2 * PAGE / 8, 0, PAGE, MREMAP_MAYMOVE);
    if (twin == MAP_FAILED || part == MAP_FAILED || mprotect(twin + PAGE / 8, PAGE, PROT_READ)) cannot("map it again");
    ready();
    wait_for_go(arguments[1]);
    expect_filled("shared anonymous memory", shared, 4 * PAGE, 7);
    expect_zero("its untouched tail", shared + 4 * PAGE / 8, 4 * PAGE);
    shared[7] = 7, part[0] = 8;
    EXPECT_EQUAL("what is stored at its other place", twin[7], 7);
    EXPECT_EQUAL("what is stored in a part of it", twin[2 * PAGE / 8], 8);
    EXPECT(!strcmp(permissions_at(twin + PAGE / 8), "r--s"), "its protection is %s", permissions_at(twin + PAGE / 8));
    pid_t child = fork();
    if (child == 0) {
        shared[1000] = 42;
        _exit(0);
    }
    waitpid(child, NULL, 0);
    EXPECT_EQUAL("what a child stored", shared[1000], 42);
    return finish();
}
