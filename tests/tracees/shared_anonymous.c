/* Shared anonymous memory keeps its bytes, and is still shared with a child born afterwards. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    uint64_t *shared = mmap(NULL, 8 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (shared == MAP_FAILED) cannot("map");
    fill(shared, 4 * PAGE, 7);
    ready();
    wait_for_go(arguments[1]);
    expect_filled("shared anonymous memory", shared, 4 * PAGE, 7);
    expect_zero("its untouched tail", shared + 4 * PAGE / 8, 4 * PAGE);
    pid_t child = fork();
    if (child == 0) {
        shared[1000] = 42;
        _exit(0);
    }
    waitpid(child, NULL, 0);
    EXPECT_EQUAL("what a child stored", shared[1000], 42);
    return finish();
}
