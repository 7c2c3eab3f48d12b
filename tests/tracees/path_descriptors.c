/* Descriptors that lead to a path: inotify, named pipes, O_PATH; the case is named by the second argument. */
#include "tracee.h"

#include <poll.h>
#include <sys/inotify.h>

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

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
    } cases[] = {{"inotify_directories", inotify_directories}, {"inotify_gaps", inotify_gaps}, {"fifo_both", fifo_both},
                 {"fifo_reader", fifo_reader}, {"fifo_gone", fifo_gone}, {"path_only", path_only}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}
