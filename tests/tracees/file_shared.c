/* A shared file mapping: what is stored there reaches the file, before and after. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    unsigned char page[PAGE];
    int file = open("shared.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    if (ftruncate(file, 4 * PAGE)) cannot("size the file");
    unsigned char *shared = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    unsigned char *reader = mmap(NULL, 2 * PAGE, PROT_READ, MAP_SHARED, file, PAGE);
    if (shared == MAP_FAILED || reader == MAP_FAILED) cannot("map the file");
    int other = open("other.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    if (ftruncate(other, PAGE)) cannot("size the other file");
    unsigned char *opened = mmap(NULL, PAGE, PROT_READ, MAP_SHARED, other, 0);
    close(other), other = open("other.bin", O_RDONLY);
    unsigned char *closed = mmap(NULL, PAGE, PROT_READ, MAP_SHARED, other, 0);
    fill(shared, 4 * PAGE, 1);
    ready();
    wait_for_go(arguments[1]);
    expect_filled("shared mapping", shared, 4 * PAGE, 1);
    fill(shared + PAGE, PAGE, 2);
    expect_filled("second view", reader, PAGE, 2);
    EXPECT(pread(file, page, PAGE, PAGE) == PAGE, "the file cannot be read");
    expect_filled("the file", page, PAGE, 2);
    EXPECT(!strcmp(permissions_at(shared), "rw-s"), "the mapping is %s", permissions_at(shared));
    EXPECT(!strcmp(permissions_at(reader), "r--s"), "the second view is %s", permissions_at(reader));
    EXPECT(mprotect(opened, PAGE, PROT_READ | PROT_WRITE) == 0, "what was open for writing is not any more");
    EXPECT(mprotect(closed, PAGE, PROT_READ | PROT_WRITE) == -1 && errno == EACCES, "what was only read can be written");
    return finish();
}
