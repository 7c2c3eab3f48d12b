/* Anonymous private mappings of every protection come back with their place, their protection and their bytes. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    const int protections[] = {PROT_READ | PROT_WRITE, PROT_READ, PROT_NONE, PROT_READ | PROT_EXEC,
                               PROT_READ | PROT_WRITE | PROT_EXEC, PROT_WRITE, PROT_EXEC};
    enum { KINDS = sizeof protections / sizeof *protections };
    unsigned char *places[KINDS];
    char before[KINDS][8];
    for (int kind = 0; kind < KINDS; kind++) {
        places[kind] = map_pages(8, PROT_READ | PROT_WRITE, 0);
        fill(places[kind], 6 * PAGE, kind); /* two pages stay untouched */
        if (mprotect(places[kind], 8 * PAGE, protections[kind])) cannot("protect");
        strcpy(before[kind], permissions_at(places[kind]));
    }
    ready();
    wait_for_go(arguments[1]);
    for (int kind = 0; kind < KINDS; kind++) {
        EXPECT(!strcmp(before[kind], permissions_at(places[kind])), "mapping %d is %s, was %s", kind,
               permissions_at(places[kind]), before[kind]);
        if (mprotect(places[kind], 8 * PAGE, PROT_READ | PROT_WRITE)) differs("mapping %d cannot be opened", kind);
        expect_filled("mapping", places[kind], 6 * PAGE, kind);
        expect_zero("untouched tail", places[kind] + 6 * PAGE, 2 * PAGE);
        fill(places[kind], 8 * PAGE, 100 + kind);
        expect_filled("mapping written again", places[kind], 8 * PAGE, 100 + kind);
        EXPECT(munmap(places[kind], 8 * PAGE) == 0, "mapping %d cannot be unmapped", kind);
    }
    return finish();
}
