/* A root directory of its own (chroot); the case is named by the second argument. */
#include "tracee.h"

#include <grp.h>
#include <poll.h>
#include <sys/inotify.h>
#include <sys/socket.h>
#include <sys/un.h>

static const char *go;
static int outside = -1; /* the directory that the go file comes to */
static struct stat root;

static void enter(const char *work) {
    outside = open(".", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (mkdir("cage", 0755) && errno != EEXIST) cannot("make a directory");
    if (mkdir("cage/work", 0777) && errno != EEXIST) cannot("make a directory");
    chmod("cage/work", 0777);
    if (chroot("cage")) cannot("change the root directory");
    if (work && chdir(work)) cannot("enter %s", work);
    stat("/", &root);
}

static void wait_here(void) {
    ready();
    while (faccessat(outside, go, F_OK, 0)) {
        struct timespec nap = {0, 2000000};
        nanosleep(&nap, NULL);
    }
    struct stat now;
    EXPECT(!stat("/", &now) && now.st_ino == root.st_ino && now.st_dev == root.st_dev, "it has another root directory");
    EXPECT(access("/proc/self", F_OK) && errno == ENOENT, "it sees the machine's files");
}

static int made(const char *path, const char *content) {
    int file = open(path, O_RDWR | O_CREAT | O_TRUNC, 0644);
    if (file < 0 || write(file, content, strlen(content)) != (ssize_t)strlen(content)) cannot("write %s", path);
    return file;
}

static void expect_content(int file, const char *wanted) {
    char found[40] = "";
    EXPECT(pread(file, found, sizeof found - 1, 0) == (ssize_t)strlen(wanted) && !strcmp(found, wanted), "it reads '%s'", found);
}

static void inside(void) { /* what it opens, maps and works in lies below its root */
    enter("/work");
    int file = made("/work/own", "within the cage"), own = open("/work/own", O_RDONLY);
    mkfifo("/work/pipe", 0600);
    int pipe = open("/work/pipe", O_RDWR), folder = open("/", O_RDONLY | O_DIRECTORY);
    char *mapped = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (pipe < 0 || write(pipe, "waits", 5) != 5 || mapped == MAP_FAILED) cannot("set the stage");
    wait_here();
    char found[8] = "", where[100] = "";
    EXPECT(getcwd(where, sizeof where) && !strcmp(where, "/work"), "it works in %s", where);
    expect_content(own, "within the cage"), expect_content(open("/work/own", O_RDONLY), "within the cage");
    EXPECT(read(pipe, found, 8) == 5 && !strcmp(found, "waits"), "the pipe holds '%s'", found);
    struct stat now;
    EXPECT(!fstat(folder, &now) && now.st_ino == root.st_ino, "the directory is another one");
    mapped[0] = 'W', expect_content(file, "Within the cage");
}

static void across(void) { /* it works, and has a file open, where its root does not lead */
    int file = made("beside", "beyond the cage");
    enter(NULL);
    wait_here();
    expect_content(file, "beyond the cage");
    EXPECT(open("/beside", O_RDONLY) < 0 && errno == ENOENT, "it is not in a cage");
    expect_content(open("beside", O_RDONLY), "beyond the cage"); /* by its working directory, which lies outside */
}

static int connected(const char *name) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    strcpy(address.sun_path, name);
    int made = socket(AF_UNIX, SOCK_STREAM, 0);
    return connect(made, (void *)&address, sizeof address) ? -1 : made;
}

static void named_sockets(void) { /* a listener and a connection to it, by a name that begins at its root; one that is gone */
    enter("/");
    struct sockaddr_un address = {.sun_family = AF_UNIX, .sun_path = "/work/door"}, gone = {.sun_family = AF_UNIX};
    int listener = socket(AF_UNIX, SOCK_STREAM, 0), lost = socket(AF_UNIX, SOCK_DGRAM, 0), sender = socket(AF_UNIX, SOCK_DGRAM, 0);
    strcpy(gone.sun_path, "/work/lost");
    unlink("/work/door");
    if (bind(listener, (void *)&address, sizeof address) || listen(listener, 4)) cannot("listen");
    int client = connected("/work/door"), server = accept(listener, NULL, NULL);
    if (client < 0 || server < 0 || write(client, "before", 6) != 6) cannot("connect");
    if (bind(lost, (void *)&gone, sizeof gone) || connect(sender, (void *)&gone, sizeof gone)) cannot("bind");
    unlink("/work/lost");
    wait_here();
    char found[20] = "";
    EXPECT(read(server, found, 20) == 6 && !strcmp(found, "before"), "it hears '%s'", found);
    int again = connected("/work/door"), heard = again < 0 ? -1 : accept(listener, NULL, NULL);
    EXPECT(heard >= 0 && write(again, "after", 5) == 5 && read(heard, found, 20) == 5, "nobody answers at its name");
    socklen_t size = sizeof address;
    memset(&address, 0, sizeof address);
    getsockname(listener, (void *)&address, &size);
    EXPECT(!strcmp(address.sun_path, "/work/door"), "it is named %s", address.sun_path);
    EXPECT(write(sender, "gone", 4) == 4 && read(lost, found, 20) == 4, "the one without a file hears nothing");
    EXPECT(access("/work/lost", F_OK), "the name that was gone is back");
}

static void linked_sockets(void) { /* a listener, and one that is gone, by names that lead through a link, which begins at the root */
    enter("/");
    if (symlink("/work", "/link") && errno != EEXIST) cannot("make a link");
    struct sockaddr_un address = {.sun_family = AF_UNIX, .sun_path = "/link/door"}, gone = {.sun_family = AF_UNIX};
    strcpy(gone.sun_path, "/link/../work/./lost");
    int listener = socket(AF_UNIX, SOCK_STREAM, 0), lost = socket(AF_UNIX, SOCK_DGRAM, 0), sender = socket(AF_UNIX, SOCK_DGRAM, 0);
    unlink("/work/door");
    if (bind(listener, (void *)&address, sizeof address) || listen(listener, 4)) cannot("listen");
    if (bind(lost, (void *)&gone, sizeof gone) || connect(sender, (void *)&gone, sizeof gone)) cannot("bind");
    unlink("/work/lost");
    wait_here();
    char found[20] = "";
    int client = connected("/work/door"), server = client < 0 ? -1 : accept(listener, NULL, NULL);
    EXPECT(server >= 0 && write(client, "after", 5) == 5 && read(server, found, 20) == 5, "nobody answers at its name");
    EXPECT(write(sender, "gone", 4) == 4 && read(lost, found, 20) == 4, "the one without a file hears nothing");
    EXPECT(access("/work/lost", F_OK), "the name that was gone is back");
    for (int index = 0; index < 2; index++) {
        struct sockaddr_un now = {0};
        socklen_t size = sizeof now;
        getsockname(index ? lost : listener, (void *)&now, &size);
        EXPECT(!strcmp(now.sun_path, (index ? gone : address).sun_path), "it is named %s", now.sun_path);
    }
}

static void watch(void) {
    enter("/");
    int notices = inotify_init1(IN_NONBLOCK), number = inotify_add_watch(notices, "/work", IN_CREATE);
    int of_root = inotify_add_watch(notices, "/", IN_DELETE_SELF);
    wait_here();
    EXPECT(of_root != number && inotify_add_watch(notices, "/", IN_DELETE_SELF) == of_root, "its root is not watched");
    char found[200] = "";
    close(open("/work/new", O_CREAT | O_WRONLY, 0600));
    struct inotify_event *event = (void *)found;
    EXPECT(read(notices, found, sizeof found) > 0 && event->wd == number && !strcmp(event->name, "new"), "it hears nothing");
    unlink("/work/new");
}

static void watch_outside(void) {
    int notices = inotify_init1(IN_NONBLOCK);
    inotify_add_watch(notices, ".", IN_DELETE);
    enter("/");
    wait_here();
}

static void user(void) { /* as a daemon does it: in its cage, and nobody */
    enter("/work");
    if (setgroups(0, NULL) || setresgid(65534, 65534, 65534) || setresuid(65534, 65534, 65534)) cannot("be nobody");
    int file = made("own", "nobody's");
    wait_here();
    expect_content(file, "nobody's");
    EXPECT_EQUAL("uid", getuid(), 65534);
    EXPECT(chroot("/") < 0 && errno == EPERM, "it may leave");
    unlink("own");
}

static void child(void) { /* whose parent is free */
    int ends[2], status;
    if (pipe(ends)) cannot("make a pipe");
    pid_t pid = fork();
    if (!pid) {
        enter("/");
        int file = made("/work/child", "in a cage");
        write(ends[1], "!", 1);
        while (faccessat(outside, go, F_OK, 0)) usleep(2000);
        struct stat now;
        expect_content(file, "in a cage");
        EXPECT(!stat("/", &now) && now.st_ino == root.st_ino && !access("/work/child", F_OK), "its root is another");
        fflush(stdout);
        _exit(differences);
    }
    char word;
    if (read(ends[0], &word, 1) != 1) cannot("hear of the child");
    ready();
    wait_for_go(go);
    EXPECT(!access("/proc/self", F_OK) && !access("cage/work/child", F_OK), "the parent is in a cage");
    EXPECT(waitpid(pid, &status, 0) == pid && status == 0, "the child found something: %x", status);
}

static int in_a_cage(void *unused) {
    (void)unused;
    for (;;) pause();
}

static void common(void) { /* its child has its directories in common with it */
    static char stack[65536] __attribute__((aligned(16)));
    pid_t child = clone(in_a_cage, stack + sizeof stack, CLONE_FS | SIGCHLD, NULL);
    if (child < 0) cannot("clone");
    enter("/");
    wait_here();
    kill(child, SIGKILL), waitpid(child, NULL, 0);
}

int main(int count, char **words) {
    static const struct {
        const char *name;
        void (*run)(void);
    } all[] = {{"inside", inside}, {"across", across}, {"sockets", named_sockets}, {"watch", watch}, {"linked", linked_sockets},
               {"watch_outside", watch_outside}, {"user", user}, {"child", child}, {"common", common}};
    go = words[1];
    for (size_t index = 0; count > 2 && index < sizeof all / sizeof *all; index++)
        if (!strcmp(words[2], all[index].name)) all[index].run();
    return finish();
}
