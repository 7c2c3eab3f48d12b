/* Keeps a state, and says under which epoch it runs. */
#include "failover.h"

static uint64_t number;

int main(void)
{
    setvbuf(stdout, NULL, _IOLBF, 0);
    failover_region(&number, sizeof number, "number");
    if (failover_open("token") < 0) {
        fprintf(stderr, "%s\n", failover_error());
        return 3;
    }
    for (;; number++) {
        printf("%llu\n", (unsigned long long)failover_epoch());
        if (failover_commit() < 0)
            fprintf(stderr, "%s\n", failover_error());
        usleep(10000);
    }
}
