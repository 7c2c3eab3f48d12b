/* A private mapping of a file that has no name any more: its bytes come back, whatever backs them. */
#include "tracee.h"

int main(int count, char **arguments) {
    (void)count;
    unsigned char page[4 * PAGE];
    int file = open("doomed.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    fill(page, sizeof page, 9);
    if (write(file, page, sizeof page) != sizeof page) cannot("write the file");
    unsigned char *mapped = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE, file, 0);
    close(file);
    unlink("doomed.bin");
    fill(mapped + PAGE, PAGE, 10);
    ready();
    wait_for_go(arguments[1]);
    expect_filled("unwritten first page", mapped, PAGE, 9);
    expect_filled("written page", mapped + PAGE, PAGE, 10);
    expect_filled("unwritten third page", mapped + 2 * PAGE, PAGE, 9 + 2 * PAGE / 8);
    return finish();
}
