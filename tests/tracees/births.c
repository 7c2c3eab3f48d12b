/* Mothers that give birth to threads and wait for their end, as fast as they can, until the go file is there.
 *
 * Each child adds to a sum what its mother adds to her own: at the end both are equal, or somebody was lost or lived twice.
 */
#include "tracee.h"

#include <pthread.h>

#define MOTHERS 3

static const char *go;
static volatile int over;
static uint64_t sums[MOTHERS];
static __thread uint64_t own;

static void *child(void *argument) {
    uint64_t *seed = argument;
    own = mix(*seed);
    __atomic_fetch_add(&sums[*seed % MOTHERS], own, __ATOMIC_RELAXED);
    return (void *)(uintptr_t)own;
}

static void *mother(void *argument) {
    uint64_t number = (uintptr_t)argument, sum = 0;
    for (uint64_t seed = number; !over; seed += MOTHERS) {
        pthread_t born[2];
        uint64_t seeds[2] = {seed, seed += MOTHERS};
        for (int index = 0; index < 2; index++)
            if (pthread_create(&born[index], NULL, child, &seeds[index])) cannot("start a thread");
        for (int index = 0; index < 2; index++) {
            void *result = NULL;
            EXPECT(!pthread_join(born[index], &result), "a child could not be joined");
            EXPECT((uintptr_t)result == mix(seeds[index]), "a child brought something else");
            sum += mix(seeds[index]);
        }
    }
    EXPECT(sum == sums[number], "mother %d counts otherwise than her children", (int)number);
    return NULL;
}

int main(int count, char **arguments) {
    (void)count;
    pthread_t mothers[MOTHERS];
    go = arguments[1];
    for (uintptr_t number = 0; number < MOTHERS; number++) pthread_create(&mothers[number], NULL, mother, (void *)number);
    ready();
    wait_for_go(go);
    over = 1;
    for (int number = 0; number < MOTHERS; number++) pthread_join(mothers[number], NULL);
    return finish();
}
