/* Pure arithmetic in registers, integer and floating, no system call between two lines of output. */
#include "tracee.h"

int main(int count, char **arguments) {
    long rounds = count > 2 ? atol(arguments[2]) : 60;
    uint64_t state = 1;
    double sum = 0;
    ready();
    for (long round = 0; round < rounds; round++) {
        for (int step = 0; step < 4000000; step++) {
            state = state * 6364136223846793005ULL + 1442695040888963407ULL;
            sum = sum * 0.5 + (double)(state >> 40);
        }
        printf("%ld %016llx %.17g\n", round, (unsigned long long)state, sum);
        fflush(stdout);
    }
    return finish();
}
