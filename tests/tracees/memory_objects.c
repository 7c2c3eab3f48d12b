/* Shared memory with a descriptor or without, with a name or without; the case is named by the second argument. */
#include "tracee.h"

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static void *map_shared(int file, size_t size, int protection) {
    void *place = mmap(NULL, size, protection, MAP_SHARED, file, 0);
    if (place == MAP_FAILED) cannot("map");
    return place;
}

static int memory_file(const char *name, size_t size, unsigned flags) {
    int file = memfd_create(name, flags);
    if (file < 0 || ftruncate(file, size)) cannot("make a memory file");
    return file;
}

/* Two open files of one, sparse, with an offset each. */
/* Nobody has it open to write as the kernel counts that, so it can be executed. */
static void memfd_executed(void) {
    int file = memory_file("script", 11, 0), status = -1;
    if (write(file, "#!/bin/true", 11) != 11) cannot("write");
    wait_here();
    if (fork() == 0) {
        syscall(SYS_execveat, file, "", (char *[]){"true", NULL}, (char *[]){NULL}, AT_EMPTY_PATH);
        _exit(errno);
    }
    wait(&status);
    EXPECT(WIFEXITED(status) && WEXITSTATUS(status) == 0, "it cannot be executed: %s", strerror(WEXITSTATUS(status)));
}

static void memfd_content(void) {
    static char page[PAGE], found[PAGE];
    int file = memory_file("scratch", 1000 * PAGE + 123, MFD_CLOEXEC), twin = dup(file), reader;
    char path[40], target[80] = "";
    snprintf(path, sizeof path, "/proc/self/fd/%d", file);
    reader = open(path, O_RDONLY);
    fill(page, PAGE, 1);
    if (pwrite(file, page, PAGE, 0) != PAGE || pwrite(file, page, PAGE, 700 * PAGE) != PAGE) cannot("write");
    if (pwrite(file, "end", 3, 1000 * PAGE + 120) != 3) cannot("write");
    fchmod(file, 0640), lseek(file, 77, SEEK_SET), lseek(reader, 5, SEEK_SET);
    wait_here();
    struct stat about;
    fstat(reader, &about);
    EXPECT_EQUAL("size", about.st_size, 1000 * PAGE + 123);
    EXPECT_EQUAL("mode", about.st_mode & 07777, 0640);
    EXPECT(about.st_blocks < 100, "it is not sparse any more: %ld blocks", (long)about.st_blocks);
    EXPECT_EQUAL("offset", lseek(twin, 0, SEEK_CUR), 77);
    EXPECT_EQUAL("offset", lseek(reader, 0, SEEK_CUR), 5);
    EXPECT(pread(reader, found, PAGE, 0) == PAGE, "short"); expect_filled("first", found, PAGE, 1);
    EXPECT(pread(reader, found, PAGE, 700 * PAGE) == PAGE, "short"); expect_filled("late", found, PAGE, 1);
    EXPECT(pread(reader, found, 10, 1000 * PAGE + 120) == 3 && !memcmp(found, "end", 3), "the end is lost");
    EXPECT(pread(reader, found, PAGE, 300 * PAGE) == PAGE, "short"); expect_zero("hole", found, PAGE);
    if (pwrite(file, "shared", 6, 0) != 6) differs("cannot write");
    EXPECT(pread(reader, found, 6, 0) == 6 && !memcmp(found, "shared", 6), "they are two files");
    EXPECT(write(reader, "x", 1) == -1 && errno == EBADF, "the reader writes");
    EXPECT(readlink(path, target, 79) > 0 && !strcmp(target, "/memfd:scratch (deleted)"), "its name is %s", target);
    EXPECT_EQUAL("mark", fcntl(file, F_GETFD), FD_CLOEXEC);
}

static void memfd_sealed(void) {
    char found[10] = "";
    int whole = memory_file("whole", 0, MFD_ALLOW_SEALING), open_end = memory_file("open end", PAGE, MFD_ALLOW_SEALING);
    if (write(whole, "content", 7) != 7) cannot("write");
    if (fcntl(whole, F_ADD_SEALS, F_SEAL_SEAL | F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_WRITE)) cannot("seal");
    if (fcntl(open_end, F_ADD_SEALS, F_SEAL_SHRINK)) cannot("seal");
    wait_here();
    EXPECT_EQUAL("seals", fcntl(whole, F_GET_SEALS), F_SEAL_SEAL | F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_WRITE);
    EXPECT_EQUAL("seals", fcntl(open_end, F_GET_SEALS), F_SEAL_SHRINK);
    EXPECT(pread(whole, found, 10, 0) == 7 && !strcmp(found, "content"), "content: '%s'", found);
    EXPECT(pwrite(whole, "x", 1, 0) == -1 && errno == EPERM, "it can be written to");
    EXPECT(ftruncate(open_end, 0) == -1 && ftruncate(open_end, 2 * PAGE) == 0, "it is sealed otherwise");
}

/* Written by write(2), mapped twice, and only partly touched; and one of which only the mapping is left. */
static void memfd_mapped(void) {
    static char page[PAGE];
    int file = memory_file("mapped", 50 * PAGE, 0), lost = memory_file("lost", 20 * PAGE, 0);
    for (int index = 0; index < 20; index++) {
        fill(page, PAGE, index * 1000);
        if (pwrite(file, page, PAGE, index * PAGE) != PAGE || pwrite(lost, page, PAGE, index * PAGE) != PAGE) cannot("write");
    }
    char *first = map_shared(file, 50 * PAGE, PROT_READ | PROT_WRITE), *second = map_shared(file, 30 * PAGE, PROT_READ);
    char *alone = map_shared(lost, 20 * PAGE, PROT_READ | PROT_WRITE);
    close(lost);
    fill(first + 40 * PAGE, PAGE, 77);
    wait_here();
    for (int index = 0; index < 20; index++) {
        expect_filled("first", first + index * PAGE, PAGE, index * 1000);
        expect_filled("second", second + index * PAGE, PAGE, index * 1000);
        expect_filled("alone", alone + index * PAGE, PAGE, index * 1000);
    }
    expect_filled("touched", first + 40 * PAGE, PAGE, 77);
    expect_zero("hole", first + 30 * PAGE, PAGE);
    strcpy(first, "by the first mapping");
    EXPECT(!strcmp(second, "by the first mapping"), "the mappings are of two files");
    EXPECT(pread(file, page, 21, 0) == 21 && !strcmp(page, "by the first mapping"), "descriptor and mapping are of two files");
}

static char *shared_memory(const char *name, size_t size, int flags) {
    int file = open(name, O_RDWR | O_CREAT | flags, 0640);
    if (file < 0 || ftruncate(file, size)) cannot("make %s", name);
    char *place = map_shared(file, size, PROT_READ | PROT_WRITE);
    close(file);
    return place;
}

static void posix_named(void) {
    char name[60];
    snprintf(name, sizeof name, "/dev/shm/failover-tracee-%d", getpid());
    char *place = shared_memory(name, 40 * PAGE, O_EXCL);
    fill(place, 10 * PAGE, 5), fill(place + 20 * PAGE, PAGE, 6);
    int file = open(name, O_RDWR);
    puts(name);
    wait_here();
    expect_filled("begin", place, 10 * PAGE, 5), expect_filled("late", place + 20 * PAGE, PAGE, 6);
    expect_zero("hole", place + 11 * PAGE, PAGE);
    strcpy(place, "changed");
    char found[10] = "";
    EXPECT(pread(file, found, 8, 0) == 8 && !strcmp(found, "changed"), "descriptor and mapping are of two files");
    close(file), file = open(name, O_RDONLY);
    EXPECT(pread(file, found, 8, 0) == 8 && !strcmp(found, "changed"), "the name leads to another file");
    struct stat about;
    EXPECT(fstat(file, &about) == 0 && about.st_size == (long)(40 * PAGE) && (about.st_mode & 0777) == 0640, "size %ld mode %o",
           (long)about.st_size, about.st_mode);
    unlink(name);
}

static void posix_unlinked(void) {
    char name[60];
    snprintf(name, sizeof name, "/dev/shm/failover-tracee-%d", getpid());
    char *place = shared_memory(name, 12 * PAGE, O_EXCL);
    unlink(name);
    int file = open(name, O_RDWR | O_CREAT | O_EXCL, 0600);
    EXPECT(pwrite(file, "by the file", 12, 0) == 12 && ftruncate(file, 2 * PAGE) == 0, "cannot write %s", name);
    char *other = map_shared(file, 2 * PAGE, PROT_READ | PROT_WRITE);
    close(file), unlink(name);
    fill(place, 10 * PAGE, 9);
    wait_here();
    expect_filled("content", place, 10 * PAGE, 9), expect_zero("rest", place + 10 * PAGE, 2 * PAGE);
    EXPECT(!strcmp(other, "by the file"), "what was never touched by its mapping is lost");
    EXPECT(access(name, F_OK) != 0, "it has a name again");
}

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
    } cases[] = {{"memfd_executed", memfd_executed}, {"memfd_content", memfd_content}, {"memfd_sealed", memfd_sealed}, {"memfd_mapped", memfd_mapped},
                 {"posix_named", posix_named}, {"posix_unlinked", posix_unlinked}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}
