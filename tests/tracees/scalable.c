/* Scalable vectors (SVE) of aarch64, held in a loop that makes no system call: a call would forget most of them.
 *
 * Arguments: the go file, which it does not look for; bytes of a vector that it asks for, 0 for those that it has; "threads":
 * two more hold vectors of their own.
 */
#include "tracee.h"

#include <pthread.h>
#include <sys/prctl.h>

#define LONGEST 256
#ifndef PR_SVE_SET_VL
#define PR_SVE_SET_VL 50
#define PR_SVE_GET_VL 51
#endif
#define VECTORS (32 * LONGEST)
#define OTHERS 2

struct held {
    uint8_t vectors[VECTORS], predicates[16 * LONGEST / 8], faults[LONGEST / 8];
};
static struct held put[1 + OTHERS] __attribute__((aligned(16))), found[1 + OTHERS] __attribute__((aligned(16)));
static int wanted_size;
static pthread_barrier_t all_hold;

static size_t vector_size(void) {
    int told_size = prctl(PR_SVE_GET_VL);
    if (told_size < 0) cannot("use scalable vectors");
    return (size_t)(told_size & 0xffff);
}

/* Load all of them, look at `told` until it is set, store them: nothing in between is a call. */
static void hold(const struct held *from, struct held *into) {
    register const void *vectors __asm__("x0") = from->vectors, *predicates __asm__("x1") = from->predicates,
                                 *faults __asm__("x2") = from->faults;
    register void *vectors_into __asm__("x3") = into->vectors, *predicates_into __asm__("x4") = into->predicates,
                           *faults_into __asm__("x5") = into->faults;
    register volatile sig_atomic_t *waited __asm__("x6") = &told;
    __asm__ volatile(
        ".arch armv8-a+sve\n\t"
        "ldr p0, [x2]\n\t"
        "wrffr p0.b\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "ldr z\\n, [x0, #\\n, mul vl]\n\t"
        ".endr\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "ldr p\\n, [x1, #\\n, mul vl]\n\t"
        ".endr\n\t"
        "1: ldr w7, [x6]\n\t"
        "cbz w7, 1b\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n\t"
        "str z\\n, [x3, #\\n, mul vl]\n\t"
        ".endr\n\t"
        ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15\n\t"
        "str p\\n, [x4, #\\n, mul vl]\n\t"
        ".endr\n\t"
        "rdffr p0.b\n\t"
        "str p0, [x5]\n\t"
        :
        : "r"(vectors), "r"(predicates), "r"(faults), "r"(vectors_into), "r"(predicates_into), "r"(faults_into), "r"(waited)
        : "x7", "memory", "cc", "v0", "v1", "v2", "v3", "v4", "v5", "v6", "v7", "v8", "v9", "v10", "v11", "v12", "v13", "v14",
          "v15", "v16", "v17", "v18", "v19", "v20", "v21", "v22", "v23", "v24", "v25", "v26", "v27", "v28", "v29", "v30", "v31");
}

static void *holder(void *argument) {
    long index = (long)argument;
    if (wanted_size && prctl(PR_SVE_SET_VL, wanted_size) < 0) cannot("have vectors of %d bytes", wanted_size);
    if (index) {
        sigset_t every;
        sigfillset(&every);
        pthread_sigmask(SIG_BLOCK, &every, NULL);
    }
    fill(put[index].vectors, VECTORS, 100 + index);
    fill(put[index].predicates, sizeof put[index].predicates, 200 + index);
    /* of the first faults the lowest are set, as an instruction leaves them */
    memset(put[index].faults, 0xff, vector_size() / 16);
    pthread_barrier_wait(&all_hold);
    if (!index) ready();
    hold(&put[index], &found[index]);
    return NULL;
}

int main(int count, char **arguments) {
    int others = count > 3 && !strcmp(arguments[3], "threads") ? OTHERS : 0;
    pthread_t threads[OTHERS];
    wanted_size = count > 2 ? atoi(arguments[2]) : 0;
    vector_size();
    listen_for_signal();
    pthread_barrier_init(&all_hold, NULL, 1 + (unsigned)others);
    for (long index = 1; index <= others; index++) pthread_create(&threads[index - 1], NULL, holder, (void *)index);
    holder(NULL);
    for (int index = 0; index < others; index++) pthread_join(threads[index], NULL);
    size_t size = vector_size();
    if (wanted_size) EXPECT_EQUAL("the size of a vector", size, wanted_size);
    for (int index = 0; index <= others; index++) {
        expect_filled("a scalable vector", found[index].vectors, 32 * size, 100 + index);
        expect_filled("a predicate", found[index].predicates, 16 * size / 8, 200 + index);
        EXPECT(!memcmp(found[index].faults, put[index].faults, size / 8), "the first-fault register of thread %d", index);
    }
    return finish();
}
