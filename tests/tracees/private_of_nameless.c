/* Maps a file without a name for itself: a page that it has written stays its own, the others show what the file holds. */
#include "tracee.h"

int main(int count, char **arguments) {
    if (count < 3) cannot("find the go file and a kind");
    int file = strcmp(arguments[2], "memfd") ? open("gone", O_RDWR | O_CREAT, 0600) : memfd_create("nameless", 0);
    if (file < 0 || ftruncate(file, 4 * PAGE)) cannot("make a file");
    if (strcmp(arguments[2], "memfd")) unlink("gone");
    unsigned char content[PAGE], *own = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE, file, 0);
    if (own == MAP_FAILED) cannot("map it");
    for (int page = 0; page < 4; page++) {
        memset(content, 'a' + page, PAGE);
        if (pwrite(file, content, PAGE, page * PAGE) != PAGE) cannot("write to it");
    }
    *(volatile unsigned char *)(own + PAGE) = 'b'; /* what is there already: a copy of its own from now on */
    EXPECT_EQUAL("a page that was read only", own[2 * PAGE], 'c');
    ready(), wait_for_go(arguments[1]);
    for (int page = 0; page < 4; page++) {
        EXPECT_EQUAL("a page before", own[page * PAGE + 7], 'a' + page);
        memset(content, 'A' + page, PAGE);
        EXPECT_EQUAL("bytes written", pwrite(file, content, PAGE, page * PAGE), PAGE);
        EXPECT_EQUAL("a page afterwards", own[page * PAGE + 7], page == 1 ? 'b' : 'A' + page);
    }
    return finish();
}
