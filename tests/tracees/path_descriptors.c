/* Descriptors that lead to a path: inotify, named pipes, O_PATH; the case is named by the second argument. */
#include "tracee.h"

#include <poll.h>
#include <sys/file.h>
#include <sys/inotify.h>
#include <sys/socket.h>

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static void touch(const char *name) { close(open(name, O_CREAT | O_WRONLY, 0600)); }

/* The next event that is not of the go file, which other tests' hands touch. */
static void expect_notice(int notices, int watch, uint32_t mask, const char *name) {
    union {
        struct inotify_event event;
        char room[sizeof(struct inotify_event) + 256];
    } found;
    if (poll(&(struct pollfd){notices, POLLIN, 0}, 1, 5000) != 1 || read(notices, &found, *name ? 32 : 16) < 16) {
        differs("no notice %x of %d %s", mask, watch, name);
        return;
    }
    const char *told = found.event.len ? found.event.name : "";
    EXPECT(found.event.wd == watch && (found.event.mask & mask) == mask && !strcmp(told, name),
           "notice %x of watch %d '%s', not %x of %d '%s'", found.event.mask, found.event.wd, told, mask, watch, name);
}

static void expect_no_notice(int notices) {
    EXPECT(poll(&(struct pollfd){notices, POLLIN, 0}, 1, 0) == 0, "there is a notice already");
}

static void inotify_directories(void) {
    mkdir("one", 0700), mkdir("two", 0700), touch("one/file");
    int notices = inotify_init1(IN_CLOEXEC | IN_NONBLOCK);
    int one = inotify_add_watch(notices, "one", IN_CREATE | IN_DELETE), two = inotify_add_watch(notices, "two", IN_ALL_EVENTS);
    int file = inotify_add_watch(notices, "one/file", IN_OPEN | IN_ONESHOT);
    wait_here();
    expect_no_notice(notices);
    touch("one/new"), expect_notice(notices, one, IN_CREATE, "new");
    unlink("one/new"), expect_notice(notices, one, IN_DELETE, "new");
    rmdir("two"), expect_notice(notices, two, IN_DELETE_SELF, "");
    expect_notice(notices, two, IN_IGNORED, "");
    close(open("one/file", O_RDONLY)), expect_notice(notices, file, IN_OPEN, "");
    expect_notice(notices, file, IN_IGNORED, "");
    EXPECT_EQUAL("mark", fcntl(notices, F_GETFD), FD_CLOEXEC);
}

static void inotify_gaps(void) {
    int notices = inotify_init(), kept = -1;
    for (int round = 0; round < 2100; round++) {
        mkdir("some", 0700);
        kept = inotify_add_watch(notices, "some", IN_CREATE);
        if (round < 2099) inotify_rm_watch(notices, kept);
        char away[4096];
        if (round < 2099 && read(notices, away, sizeof away) < 16) cannot("read");
    }
    wait_here();
    expect_no_notice(notices);
    touch("some/new"), expect_notice(notices, kept, IN_CREATE, "new");
    EXPECT(inotify_add_watch(notices, ".", IN_CREATE) > kept, "numbers begin anew");
}

static void fifo_both(void) {
    mkfifo("pipe", 0640);
    int both = open("pipe", O_RDWR | O_NONBLOCK), reader = open("pipe", O_RDONLY), writer = open("pipe", O_WRONLY);
    if (both < 0 || write(writer, "what waits", 10) != 10) cannot("fill a named pipe");
    fcntl(both, 1031, 1 << 17);
    wait_here();
    char found[20] = "";
    EXPECT(read(reader, found, 20) == 10 && !strcmp(found, "what waits"), "found '%s'", found);
    EXPECT(read(both, found, 20) == -1 && errno == EAGAIN, "there is more");
    EXPECT(write(writer, "again", 5) == 5 && read(both, found, 20) == 5, "it is another pipe");
    EXPECT_EQUAL("capacity", fcntl(both, 1032), 1 << 17);
    EXPECT_EQUAL("flags", fcntl(reader, F_GETFL) & O_NONBLOCK, 0);
    int other = open("pipe", O_WRONLY | O_NONBLOCK);
    EXPECT(write(other, "name", 4) == 4 && read(reader, found, 20) == 4, "its name leads elsewhere");
}

static void pipe_of_packets(void) {
    int ends[2], once[2];
    char found[PAGE], *large = calloc(1, 3000);
    if (pipe2(ends, O_DIRECT | O_NONBLOCK) || pipe2(once, O_DIRECT)) cannot("make a pipe of packets");
    memset(large, 'x', 3000);
    if (write(ends[1], "ab", 2) != 2 || write(ends[1], large, 3000) != 3000 || write(ends[1], "c", 1) != 1) cannot("write packets");
    if (write(once[1], "alone", 5) != 5) cannot("write a packet");
    wait_here();
    EXPECT_EQUAL("flags", fcntl(ends[1], F_GETFL) & (O_DIRECT | O_NONBLOCK), O_DIRECT | O_NONBLOCK);
    EXPECT_EQUAL("first packet", read(ends[0], found, sizeof found), 2);
    EXPECT_EQUAL("a part of the second", read(ends[0], found, 10), 10);
    EXPECT_EQUAL("third packet", read(ends[0], found, sizeof found), 1);
    EXPECT(read(ends[0], found, sizeof found) == -1 && errno == EAGAIN, "there are more");
    EXPECT(write(once[1], "two", 3) == 3 && read(once[0], found, sizeof found) == 5, "two packets are one");
}

/* Standard input and error that lead to the program itself. */
static void own_streams(void) {
    int ends[2], pair[2];
    char found[20] = "";
    if (pipe(ends) || socketpair(AF_UNIX, SOCK_STREAM, 0, pair)) cannot("make a pipe");
    if (dup2(ends[0], 0) || dup2(pair[0], 2) != 2 || close(ends[0]) || close(pair[0])) cannot("replace the streams");
    if (write(ends[1], "to itself", 9) != 9 || write(2, "errors", 6) != 6) cannot("write");
    wait_here();
    EXPECT(read(0, found, 9) == 9 && !strcmp(found, "to itself"), "it reads '%s'", found);
    memset(found, 0, sizeof found);
    EXPECT(recv(pair[1], found, 19, MSG_DONTWAIT) == 6 && !strcmp(found, "errors"), "it hears '%s'", found);
    EXPECT(write(2, "more", 4) == 4 && recv(pair[1], found, 19, MSG_DONTWAIT) == 4, "it does not hear itself");
}

static void fifo_signals(void) {
    mkfifo("loud", 0600);
    int both = open("loud", O_RDWR);
    listen_for_signal();
    if (fcntl(both, F_SETOWN, getpid()) || fcntl(both, F_SETSIG, SIGUSR1) || fcntl(both, F_SETFL, O_ASYNC)) cannot("ask for signals");
    wait_here();
    EXPECT(!told && write(both, "x", 1) == 1 && told, "no signal, or one too early");
}

static void fifo_deleted(void) {
    struct stat before, after;
    mkfifo("doomed", 0640);
    int both = open("doomed", O_RDWR), reader = open("doomed", O_RDONLY | O_NONBLOCK), writer = open("doomed", O_WRONLY);
    if (both < 0 || write(writer, "what waits", 10) != 10 || unlink("doomed")) cannot("fill a named pipe");
    close(both);
    mkfifo("doomed", 0600);
    int lonely = open("doomed", O_RDONLY | O_NONBLOCK);
    unlink("doomed");
    fstat(reader, &before);
    wait_here();
    char found[20] = "";
    EXPECT(poll(&(struct pollfd){lonely, POLLIN, 0}, 1, 0) == 0, "the lonely reader was told of something");
    EXPECT(read(reader, found, 20) == 10 && !strcmp(found, "what waits"), "found '%s'", found);
    EXPECT(read(reader, found, 20) == -1 && errno == EAGAIN, "there is more");
    EXPECT(write(writer, "again", 5) == 5 && read(reader, found, 20) == 5, "it is another pipe");
    fstat(writer, &after);
    EXPECT(after.st_mode == before.st_mode && !after.st_nlink, "mode %o, %d names", after.st_mode, (int)after.st_nlink);
    close(writer);
    EXPECT(read(reader, found, 20) == 0, "somebody else writes to it");
    EXPECT(access("doomed", F_OK) != 0, "it has its name again");
}

static void inotify_deleted(void) {
    touch("doomed");
    int notices = inotify_init1(IN_NONBLOCK), file = open("doomed", O_RDWR);
    int watch = inotify_add_watch(notices, "doomed", IN_CLOSE_WRITE | IN_DELETE_SELF);
    unlink("doomed");
    wait_here();
    expect_no_notice(notices);
    close(file);
    expect_notice(notices, watch, IN_CLOSE_WRITE, ""), expect_notice(notices, watch, IN_DELETE_SELF, "");
}

/* A reader whom nobody has written to yet waits for a writer, and is not told that one hung up. */
static void fifo_reader(void) {
    mkfifo("pipe", 0640);
    int reader = open("pipe", O_RDONLY | O_NONBLOCK);
    wait_here();
    EXPECT(poll(&(struct pollfd){reader, POLLIN, 0}, 1, 0) == 0, "it was told of something");
    int writer = open("pipe", O_WRONLY | O_NONBLOCK);
    char found[20] = "";
    EXPECT(write(writer, "hello", 5) == 5 && read(reader, found, 20) == 5, "nothing comes: %s", strerror(errno));
    EXPECT_EQUAL("flags", fcntl(reader, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
}

static void fifo_gone(void) {
    mkfifo("pipe", 0640);
    int both = open("pipe", O_RDWR);
    if (write(both, "0123", 4) != 4) cannot("fill a named pipe");
    wait_here();
    char found[20] = "";
    EXPECT(read(both, found, 20) == 4, "it is empty");
}

/* An end that was opened again has flags of its own; what waits in the pipe is there once, and fills it as before. */
static void pipe_reopened(void) {
    int ends[2], count = 0;
    char path[40], found[4096];
    if (pipe(ends)) cannot("make a pipe");
    snprintf(path, sizeof path, "/proc/self/fd/%d", ends[0]);
    int reader = open(path, O_RDONLY | O_NONBLOCK);
    snprintf(path, sizeof path, "/proc/self/fd/%d", ends[1]);
    int writer = open(path, O_WRONLY | O_NONBLOCK);
    if (reader < 0 || writer < 0) cannot("open a pipe again");
    memset(found, 'x', sizeof found);
    while (write(writer, found, sizeof found) == sizeof found) count++;
    wait_here();
    EXPECT_EQUAL("flags of the reader", fcntl(ends[0], F_GETFL) & O_NONBLOCK, 0);
    EXPECT_EQUAL("flags of the writer", fcntl(ends[1], F_GETFL) & O_NONBLOCK, 0);
    EXPECT_EQUAL("flags of the second reader", fcntl(reader, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    EXPECT_EQUAL("flags of the second writer", fcntl(writer, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    EXPECT(write(writer, found, 1) == -1 && errno == EAGAIN, "it was full");
    while (read(reader, found, sizeof found) == sizeof found) count--;
    EXPECT_EQUAL("what waited", count, 0);
}

/* A file and a directory over which somebody mounts another file system as soon as we are ready. */
static void covered(void) {
    char found[8] = "";
    struct stat about;
    mkdir("place", 0700);
    int file = open("place/file", O_RDWR | O_CREAT | O_APPEND, 0600), folder = open("place", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (write(file, "content", 7) != 7 || lseek(file, 3, SEEK_SET) != 3) cannot("write");
    wait_here();
    EXPECT(read(file, found, 7) == 4 && !strcmp(found, "tent"), "it reads '%s'", found);
    EXPECT(write(file, "more", 4) == 4 && !fstat(file, &about) && about.st_size == 11, "its size is %ld", (long)about.st_size);
    EXPECT(fstatat(folder, "file", &about, 0) == 0 && about.st_size == 11, "its directory is another one");
    EXPECT_EQUAL("mark", fcntl(folder, F_GETFD), FD_CLOEXEC);
    EXPECT_EQUAL("flags", fcntl(file, F_GETFL) & O_APPEND, O_APPEND);
    EXPECT(access("place/file", F_OK) == -1, "it is not covered");
}

static void path_only(void) {
    mkfifo("pipe", 0600), touch("file"), mkdir("some", 0700);
    if (symlink("nowhere", "link")) cannot("make a link");
    int pipe = open("pipe", O_PATH), file = open("file", O_PATH | O_CLOEXEC), some = open("some", O_PATH | O_DIRECTORY);
    int link = open("link", O_PATH | O_NOFOLLOW), null = open("/dev/null", O_PATH);
    wait_here();
    struct stat about;
    char found[20] = "";
    EXPECT(fstat(pipe, &about) == 0 && S_ISFIFO(about.st_mode), "the pipe is none");
    EXPECT(fstat(file, &about) == 0 && S_ISREG(about.st_mode), "the file is none");
    EXPECT(fstat(some, &about) == 0 && S_ISDIR(about.st_mode), "the directory is none");
    EXPECT(readlinkat(link, "", found, 20) == 7 && !strcmp(found, "nowhere"), "the link leads to '%s'", found);
    EXPECT(fstat(null, &about) == 0 && S_ISCHR(about.st_mode), "the device is none");
    EXPECT(read(file, found, 1) == -1 && errno == EBADF, "it can be read");
    EXPECT_EQUAL("flags", fcntl(link, F_GETFL), O_PATH | O_NOFOLLOW);
    EXPECT_EQUAL("mark", fcntl(file, F_GETFD), FD_CLOEXEC);
    EXPECT(openat(some, "..", O_PATH) >= 0, "it is no directory");
}

/* Files of the kernel: read on from where it stood, of itself and of the machine. */
static void kernel_files(void) {
    int status = open("/proc/self/status", O_RDONLY), own = open("/proc/self", O_RDONLY | O_DIRECTORY);
    int memory = open("/proc/meminfo", O_RDONLY | O_CLOEXEC), cpus = open("/sys/devices/system/cpu/possible", O_RDONLY);
    char before[40] = "", found[40] = "", wanted[40];
    if (cpus < 0 || pread(cpus, before, 39, 0) < 1) cannot("read a file of /sys");
    if (read(status, found, 6) != 6 || read(memory, found, 5) != 5) cannot("read");
    wait_here();
    EXPECT(read(memory, found, 5) == 5 && !memcmp(found, "tal: ", 5), "meminfo goes on with '%s'", found);
    lseek(status, 0, SEEK_SET);
    static char text[4096];
    EXPECT(read(status, text, sizeof text - 1) > 100, "status cannot be read");
    snprintf(wanted, sizeof wanted, "\nPid:\t%d\n", getpid());
    EXPECT(strstr(text, wanted) != NULL, "status is another process's");
    EXPECT(faccessat(own, "maps", F_OK, 0) == 0, "the directory is another one");
    memset(found, 0, sizeof found);
    EXPECT(pread(cpus, found, 39, 0) > 0 && !strcmp(found, before), "processors: '%s'", found);
    EXPECT_EQUAL("mark", fcntl(memory, F_GETFD), FD_CLOEXEC);
}

/* Whether somebody else could take a lock: asked from a child. */
static int is_locked(const char *name, int kind, struct flock asked) {
    pid_t child = fork();
    if (child == 0) {
        int file = open(name, O_RDWR);
        if (kind == 0) _exit(flock(file, LOCK_EX | LOCK_NB) != 0);
        _exit(fcntl(file, F_SETLK, &asked) != 0);
    }
    int status;
    waitpid(child, &status, 0);
    return WEXITSTATUS(status);
}

static void file_locks(void) {
    struct flock part = {.l_type = F_WRLCK, .l_start = 100, .l_len = 10}, rest = {.l_type = F_RDLCK, .l_start = 200};
    struct flock all = {.l_type = F_WRLCK}, free_part = {.l_type = F_WRLCK, .l_start = 110, .l_len = 90};
    touch("whole"), touch("parts"), touch("open");
    int whole = open("whole", O_RDWR), parts = open("parts", O_RDWR), description = open("open", O_RDWR | O_CLOEXEC);
    chmod("whole", 0600), chmod("parts", 0600);
    if (flock(whole, LOCK_EX) || fcntl(parts, F_SETLK, &part) || fcntl(parts, F_SETLK, &rest)) cannot("lock");
    if (fcntl(description, F_OFD_SETLK, &part)) cannot("lock an open file");
    wait_here();
    EXPECT(is_locked("whole", 0, all), "flock is gone");
    EXPECT(is_locked("parts", 1, part), "the lock of a part is gone");
    EXPECT(is_locked("parts", 1, rest) == 0, "the shared lock is exclusive");
    rest.l_type = F_WRLCK;
    EXPECT(is_locked("parts", 1, rest), "the lock to the end is gone");
    EXPECT(is_locked("parts", 1, free_part) == 0, "more is locked than was");
    EXPECT(is_locked("open", 1, part), "the lock of an open file is gone");
    flock(whole, LOCK_UN);
    EXPECT(is_locked("whole", 0, all) == 0, "flock cannot be given back");
}

static volatile int broken;
static void note_break(int number) { broken += number; }

/* Opens a file elsewhere, which a lease holds back. */
static int is_held_back(const char *name, int flags) {
    int file = open(name, flags | O_NONBLOCK);
    if (file >= 0) close(file);
    return file < 0 && errno == EWOULDBLOCK;
}

static void leases(void) {
    signal(SIGIO, note_break), signal(SIGUSR2, note_break);
    touch("shared"), touch("alone"), touch("going"), touch("sinking");
    int shared = open("shared", O_RDONLY), alone = open("alone", O_RDWR), going = open("going", O_RDONLY);
    int sinking = open("sinking", O_WRONLY), none = open("shared", O_RDONLY);
    if (fcntl(shared, F_SETLEASE, F_RDLCK) || fcntl(alone, F_SETLEASE, F_WRLCK) || fcntl(going, F_SETLEASE, F_RDLCK) ||
        fcntl(sinking, F_SETLEASE, F_WRLCK) || fcntl(sinking, F_SETSIG, SIGUSR2))
        cannot("take leases");
    if (!is_held_back("going", O_WRONLY) || !is_held_back("sinking", O_RDONLY)) cannot("break leases");
    EXPECT_EQUAL("signals", broken, SIGIO + SIGUSR2);
    wait_here();
    EXPECT_EQUAL("signals", broken, SIGIO + SIGUSR2);
    EXPECT_EQUAL("shared", fcntl(shared, F_GETLEASE), F_RDLCK);
    EXPECT_EQUAL("none", fcntl(none, F_GETLEASE), F_UNLCK);
    EXPECT_EQUAL("alone", fcntl(alone, F_GETLEASE), F_WRLCK);
    EXPECT_EQUAL("going", fcntl(going, F_GETLEASE), F_UNLCK);
    EXPECT_EQUAL("sinking", fcntl(sinking, F_GETLEASE), F_RDLCK);
    EXPECT(is_held_back("alone", O_RDONLY), "nobody waits for the lease");
    EXPECT_EQUAL("signals", broken, SIGIO + SIGUSR2 + SIGIO);
    EXPECT_EQUAL("owner", fcntl(sinking, F_GETOWN), getpid());
    EXPECT(fcntl(sinking, F_SETLEASE, F_UNLCK) == 0 && !is_held_back("sinking", O_RDONLY), "it cannot be given up");
}

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
    } cases[] = {{"inotify_directories", inotify_directories}, {"inotify_gaps", inotify_gaps}, {"fifo_both", fifo_both},
                 {"fifo_reader", fifo_reader}, {"fifo_gone", fifo_gone},
                 {"leases", leases}, {"pipe_of_packets", pipe_of_packets}, {"own_streams", own_streams}, {"fifo_signals", fifo_signals}, {"fifo_deleted", fifo_deleted}, {"inotify_deleted", inotify_deleted},
                 {"pipe_reopened", pipe_reopened}, {"covered", covered},
                 {"path_only", path_only}, {"kernel_files", kernel_files}, {"file_locks", file_locks}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}
