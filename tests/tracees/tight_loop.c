/* Pure arithmetic in registers, integer and floating, no system call within a round; once told, all of it is done again and compared. */
#include "tracee.h"

struct sums {
    uint64_t state;
    double sum;
};

static struct sums advanced(struct sums sums) {
    for (int step = 0; step < 4000000; step++) {
        sums.state = sums.state * 6364136223846793005ULL + 1442695040888963407ULL;
        sums.sum = sums.sum * 0.5 + (double)(sums.state >> 40);
    }
    return sums;
}

int main(int count, char **arguments) {
    long least = count > 2 ? atol(arguments[2]) : 60, rounds = 0;
    struct sums found = {1, 0}, wanted = {1, 0};
    ready();
    for (; rounds < least || !is_told(arguments[1]); rounds++) found = advanced(found);
    while (rounds--) wanted = advanced(wanted);
    EXPECT(found.state == wanted.state, "the whole number is %llx, should be %llx", (long long)found.state, (long long)wanted.state);
    EXPECT(found.sum == wanted.sum, "the sum is %.17g, should be %.17g", found.sum, wanted.sum);
    return finish();
}
