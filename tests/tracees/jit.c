/* A just-in-time compiler's life: pages become writable, get new code, become executable, and the code is called.
 *
 * Usage: jit GO ROUNDS NAP_US. The transcript has one line per round.
 */
#include "tracee.h"

#define FUNCTIONS 32

typedef uint32_t (*generated)(void);

int main(int count, char **arguments) {
    long rounds = count > 2 ? atol(arguments[2]) : 100, nap_us = count > 3 ? atol(arguments[3]) : 1000;
    struct timespec nap = {0, nap_us * 1000};
    unsigned char *code = map_pages(FUNCTIONS, PROT_READ | PROT_EXEC, 0);
    uint32_t wanted[FUNCTIONS];
    memset(wanted, 0, sizeof wanted);
    ready();
    for (long round = 0; round < rounds && !is_told(arguments[1]); round++) {
        for (int step = 0; step < 5; step++) {
            int index = mix(round * 5 + step) % FUNCTIONS;
            unsigned char *place = code + index * PAGE;
            wanted[index] = (uint32_t)mix(round * 100 + index) | 1;
            mprotect(place, PAGE, PROT_READ | PROT_WRITE);
            place[0] = 0xb8; /* mov $value, %eax; ret */
            memcpy(place + 1, &wanted[index], 4);
            place[5] = 0xc3;
            mprotect(place, PAGE, PROT_READ | PROT_EXEC);
        }
        uint64_t sum = 0;
        for (int index = 0; index < FUNCTIONS; index++) {
            uint32_t found = wanted[index] ? ((generated)(uintptr_t)(code + index * PAGE))() : 0;
            EXPECT(found == wanted[index], "function %d returned %x, not %x", index, found, wanted[index]);
            sum = mix(sum ^ found);
        }
        printf("%ld %016llx\n", round, (unsigned long long)sum);
        fflush(stdout);
        if (nap_us) nanosleep(&nap, NULL);
    }
    return finish();
}
