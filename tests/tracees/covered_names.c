/* Named pipes and unix sockets over whose name something was mounted (by the test, over "place"), or that something else has. */
#include "tracee.h"

#include <sys/socket.h>
#include <sys/un.h>

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static struct sockaddr_un named(const char *name) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    snprintf(address.sun_path, sizeof address.sun_path, "%s", name);
    return address;
}

static int listener(const char *name) {
    struct sockaddr_un address = named(name);
    int made = socket(AF_UNIX, SOCK_STREAM, 0);
    if (bind(made, (void *)&address, sizeof address) || listen(made, 2)) cannot("listen at %s", name);
    return made;
}

static void expect_name(int made, const char *name) {
    struct sockaddr_un address = {0};
    socklen_t size = sizeof address;
    EXPECT(!getsockname(made, (void *)&address, &size) && !strcmp(address.sun_path, name), "it is named %s", address.sun_path);
}

static void covered_pipe(void) {
    char found[20] = "";
    struct stat about, again;
    mkfifo("place/pipe", 0640);
    int both = open("place/pipe", O_RDWR | O_NONBLOCK), reader = open("place/pipe", O_RDONLY);
    if (write(both, "what waits", 10) != 10 || fstat(both, &about)) cannot("fill the pipe");
    wait_here();
    EXPECT(access("place/pipe", F_OK), "nothing is mounted over it");
    EXPECT(read(reader, found, 20) == 10 && !strcmp(found, "what waits"), "it holds '%s'", found);
    EXPECT(write(both, "again", 5) == 5 && read(reader, found, 20) == 5, "it is another pipe");
    EXPECT(!fstat(reader, &again) && again.st_ino == about.st_ino, "it is another file");
    EXPECT_EQUAL("flags", fcntl(both, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
}

static void accepted_by(const char *name) { /* both ends of a connection */
    char found[20] = "";
    struct sockaddr_un address = named(name);
    int door = listener(name), client = socket(AF_UNIX, SOCK_STREAM, 0);
    if (connect(client, (void *)&address, sizeof address)) cannot("connect");
    int server = accept(door, NULL, NULL);
    close(door);
    wait_here();
    EXPECT(write(client, "hello", 5) == 5 && read(server, found, 20) == 5, "they are not connected");
    expect_name(server, name);
    EXPECT(access("place/door", F_OK), "the name is in what was mounted");
}

static void accepted(void) { accepted_by("place/door"); }

static void accepted_whole(void) {
    char name[100];
    if (!getcwd(name, sizeof name - 20)) cannot("tell the directory");
    accepted_by(strcat(name, "/place/door"));
}

static void listening(void) {
    listener("place/door");
    wait_here();
}

static void replaced(void) { /* by a whole name that leads to a file now */
    char name[100], found[20] = "";
    if (!getcwd(name, sizeof name - 10)) cannot("tell the directory");
    strcat(name, "/door");
    struct sockaddr_un address = named(name);
    int receiver = socket(AF_UNIX, SOCK_DGRAM, 0), sender = socket(AF_UNIX, SOCK_DGRAM, 0);
    if (bind(receiver, (void *)&address, sizeof address) || connect(sender, (void *)&address, sizeof address)) cannot("bind");
    unlink("door");
    int file = open("door", O_RDWR | O_CREAT, 0600);
    if (write(file, "a file", 6) != 6) cannot("write");
    wait_here();
    EXPECT(write(sender, "hello", 5) == 5 && read(receiver, found, 20) == 5, "they are not connected");
    expect_name(receiver, name);
    EXPECT(pread(open("door", O_RDONLY), found, 20, 0) == 6 && !strncmp(found, "a file", 6), "the file holds '%s'", found);
}

int main(int count, char **words) {
    static const struct {
        const char *name;
        void (*run)(void);
    } all[] = {{"pipe", covered_pipe}, {"accepted", accepted}, {"accepted_whole", accepted_whole}, {"listening", listening}, {"replaced", replaced}};
    go = words[1];
    if (mkdir("place", 0700) && errno != EEXIST) cannot("make a directory");
    for (size_t index = 0; count > 2 && index < sizeof all / sizeof *all; index++)
        if (!strcmp(words[2], all[index].name)) all[index].run();
    return finish();
}
