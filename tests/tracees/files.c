/* Open files of one kind, named by the second argument: number, offset, flags, sharing and content. */
#include "tracee.h"

#include <dirent.h>
#include <sys/xattr.h>

#define TEXT "0123456789abcdefghijklmnopqrstuvwxyz\n"

static int make(const char *name, int flags) {
    int file = open(name, O_RDWR | O_CREAT | O_TRUNC, 0640);
    if (file < 0 || write(file, TEXT, 37) != 37) cannot("make %s", name);
    close(file);
    file = open(name, flags);
    if (file < 0) cannot("open %s", name);
    return file;
}

static void expect_read(int file, const char *wanted) {
    char found[40] = "";
    int size = read(file, found, strlen(wanted));
    EXPECT(size == (int)strlen(wanted) && !memcmp(found, wanted, size), "fd %d: read %d bytes '%s', not '%s'", file, size,
           found, wanted);
}

static void expect_flags(int file, int status, int descriptor) {
    EXPECT_EQUAL("status flags", fcntl(file, F_GETFL), status);
    EXPECT_EQUAL("descriptor flags", fcntl(file, F_GETFD), descriptor);
}

static void read_offset(const char *go) {
    int file = make("in", O_RDONLY), status = fcntl(file, F_GETFL);
    lseek(file, 7, SEEK_SET);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("offset", lseek(file, 0, SEEK_CUR), 7);
    expect_read(file, "789ab");
    expect_flags(file, status, 0);
}

static void write_offset(const char *go) {
    int file = make("out", O_WRONLY), status = fcntl(file, F_GETFL);
    lseek(file, 3, SEEK_SET);
    ready(), wait_for_go(go);
    if (write(file, "XYZ", 3) != 3) differs("cannot write: %s", strerror(errno));
    expect_flags(file, status, 0);
    file = open("out", O_RDONLY);
    expect_read(file, "012XYZ678");
}

static void append(const char *go) {
    int file = make("log", O_WRONLY | O_APPEND), status = fcntl(file, F_GETFL);
    ready(), wait_for_go(go);
    lseek(file, 0, SEEK_SET);
    if (write(file, "end", 3) != 3) differs("cannot append: %s", strerror(errno));
    expect_flags(file, status, 0);
    file = open("log", O_RDONLY);
    expect_read(file, TEXT "end");
}

static void odd_flags(const char *go) {
    int file = make("odd", O_RDWR | O_NONBLOCK | O_SYNC | O_NOATIME | O_CLOEXEC), status = fcntl(file, F_GETFL);
    ready(), wait_for_go(go);
    expect_flags(file, status, FD_CLOEXEC);
}

static void shared_offset(const char *go) {
    int file = make("in", O_RDONLY), twin = dup(file), other = open("in", O_RDONLY), far = dup2(file, 700);
    lseek(file, 5, SEEK_SET), lseek(other, 20, SEEK_SET);
    ready(), wait_for_go(go);
    expect_read(file, "56"), expect_read(twin, "78"), expect_read(far, "9a");
    expect_read(other, "kl");
}

static void holes(const char *go) {
    int first = make("a", O_RDONLY), second = make("b", O_RDONLY), third = make("c", O_RDONLY);
    dup3(second, 200, O_CLOEXEC), dup2(third, 1000);
    close(first), close(second);
    int open_before = 0, open_after = 0;
    for (int file = 0; file < 1100; file++) open_before += fcntl(file, F_GETFD) != -1;
    ready(), wait_for_go(go);
    for (int file = 0; file < 1100; file++) open_after += fcntl(file, F_GETFD) != -1;
    EXPECT_EQUAL("open descriptors", open_after, open_before);
    EXPECT(fcntl(first, F_GETFD) == -1 && fcntl(second, F_GETFD) == -1, "a hole is filled");
    EXPECT_EQUAL("flags of 200", fcntl(200, F_GETFD), FD_CLOEXEC);
    EXPECT_EQUAL("flags of 1000", fcntl(1000, F_GETFD), 0);
    EXPECT_EQUAL("the next free number", dup(0), first);
}

static void deleted(const char *go) {
    int file = make("doomed", O_RDWR), twin = dup(file), hollow = open("hollow", O_RDWR | O_CREAT, 0600);
    struct stat before, changed, after;
    unlink("doomed"), unlink("hollow");
    if (fchown(file, 1234, 5678) && geteuid() == 0) cannot("give a file away");
    if (fchmod(file, 04751) || pwrite(hollow, "in the middle", 13, 64 * PAGE) != 13 || ftruncate(hollow, 128 * PAGE)) cannot("write");
    int nameless = open(".", O_TMPFILE | O_RDWR, 0640);
    if (nameless < 0 || write(nameless, "born so", 7) != 7) cannot("make a file without a name");
    int has_attributes = !fsetxattr(file, "user.colour", "red", 3, 0);
    lseek(file, 10, SEEK_SET);
    fstat(file, &before);
    ready(), wait_for_go(go);
    fstat(file, &changed);
    char path[40], colour[8] = "";
    EXPECT(!has_attributes || (fgetxattr(file, "user.colour", colour, 7) == 3 && !strcmp(colour, "red")), "its attribute is '%s'", colour);
    snprintf(path, sizeof path, "/proc/self/fd/%d", nameless), unlink("named");
    EXPECT(!linkat(AT_FDCWD, path, AT_FDCWD, "named", AT_SYMLINK_FOLLOW), "it can be given no name: %s", strerror(errno));
    expect_read(open("named", O_RDONLY), "born so"), unlink("named");
    expect_read(file, "abc"), expect_read(twin, "def");
    if (pwrite(file, "ZZ", 2, 0) != 2) differs("cannot write: %s", strerror(errno));
    lseek(file, 0, SEEK_SET);
    expect_read(file, "ZZ2345");
    fstat(file, &after);
    EXPECT_EQUAL("time of change", changed.st_mtim.tv_nsec, before.st_mtim.tv_nsec);
    EXPECT_EQUAL("size", after.st_size, before.st_size);
    EXPECT_EQUAL("names", after.st_nlink, 0);
    EXPECT(after.st_uid == before.st_uid && after.st_gid == before.st_gid, "it belongs to %d:%d", after.st_uid, after.st_gid);
    EXPECT_EQUAL("first byte that is no hole", lseek(hollow, 0, SEEK_DATA), 64 * (long)PAGE);
    EXPECT_EQUAL("end of what is no hole", lseek(hollow, 64 * PAGE, SEEK_HOLE), 65 * (long)PAGE);
    EXPECT_EQUAL("size", lseek(hollow, 0, SEEK_END), 128 * (long)PAGE);
    lseek(hollow, 64 * PAGE, SEEK_SET), expect_read(hollow, "in the middle");
    EXPECT_EQUAL("mode", after.st_mode, before.st_mode);
    EXPECT(access("doomed", F_OK) != 0, "the file has a name again");
}

static void deleted_read_only(const char *go) {
    int file = make("doomed", O_RDONLY), status = fcntl(file, F_GETFL);
    unlink("doomed");
    ready(), wait_for_go(go);
    expect_read(file, "012");
    expect_flags(file, status, 0);
    EXPECT(write(file, "x", 1) == -1 && errno == EBADF, "a read-only descriptor takes writes");
}

static void deleted_sparse(const char *go) {
    int files[3];
    struct stat before, after;
    for (int index = 0; index < 3; index++) {
        files[index] = make("doomed", O_RDWR), unlink("doomed");
        if (pwrite(files[index], "far away", 8, (1L << 30) + index) != 8) cannot("write");
    }
    fstat(files[1], &before);
    int again = open("/proc/self/fd/3", O_RDONLY);
    if (again < 0) cannot("open a deleted file again");
    ready(), wait_for_go(go);
    fstat(files[1], &after);
    EXPECT_EQUAL("size", after.st_size, before.st_size);
    EXPECT_EQUAL("blocks", after.st_blocks, before.st_blocks);
    for (int index = 0; index < 3; index++) {
        lseek(files[index], (1L << 30) + index, SEEK_SET);
        expect_read(files[index], "far away");
        EXPECT(pwrite(files[index], "x", 1, 0) == 1, "cannot write");
    }
    expect_read(again, "x123");
}

static void deleted_with_a_link(const char *go) {
    int file = make("doomed", O_RDWR), read_only = open("doomed", O_RDONLY), deep;
    struct stat before, after;
    if (link("doomed", "kept") || unlink("doomed")) cannot("link");
    mkdir("deep", 0700), deep = make("deep/doomed", O_RDWR);
    if (link("deep/doomed", "high") || unlink("deep/doomed") || rmdir("deep")) cannot("link");
    lseek(file, 10, SEEK_SET);
    fstat(file, &before);
    ready(), wait_for_go(go);
    fstat(file, &after);
    EXPECT(after.st_ino == before.st_ino && after.st_nlink == before.st_nlink, "it is another file");
    expect_read(file, "abc"), expect_read(read_only, "012"), expect_read(deep, "012");
    int kept = open("kept", O_RDONLY);
    if (pwrite(file, "ZZ", 2, 0) != 2) differs("cannot write: %s", strerror(errno));
    expect_read(kept, "ZZ2345");
    EXPECT(access("doomed", F_OK) != 0, "the file has its name again");
}

static void deleted_directory(const char *go) {
    int top = open(".", O_RDONLY | O_DIRECTORY), here, other;
    struct stat about, working;
    char before[4096] = "", after[4096] = "";
    if (mkdir("gone", 0750) || mkdir("gone/other", 0700) || chdir("gone")) cannot("make directories");
    here = open(".", O_RDONLY | O_DIRECTORY), other = open("other", O_RDONLY | O_DIRECTORY);
    if (rmdir("other") || rmdir("../gone")) cannot("delete the working directory");
    if (readlink("/proc/self/cwd", before, sizeof before) < 0) cannot("read a link");
    ready();
    while (faccessat(top, go, F_OK, 0)) usleep(2000);
    if (readlink("/proc/self/cwd", after, sizeof after) < 0 || strcmp(before, after)) differs("works in %s, not in %s", after, before);
    EXPECT(!fstat(other, &about) && S_ISDIR(about.st_mode) && !about.st_nlink, "the other one is not a deleted directory");
    EXPECT(!fstat(here, &about) && S_ISDIR(about.st_mode) && !about.st_nlink, "it is not deleted");
    EXPECT_EQUAL("mode", about.st_mode & 07777, 0750);
    EXPECT(!stat(".", &working) && working.st_ino == about.st_ino, "it works in another directory than the one that is open");
    EXPECT(openat(here, "new", O_CREAT | O_WRONLY, 0600) == -1 && errno == ENOENT, "files can be made there");
    EXPECT(fchdir(top) == 0 && access("gone", F_OK), "the directory has its name again");
}

/* As the other, but nothing is open there. */
static void deleted_working_directory(const char *go) {
    char before[4096] = "", after[4096] = "";
    int top = open(".", O_RDONLY | O_DIRECTORY);
    if (mkdir("gone", 0700) || chdir("gone") || rmdir("../gone")) cannot("delete the working directory");
    if (readlink("/proc/self/cwd", before, sizeof before) < 0) cannot("read a link");
    ready();
    while (faccessat(top, go, F_OK, 0)) usleep(2000);
    if (readlink("/proc/self/cwd", after, sizeof after) < 0 || strcmp(before, after)) differs("works in %s, not in %s", after, before);
    EXPECT(fchdir(top) == 0 && access("gone", F_OK), "the directory has its name again");
}

static void deleted_link(const char *go) {
    char target[20] = "";
    struct stat about;
    if (symlink("somewhere/else", "link")) cannot("make a link");
    int link = open("link", O_PATH | O_NOFOLLOW);
    if (link < 0 || unlink("link")) cannot("open a link");
    ready(), wait_for_go(go);
    EXPECT(readlinkat(link, "", target, 19) == 14 && !strcmp(target, "somewhere/else"), "it leads to '%s'", target);
    EXPECT(!fstat(link, &about) && S_ISLNK(about.st_mode) && !about.st_nlink, "it is not a deleted link");
}

/* Shared memory without a file, opened through the kernel's view of mappings, which is another one by now. */
static void mapped_memory(const char *go) {
    char path[64];
    char *place = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    snprintf(path, sizeof path, "/proc/self/map_files/%lx-%lx", (long)place, (long)place + 4 * PAGE);
    strcpy(place + PAGE, "hello");
    int file = open(path, O_RDWR);
    if (file < 0) cannot("open a mapping");
    munmap(place, 4 * PAGE);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("size", lseek(file, 0, SEEK_END), 4 * PAGE);
    lseek(file, PAGE, SEEK_SET), expect_read(file, "hello");
    place = mmap(NULL, 4 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    EXPECT(place != MAP_FAILED && !strcmp(place + PAGE, "hello"), "it cannot be mapped");
}

static void deleted_device(const char *go) {
    struct stat before, after;
    if (mknod("null", S_IFCHR | 0640, 0x103)) cannot("make a device");
    int file = open("null", O_RDWR);
    if (file < 0 || unlink("null")) cannot("open a device");
    fstat(file, &before);
    ready(), wait_for_go(go);
    fstat(file, &after);
    EXPECT_EQUAL("mode", after.st_mode, before.st_mode);
    EXPECT_EQUAL("device", after.st_rdev, before.st_rdev);
    EXPECT_EQUAL("names", after.st_nlink, 0);
    EXPECT(write(file, "x", 1) == 1, "nothing can be written");
}

/* Its directory is gone, too. */
static void deleted_place(const char *go) {
    mkdir("place", 0700);
    int file = make("place/doomed", O_RDWR);
    if (unlink("place/doomed") || rmdir("place")) cannot("delete the directory");
    lseek(file, 5, SEEK_SET);
    ready(), wait_for_go(go);
    expect_read(file, "567");
    EXPECT(write(file, "x", 1) == 1 && access("place", F_OK), "the directory is there again, or nothing can be written");
}

static void devices(const char *go) {
    static const char *const paths[] = {"/dev/null", "/dev/zero", "/dev/full", "/dev/urandom", "/dev/random"};
    int files[5];
    char byte;
    for (int index = 0; index < 5; index++)
        if ((files[index] = open(paths[index], index == 4 ? O_RDONLY : O_RDWR)) < 0) cannot("open %s", paths[index]);
    ready(), wait_for_go(go);
    EXPECT(read(files[0], &byte, 1) == 0 && write(files[0], "x", 1) == 1, "/dev/null is something else");
    EXPECT(read(files[1], &byte, 1) == 1 && byte == 0, "/dev/zero is something else");
    EXPECT(write(files[2], "x", 1) == -1 && errno == ENOSPC, "/dev/full is something else");
    uint64_t random[2] = {0, 0};
    EXPECT(read(files[3], random, 16) == 16 && random[0] != random[1], "/dev/urandom is something else");
    EXPECT(read(files[4], random, 8) == 8, "/dev/random is something else");
}

static void directory(const char *go) {
    mkdir("some", 0700);
    char name[40];
    for (int index = 0; index < 9; index++) {
        snprintf(name, sizeof name, "some/%d", index);
        close(open(name, O_CREAT | O_WRONLY, 0600));
    }
    int file = open("some", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    ready(), wait_for_go(go);
    EXPECT(faccessat(file, "3", F_OK, 0) == 0, "the directory is another one");
    DIR *entries = fdopendir(file);
    int seen = 0;
    while (entries && readdir(entries)) seen++;
    EXPECT_EQUAL("entries", seen, 11);
}

static void directory_at_its_end(const char *go) {
    DIR *entries = opendir(".");
    int before = 0, after = 0;
    while (entries && readdir(entries)) before++;
    ready(), wait_for_go(go);
    EXPECT(!readdir(entries), "there is more in a directory that was read to its end");
    rewinddir(entries);
    while (readdir(entries)) after++;
    EXPECT_EQUAL("entries", after, before + 1); /* the go file */
}

static void path_only(const char *go) {
    close(make("target", O_RDONLY));
    int file = open("target", O_PATH), status = fcntl(file, F_GETFL);
    ready(), wait_for_go(go);
    char path[40];
    expect_flags(file, status, 0);
    snprintf(path, sizeof path, "/proc/self/fd/%d", file);
    expect_read(open(path, O_RDONLY), "0123");
}

static void beyond_end(const char *go) {
    int file = make("beyond", O_RDWR);
    lseek(file, 100000, SEEK_SET);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("offset", lseek(file, 0, SEEK_CUR), 100000);
    struct stat about;
    fstat(file, &about);
    EXPECT_EQUAL("size", about.st_size, 37);
    if (write(file, "x", 1) != 1) differs("cannot write");
    fstat(file, &about);
    EXPECT_EQUAL("size after the write", about.st_size, 100001);
}

static void memory_file(const char *go) {
    int file = memfd_create("scratch", MFD_CLOEXEC);
    if (file < 0 || write(file, TEXT, 37) != 37) cannot("make a memory file");
    lseek(file, 4, SEEK_SET);
    ready(), wait_for_go(go);
    expect_read(file, "4567");
}

static void odd_name(const char *go) {
    int file = make("with space\nand line (deleted)", O_RDONLY);
    lseek(file, 2, SEEK_SET);
    ready(), wait_for_go(go);
    expect_read(file, "234");
}

static void owner_signal(const char *go) {
    int file = make("owned", O_RDONLY);
    fcntl(file, F_SETOWN, getpid());
    fcntl(file, F_SETSIG, SIGUSR2);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("owner", fcntl(file, F_GETOWN), getpid());
    EXPECT_EQUAL("signal", fcntl(file, F_GETSIG), SIGUSR2);
}

static void owner_thread(const char *go) {
    int file = make("owned", O_RDONLY);
    struct f_owner_ex owner = {F_OWNER_TID, gettid()};
    fcntl(file, F_SETOWN_EX, &owner);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("asked", fcntl(file, F_GETOWN_EX, &owner), 0);
    EXPECT_EQUAL("kind of owner", owner.type, F_OWNER_TID);
    EXPECT_EQUAL("owner", owner.pid, gettid());
}

static void mapped_and_closed(const char *go) {
    int file = make("counters", O_RDWR);
    if (ftruncate(file, 2 * PAGE)) cannot("size a file");
    unsigned char *counters = mmap(NULL, 2 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (counters == MAP_FAILED) cannot("map a file");
    close(file);
    fill(counters, 2 * PAGE, 7);
    ready(), wait_for_go(go);
    expect_filled("what is mapped", counters, 2 * PAGE, 7);
}

static void asynchronous(const char *go) {
    int channel[2];
    struct sigaction action = {.sa_handler = hear};
    sigaction(SIGUSR2, &action, NULL);
    if (pipe(channel)) cannot("make a pipe");
    fcntl(channel[0], F_SETOWN, getpid());
    fcntl(channel[0], F_SETSIG, SIGUSR2);
    fcntl(channel[0], F_SETFL, O_ASYNC | O_NONBLOCK);
    ready(), wait_for_go(go);
    EXPECT_EQUAL("flags", fcntl(channel[0], F_GETFL), O_ASYNC | O_NONBLOCK);
    EXPECT_EQUAL("written", write(channel[1], "x", 1), 1);
    EXPECT(told, "no signal came with what was written");
}

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(const char *go);
    } kinds[] = {{"read_offset", read_offset}, {"write_offset", write_offset}, {"append", append},
                 {"odd_flags", odd_flags},     {"shared_offset", shared_offset}, {"holes", holes},
                 {"deleted", deleted},         {"deleted_read_only", deleted_read_only}, {"devices", devices},
                 {"deleted_sparse", deleted_sparse}, {"deleted_with_a_link", deleted_with_a_link},
                 {"deleted_directory", deleted_directory}, {"deleted_working_directory", deleted_working_directory},
                 {"deleted_device", deleted_device}, {"deleted_place", deleted_place},
                 {"deleted_link", deleted_link}, {"mapped_memory", mapped_memory},
                 {"directory", directory},     {"directory_at_its_end", directory_at_its_end}, {"path_only", path_only}, {"beyond_end", beyond_end},
                 {"memory_file", memory_file}, {"odd_name", odd_name}, {"owner_signal", owner_signal},
                 {"owner_thread", owner_thread}, {"asynchronous", asynchronous},
                 {"mapped_and_closed", mapped_and_closed}};
    for (size_t index = 0; index < sizeof kinds / sizeof *kinds; index++)
        if (count > 2 && !strcmp(arguments[2], kinds[index].name)) {
            kinds[index].act(arguments[1]);
            return finish();
        }
    cannot("find the kind");
}
