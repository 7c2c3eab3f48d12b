/* Private pages of a file that a parent and its child have had in common since a fork: there once, until somebody writes. */
#include "tracee.h"

#include <sys/prctl.h>

#define COUNT 64
enum { BY_CHILD = 8, BY_PARENT = 16, COMMON = 24, GIVEN_BACK = 28, WRITTEN = 32 }; /* up to which page */
#define OF_FILE 7
#define OF_BOTH 11
#define OF_CHILD 13
#define OF_PARENT 17

static const char *go;
static unsigned char *shared, *replaced;

static unsigned char *mapped(const char *name, void *where) {
    static unsigned char content[COUNT * PAGE];
    int file = open(name, O_RDWR | O_CREAT | O_TRUNC, 0600);
    fill(content, sizeof content, OF_FILE);
    if (file < 0 || write(file, content, sizeof content) != (ssize_t)sizeof content) cannot("write %s", name);
    unsigned char *start = mmap(where, COUNT * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | (where ? MAP_FIXED : 0), file, 0);
    if (start == MAP_FAILED) cannot("map %s", name);
    close(file);
    return start;
}

static void fill_pages(unsigned char *start, int first, int last, uint64_t seed) {
    for (int page = first; page < last; page++) fill(start + page * PAGE, PAGE, seed + page * 512);
}

static void expect_pages(const char *what, const unsigned char *start, int first, int last, uint64_t seed) {
    for (int page = first; page < last; page++) expect_filled(what, start + page * PAGE, PAGE, seed + page * 512);
}

static uint64_t frame(pid_t pid, const unsigned char *address) { /* 0 where we are not told */
    char name[60];
    uint64_t entry = 0;
    snprintf(name, sizeof name, "/proc/%d/pagemap", pid);
    int file = open(name, O_RDONLY);
    if (file < 0 || pread(file, &entry, 8, (off_t)((uintptr_t)address / PAGE * 8)) != 8) differs("cannot read %s", name);
    if (file >= 0) close(file);
    return entry & ((1ULL << 55) - 1);
}

static int child(int word) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    fill_pages(shared, 0, BY_CHILD, OF_CHILD);
    madvise(shared + COMMON * PAGE, (GIVEN_BACK - COMMON) * PAGE, MADV_DONTNEED);
    mapped("other", replaced);
    fill_pages(replaced, 0, WRITTEN, OF_BOTH);
    write(word, "!", 1);
    wait_for_go(go);
    expect_pages("child's own", shared, 0, BY_CHILD, OF_CHILD);
    expect_pages("child's, of both", shared, BY_CHILD, COMMON, OF_BOTH);
    expect_pages("child's, given back", shared, COMMON, GIVEN_BACK, OF_FILE);
    expect_pages("child's, of both", shared, GIVEN_BACK, WRITTEN, OF_BOTH);
    expect_pages("child's, of the file", shared, WRITTEN, COUNT, OF_FILE);
    expect_pages("child's other file", replaced, 0, WRITTEN, OF_BOTH);
    int other = open("other", O_WRONLY); /* a page that was not written shows what is written to the file, of this file */
    pwrite(other, "new", 3, (COUNT - 1) * PAGE);
    EXPECT(!memcmp(replaced + (COUNT - 1) * PAGE, "new", 3), "it has another file mapped than the other one");
    fflush(stdout);
    write(word, "!", 1);
    while (is_told(go)) usleep(2000); /* until the parent has compared */
    _exit(differences);
}

int main(int count, char **words) {
    int ends[2], status;
    char word;
    go = words[1], (void)count;
    shared = mapped("one", NULL), replaced = mapped("two", NULL);
    fill_pages(shared, 0, WRITTEN, OF_BOTH), fill_pages(replaced, 0, WRITTEN, OF_BOTH);
    if (pipe(ends)) cannot("make a pipe");
    pid_t pid = fork();
    if (pid == 0) return child(ends[1]);
    fill_pages(shared, BY_CHILD, BY_PARENT, OF_PARENT);
    if (read(ends[0], &word, 1) != 1) cannot("hear of the child");
    ready();
    wait_for_go(go);
    expect_pages("of both", shared, 0, BY_CHILD, OF_BOTH), expect_pages("parent's own", shared, BY_CHILD, BY_PARENT, OF_PARENT);
    expect_pages("of both", shared, BY_PARENT, WRITTEN, OF_BOTH), expect_pages("of the file", shared, WRITTEN, COUNT, OF_FILE);
    expect_pages("parent's other file", replaced, 0, WRITTEN, OF_BOTH);
    if (read(ends[0], &word, 1) != 1) differs("the child has ended");
    for (int page = BY_PARENT; page < COMMON; page++)
        EXPECT_EQUAL("frame of the child", frame(pid, shared + page * PAGE), frame(getpid(), shared + page * PAGE));
    unlink(go);
    EXPECT(waitpid(pid, &status, 0) == pid && status == 0, "the child found something: %x", status);
    return finish();
}
