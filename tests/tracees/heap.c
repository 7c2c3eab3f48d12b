/* The break stands where it stood, the heap's bytes too, and it still grows and shrinks. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    unsigned char *start = sbrk(64 * PAGE);
    fill(start, 64 * PAGE, 5);
    char *blocks[200];
    for (int index = 0; index < 200; index++) {
        blocks[index] = malloc(100 + index * 50);
        memset(blocks[index], index, 100 + index * 50);
    }
    for (int index = 0; index < 200; index += 3) free(blocks[index]);
    void *end = sbrk(0);
    ready();
    wait_for_go(arguments[1]);
    EXPECT_EQUAL("the break", (uintptr_t)sbrk(0), (uintptr_t)end);
    expect_filled("brk memory", start, 64 * PAGE, 5);
    for (int index = 0; index < 200; index++)
        if (index % 3)
            for (int offset = 0; offset < 100 + index * 50; offset++)
                if (blocks[index][offset] != (char)index) {
                    differs("block %d is wrong at %d", index, offset);
                    break;
                }
    for (int index = 0; index < 200; index += 3) blocks[index] = malloc(3000);
    unsigned char *grown = sbrk(300 * PAGE);
    EXPECT(grown != (void *)-1, "the heap does not grow: %s", strerror(errno));
    if (grown != (void *)-1) {
        expect_zero("fresh heap", grown, 300 * PAGE);
        fill(grown, 300 * PAGE, 6);
        expect_filled("grown heap", grown, 300 * PAGE, 6);
        EXPECT(sbrk(-300 * (long)PAGE) != (void *)-1, "the heap does not shrink");
    }
    char line[300];
    int named = 0;
    FILE *maps = fopen("/proc/self/maps", "r");
    while (fgets(line, sizeof line, maps)) named += strstr(line, "[heap]") != NULL;
    fclose(maps);
    EXPECT(named >= 1, "no mapping is called [heap]");
    return finish();
}
