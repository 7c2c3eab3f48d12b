/* The stack keeps its frames and still grows by itself when the program recurses deeper than ever before. */
#include "tracee.h"

static uint64_t descend(int depth) {
    volatile uint64_t frame[512];
    for (int index = 0; index < 512; index++) frame[index] = mix(depth * 1000 + index);
    uint64_t below = depth ? descend(depth - 1) : 0;
    for (int index = 0; index < 512; index++)
        if (frame[index] != mix(depth * 1000 + index)) return 1;
    return below;
}

static void hold(const char *go, int depth) {
    volatile uint64_t frame[512];
    for (int index = 0; index < 512; index++) frame[index] = mix(index + depth);
    if (depth)
        hold(go, depth - 1);
    else {
        ready();
        wait_for_go(go);
        EXPECT(descend(1500) == 0, "frames six megabytes down are wrong");
    }
    for (int index = 0; index < 512; index++)
        if (frame[index] != mix(index + depth)) {
            differs("frame %d is wrong", depth);
            return;
        }
}

int main(int count, char **arguments) {
    (void)count;
    hold(arguments[1], 20);
    char flags[16];
    flags_at(&count, "gd ", flags);
    EXPECT(!strcmp(flags, " gd"), "the stack does not grow down");
    return finish();
}
