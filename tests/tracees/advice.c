/* Advice given with madvise and mlock is still in force, as the kernel's own VmFlags and a fork show. */
#include "tracee.h"

#include <sys/resource.h>

#ifndef MADV_WIPEONFORK
#define MADV_WIPEONFORK 18
#endif
#define CODES "lo dc dd wf hg nh sr rr mg nr lf "

int main(int count, char **arguments) {
    (void)count;
    const struct {
        const char *name;
        int advice;
    } advices[] = {{"none", -1},           {"dontfork", MADV_DONTFORK}, {"dontdump", MADV_DONTDUMP},
                   {"wipeonfork", MADV_WIPEONFORK}, {"hugepage", MADV_HUGEPAGE}, {"nohugepage", MADV_NOHUGEPAGE},
                   {"sequential", MADV_SEQUENTIAL}, {"random", MADV_RANDOM}, {"mergeable", MADV_MERGEABLE}};
    enum { KINDS = sizeof advices / sizeof *advices };
    unsigned char *places[KINDS + 2];
    char before[KINDS + 2][64], after[64];
    for (int kind = 0; kind < KINDS; kind++) {
        places[kind] = map_pages(16, PROT_READ | PROT_WRITE, kind == 0 ? MAP_NORESERVE : 0);
        fill(places[kind], 16 * PAGE, kind);
        if (advices[kind].advice >= 0) madvise(places[kind], 16 * PAGE, advices[kind].advice);
    }
    places[KINDS] = map_pages(4, PROT_READ | PROT_WRITE, 0);
    if (mlock(places[KINDS], 4 * PAGE)) cannot("lock memory");
    places[KINDS + 1] = map_pages(64, PROT_READ | PROT_WRITE, 0);
    if (mlock2(places[KINDS + 1], 64 * PAGE, MLOCK_ONFAULT)) cannot("lock memory on fault");
    places[KINDS + 1][0] = 1;
    for (int kind = 0; kind < KINDS + 2; kind++) flags_at(places[kind], CODES, before[kind]);
    ready();
    wait_for_go(arguments[1]);
    for (int kind = 0; kind < KINDS + 2; kind++) {
        flags_at(places[kind], CODES, after);
        EXPECT(!strcmp(before[kind], after), "%s: flags are%s, were%s",
               kind < KINDS ? advices[kind].name : "locked", after, before[kind]);
    }
    for (int kind = 0; kind < KINDS; kind++) expect_filled(advices[kind].name, places[kind], 16 * PAGE, kind);
    fflush(stdout);
    pid_t child = fork();
    if (child == 0) {
        int there = msync(places[1], PAGE, MS_ASYNC) == 0;
        _exit(places[3][0] ? 3 : there ? 1 : 0);
    }
    int status;
    waitpid(child, &status, 0);
    EXPECT(WIFEXITED(status) && WEXITSTATUS(status) == 0, "fork does not keep its promises: status %x", status);
    return finish();
}
