/* Writes all the time, page after page of an arena, and knows what it must find there.
 *
 * Usage: hard_writer GO MEGABYTES. Page n holds n, and at both ends the number of the round in which it was last written. When
 * GO appears every page is compared with what the last round has left there. The counters lie in the arena's first page, so that
 * memory which is a mixture of two instants does not fit them.
 */
#include "tracee.h"

int main(int count, char **arguments) {
    if (count < 3) cannot("run without GO MEGABYTES");
    uint64_t pages = strtoull(arguments[2], NULL, 0) * 256;
    uint64_t *arena = (uint64_t *)map_pages(pages, PROT_READ | PROT_WRITE, 0);
    uint64_t words = PAGE / 8, *round = &arena[0], *place = &arena[1];
    for (uint64_t page = 1; page < pages; page++) arena[page * words] = 0, arena[page * words + 1] = page;
    *round = 1, *place = 1;
    ready();
    struct timespec nap = {0, 1000000};
    for (uint64_t step = 1; step % 4096 || !is_told(arguments[1]); step++) {
        if (step % 32 == 0) nanosleep(&nap, NULL); /* some 100 MB a second: hard, but less than can be copied */
        arena[*place * words] = *round;
        arena[*place * words + words - 1] = *round;
        *place += 1;
        if (*place == pages) *place = 1, *round += 1;
    }
    for (uint64_t page = 1; page < pages; page++) {
        uint64_t wanted = page < *place ? *round : *round - 1;
        uint64_t *found = arena + page * words;
        if (found[0] != wanted || found[words - 1] != wanted || found[1] != page)
            differs("page %lu holds rounds %lu and %lu where %lu belongs", (unsigned long)page, (unsigned long)found[0],
                    (unsigned long)found[words - 1], (unsigned long)wanted);
        if (differences > 20) break;
    }
    return finish();
}
