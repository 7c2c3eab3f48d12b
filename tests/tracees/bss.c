/* Initialised data, zeroed data and the parts of it that nobody wrote. */
#include "tracee.h"

static unsigned char zeroed[256 * PAGE] __attribute__((aligned(4096)));
static uint64_t initialised[4] = {1, 2, 3, 4};
static const char text[] = "a constant";

int main(int count, char **arguments) {
    (void)count;
    for (int index = 0; index < 256; index += 5) fill(zeroed + index * PAGE, PAGE, index);
    initialised[2] = 99;
    ready();
    wait_for_go(arguments[1]);
    for (int index = 0; index < 256; index++)
        if (index % 5)
            expect_zero("an untouched page of bss", zeroed + index * PAGE, PAGE);
        else
            expect_filled("a written page of bss", zeroed + index * PAGE, PAGE, index);
    EXPECT(initialised[0] == 1 && initialised[2] == 99 && initialised[3] == 4, "initialised data is wrong");
    EXPECT(!strcmp(text, "a constant"), "constants are wrong");
    return finish();
}
