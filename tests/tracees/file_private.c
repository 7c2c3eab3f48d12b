/* A private file mapping: pages written are the program's, pages not written are still the file's. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    unsigned char page[PAGE];
    int file = open("private.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    for (int index = 0; index < 8; index++) {
        fill(page, PAGE, index);
        if (write(file, page, PAGE) != PAGE) cannot("write the file");
    }
    unsigned char *writable = mmap(NULL, 8 * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE, file, 0);
    unsigned char *tail = mmap(NULL, 4 * PAGE, PROT_READ, MAP_PRIVATE, file, 4 * PAGE);
    unsigned char *sealed = mmap(NULL, 2 * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE, file, 2 * PAGE);
    if (writable == MAP_FAILED || tail == MAP_FAILED || sealed == MAP_FAILED) cannot("map the file");
    close(file);
    fill(writable + 2 * PAGE, PAGE, 1000);
    memset(writable + 5 * PAGE, 0, PAGE); /* written to zero: must not fall back to the file */
    fill(sealed, PAGE, 2000);
    mprotect(sealed, 2 * PAGE, PROT_READ); /* like a linker's RELRO: written once, then read-only */
    ready();
    wait_for_go(arguments[1]);
    for (int index = 0; index < 8; index++)
        if (index == 2)
            expect_filled("written page", writable + 2 * PAGE, PAGE, 1000);
        else if (index == 5)
            expect_zero("page written to zero", writable + 5 * PAGE, PAGE);
        else
            expect_filled("unwritten page", writable + index * PAGE, PAGE, index);
    for (int index = 0; index < 4; index++) expect_filled("read-only tail", tail + index * PAGE, PAGE, 4 + index);
    expect_filled("sealed page", sealed, PAGE, 2000);
    expect_filled("sealed neighbour", sealed + PAGE, PAGE, 3);
    EXPECT(!strcmp(permissions_at(sealed), "r--p"), "sealed mapping is %s", permissions_at(sealed));
    char line[300];
    int named = 0;
    FILE *maps = fopen("/proc/self/maps", "r");
    while (fgets(line, sizeof line, maps)) named += strstr(line, "/private.bin\n") != NULL;
    fclose(maps);
    EXPECT(named >= 3, "only %d mappings name the file", named);
    fill(writable, PAGE, 3000); /* writes stay private */
    file = open("private.bin", O_RDONLY);
    EXPECT(pread(file, page, PAGE, 0) == PAGE, "the file cannot be read");
    expect_filled("the file itself", page, PAGE, 0);
    return finish();
}
