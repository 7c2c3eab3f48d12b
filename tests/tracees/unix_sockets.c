/* Unix sockets: their names, who made them, and connections that nobody has accepted; the case is named by the second argument. */
#include "sockets.h"

#include <sys/epoll.h>

static struct sockaddr_un named(const char *name, socklen_t *size) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    size_t length = strlen(name + 1) + 1;
    memcpy(address.sun_path, name, length);
    *size = offsetof(struct sockaddr_un, sun_path) + length + (name[0] != 0);
    return address;
}

static int bind_to(int file, const char *name) {
    socklen_t size;
    struct sockaddr_un address = named(name, &size);
    if (bind(file, (struct sockaddr *)&address, size)) cannot("bind to %s", name[0] ? name : name + 1);
    return file;
}

static int connect_to(int file, const char *name) {
    socklen_t size;
    struct sockaddr_un address = named(name, &size);
    if (connect(file, (struct sockaddr *)&address, size)) differs("cannot connect to %s: %s", name, strerror(errno));
    return file;
}

static int unix_socket(int kind) { return socket(AF_UNIX, kind, 0); }

static void expect_name(int file, const char *wanted) {
    struct sockaddr_un found = {0};
    socklen_t size = sizeof found;
    getsockname(file, (struct sockaddr *)&found, &size);
    EXPECT(!strcmp(found.sun_path, wanted), "fd %d: its name is %s", file, found.sun_path);
}

static void expect_peer(int file, const char *wanted) {
    struct sockaddr_un found = {0};
    socklen_t size = sizeof found;
    EXPECT(getpeername(file, (struct sockaddr *)&found, &size) == 0 && !strcmp(found.sun_path, wanted), "fd %d: its peer is %s", file,
           found.sun_path);
}

static const char *whole(const char *name) {
    static char path[108];
    char directory[80];
    if (!getcwd(directory, sizeof directory)) cannot("see where I am");
    snprintf(path, sizeof path, "%s/%s", directory, name);
    return path;
}

static int exists(const char *name) { return access(name, F_OK) == 0; }

/* The name has become a fifo's, and the program has left the directory from which it gave it. */
static void ghost_left(void) {
    static char path[108];
    int server = bind_to(unix_socket(SOCK_DGRAM), "ghost"), client = connect_to(unix_socket(SOCK_DGRAM), "ghost");
    strcpy(path, whole("ghost"));
    if (unlink("ghost") || mkfifo("ghost", 0600) || chdir("/")) cannot("put a fifo there");
    static char go_there[200];
    snprintf(go_there, sizeof go_there, "%.*s/go", (int)(strrchr(path, '/') - path), path), go = go_there;
    wait_here();
    say(client, "one"), expect_text(server, "one");
    expect_name(server, "ghost"), expect_peer(client, "ghost");
    struct stat about;
    EXPECT(stat(path, &about) == 0 && S_ISFIFO(about.st_mode), "the fifo is gone");
}

/* The directory of the names is gone: of a socket for datagrams and its client, and of an accepted connection. */
static void ghost_directory(void) {
    static char path[108];
    mkdir("short", 0700), mkdir("short/lived", 0700);
    strcpy(path, whole("short/lived/datagrams"));
    int server = bind_to(unix_socket(SOCK_DGRAM), path), client = connect_to(unix_socket(SOCK_DGRAM), path);
    int listens = bind_to(unix_socket(SOCK_STREAM), "short/lived/stream");
    listen(listens, 2);
    int asking = connect_to(unix_socket(SOCK_STREAM), "short/lived/stream"), accepted = accept(listens, NULL, NULL);
    close(listens), unlink("short/lived/stream"), unlink(path);
    if (rmdir("short/lived") || rmdir("short")) cannot("remove directories");
    say(client, "waits"), say(asking, "waits, too");
    wait_here();
    expect_text(server, "waits"), expect_text(accepted, "waits, too");
    say(client, "one"), expect_text(server, "one"), say(accepted, "two"), expect_text(asking, "two");
    expect_name(server, path), expect_name(accepted, "short/lived/stream"), expect_peer(asking, "short/lived/stream");
    EXPECT(!exists("short"), "the directory is back");
}

/* A name that a second socket has taken: it leads to that one. The file keeps its mode and its owner. */
static void name_taken_again(void) {
    int first = bind_to(unix_socket(SOCK_DGRAM), "twice"), client = connect_to(unix_socket(SOCK_DGRAM), "twice");
    unlink("twice");
    int second = bind_to(unix_socket(SOCK_DGRAM), "twice");
    if (chmod("twice", 0640) || chown("twice", 1234, 4321)) cannot("give the name away");
    wait_here();
    int later = connect_to(unix_socket(SOCK_DGRAM), "twice");
    say(client, "to the first"), say(later, "to the second");
    expect_text(first, "to the first"), expect_text(second, "to the second");
    struct stat about = {0};
    stat("twice", &about);
    EXPECT_EQUAL("mode", about.st_mode & 0777, 0640);
    EXPECT_EQUAL("owner", about.st_uid, 1234);
    EXPECT_EQUAL("group", about.st_gid, 4321);
}

/* Three connections wait in their order, one of a client with a name; the listener lies in another directory by now. */
static void waiting(int kind) {
    char found[10];
    mkdir("below", 0700);
    int listens = bind_to(unix_socket(kind), "listens"), clients[3];
    listen(listens, 5);
    for (int index = 0; index < 3; index++) {
        clients[index] = unix_socket(kind);
        if (index == 1) bind_to(clients[index], "client");
        connect_to(clients[index], "listens");
    }
    if (chdir("below")) cannot("go below");
    static char go_there[] = "../go";
    go = go_there;
    wait_here();
    for (int index = 0; index < 3; index++) {
        int accepted = accept(listens, NULL, NULL);
        if (index == 1) expect_peer(accepted, "client");
        snprintf(found, sizeof found, "%d", index);
        say(clients[index], found), expect_text(accepted, found);
        say(accepted, "back"), expect_text(clients[index], "back");
    }
    fcntl(listens, F_SETFL, O_NONBLOCK);
    EXPECT(accept(listens, NULL, NULL) == -1 && errno == EAGAIN, "one more waits");
    EXPECT(exists("../listens") && !exists("listens"), "its name lies elsewhere");
}

static void waiting_stream(void) { waiting(SOCK_STREAM); }
static void waiting_packets(void) { waiting(SOCK_SEQPACKET); }

static void expect_from(int file, const char *text, const char *name, int size) {
    char found[20] = "";
    struct sockaddr_un from = {0};
    socklen_t length = sizeof from;
    recvfrom(file, found, sizeof found - 1, MSG_DONTWAIT, (struct sockaddr *)&from, &length);
    int named = length > sizeof(sa_family_t) ? (int)(length - sizeof(sa_family_t)) : 0;
    EXPECT(!strcmp(found, text) && named == size && !memcmp(from.sun_path, name, size), "'%s' came from '%s', %d bytes", found,
           from.sun_path, named);
}

static void say_to(int file, const char *text, const char *name) {
    socklen_t size;
    struct sockaddr_un address = named(name, &size);
    if (sendto(file, text, strlen(text), 0, (struct sockaddr *)&address, size) < 0) cannot("send to %s", name);
}

/* Messages from names: of one that lives, of two that have gone, of nobody, and of the receiver itself. */
static void named_senders(void) {
    static char abstract[40];
    snprintf(abstract + 1, 30, "failover-sender-%d", getpid());
    int receiver = bind_to(unix_socket(SOCK_DGRAM), "receiver"), lives = bind_to(unix_socket(SOCK_DGRAM), "lives");
    int gone = bind_to(unix_socket(SOCK_DGRAM), "gone"), other = bind_to(unix_socket(SOCK_DGRAM), abstract);
    int nobody = unix_socket(SOCK_DGRAM);
    say_to(lives, "one", "receiver"), say_to(gone, "two", "receiver"), say_to(other, "three", "receiver");
    say_to(nobody, "four", "receiver"), say_to(receiver, "five", "receiver"), say_to(lives, "six", "receiver");
    connect_to(lives, "receiver"), connect_to(receiver, "lives"), say(receiver, "back");
    close(gone), close(other), close(nobody), unlink("gone");
    wait_here();
    expect_from(receiver, "one", "lives", 6), expect_from(receiver, "two", "gone", 5);
    expect_from(receiver, "three", abstract, strlen(abstract + 1) + 1), expect_from(receiver, "four", "", 0);
    expect_from(receiver, "five", "receiver", 9), expect_from(receiver, "six", "lives", 6), expect_nothing(receiver);
    expect_from(lives, "back", "receiver", 9), expect_nothing(lives);
    say(lives, "more"), expect_from(receiver, "more", "lives", 6);
    EXPECT(!exists("gone"), "its name is back");
}

/* A pair that got names afterwards, and a socket that is connected to itself. */
static void named_pair(void) {
    int ends[2], own = bind_to(unix_socket(SOCK_DGRAM), "own");
    if (socketpair(AF_UNIX, SOCK_DGRAM, 0, ends)) cannot("make a pair");
    bind_to(ends[0], "left"), bind_to(ends[1], "right"), connect_to(own, "own");
    say(ends[0], "one"), say(own, "myself");
    wait_here();
    expect_from(ends[1], "one", "left", 5), say(ends[1], "two"), expect_from(ends[0], "two", "right", 6);
    expect_text(own, "myself"), say(own, "again"), expect_text(own, "again");
    expect_name(ends[0], "left"), expect_peer(ends[0], "right"), expect_peer(own, "own");
}

static void expect_maker(int file, unsigned uid, unsigned gid) {
    struct ucred found = {0};
    socklen_t size = sizeof found;
    getsockopt(file, SOL_SOCKET, SO_PEERCRED, &found, &size);
    EXPECT(found.pid == getpid() && found.uid == uid && found.gid == gid, "fd %d: pid %d, uid %u, gid %u", file, found.pid, found.uid,
           found.gid);
}

/* Sockets from before and after the program became an ordinary user: each tells who made it. */
static void makers(void) {
    int before[2], after[2], listens = bind_to(unix_socket(SOCK_STREAM), "listens");
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, before) || listen(listens, 3) || chmod("listens", 0777)) cannot("listen");
    if (setresgid(65533, 65533, 65533) || setresuid(65534, 65534, 65534)) cannot("become an ordinary user");
    if (socketpair(AF_UNIX, SOCK_SEQPACKET, 0, after)) cannot("make a pair");
    set(after[1], SOL_SOCKET, SO_PASSCRED, 1), say(after[0], "from whom");
    int client = connect_to(unix_socket(SOCK_STREAM), "listens"), accepted = accept(listens, NULL, NULL);
    int waits = connect_to(unix_socket(SOCK_STREAM), "listens");
    wait_here();
    expect_maker(before[0], 0, 0), expect_maker(before[1], 0, 0), expect_maker(listens, 0, 0);
    expect_maker(after[0], 65534, 65533), expect_maker(after[1], 65534, 65533);
    expect_maker(client, 0, 0), expect_maker(accepted, 65534, 65533), expect_maker(waits, 0, 0);
    expect_maker(accept(listens, NULL, NULL), 65534, 65533);
    char content[20], room[CMSG_SPACE(sizeof(struct ucred))];
    struct iovec piece = {content, sizeof content};
    struct msghdr message = {.msg_iov = &piece, .msg_iovlen = 1, .msg_control = room, .msg_controllen = sizeof room};
    EXPECT(recvmsg(after[1], &message, MSG_DONTWAIT) == 9 && CMSG_FIRSTHDR(&message), "nobody has sent it");
    struct ucred sender = {0};
    if (CMSG_FIRSTHDR(&message)) memcpy(&sender, CMSG_DATA(CMSG_FIRSTHDR(&message)), sizeof sender);
    EXPECT(sender.pid == getpid() && sender.uid == 65534 && sender.gid == 65533, "pid %d, uid %u has sent it", sender.pid, sender.uid);
}

static void pass(int file, int passed) {
    char room[CMSG_SPACE(sizeof(int))] = {0};
    struct iovec content = {"x", 1};
    struct msghdr message = {.msg_iov = &content, .msg_iovlen = 1, .msg_control = room, .msg_controllen = sizeof room};
    struct cmsghdr *rights = CMSG_FIRSTHDR(&message);
    rights->cmsg_level = SOL_SOCKET, rights->cmsg_type = SCM_RIGHTS, rights->cmsg_len = CMSG_LEN(sizeof(int));
    memcpy(CMSG_DATA(rights), &passed, sizeof(int));
    if (sendmsg(file, &message, 0) != 1) cannot("pass a descriptor");
}

static int receive(int file) {
    char content, room[CMSG_SPACE(sizeof(int))];
    struct iovec piece = {&content, 1};
    struct msghdr message = {.msg_iov = &piece, .msg_iovlen = 1, .msg_control = room, .msg_controllen = sizeof room};
    int passed = -1;
    if (recvmsg(file, &message, MSG_DONTWAIT) != 1 || !CMSG_FIRSTHDR(&message)) differs("no descriptor came: %s", strerror(errno));
    else memcpy(&passed, CMSG_DATA(CMSG_FIRSTHDR(&message)), sizeof(int));
    return passed;
}

static int pass_and_close(int file, int passed) {
    pass(file, passed), close(passed);
    return passed;
}

/* On their way, and closed by the program: a file, both ends of a pipe with something in it, a socket whose other end stays, an epoll
 * that watches what stays, and a socket in which a file is on its way. */
static void travelling(void) {
    int ends[2], pipes[2], others[2], nested[2], file = open("file", O_RDWR | O_CREAT, 0600);
    if (socketpair(AF_UNIX, SOCK_SEQPACKET, 0, ends) || pipe(pipes) || socketpair(AF_UNIX, SOCK_STREAM, 0, others)) cannot("begin");
    if (socketpair(AF_UNIX, SOCK_DGRAM, 0, nested) || write(file, "content", 7) != 7) cannot("begin");
    pass(ends[0], file), lseek(file, 3, SEEK_SET), pass_and_close(nested[0], file);
    int watching = epoll_create1(0);
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = 77};
    if (epoll_ctl(watching, EPOLL_CTL_ADD, others[0], &event) || write(pipes[1], "in the pipe", 11) != 11) cannot("watch");
    say(others[0], "waits"), say(others[1], "wakes");
    pass_and_close(ends[0], pipes[0]), pass_and_close(ends[0], pipes[1]), pass_and_close(ends[0], others[1]);
    pass_and_close(ends[0], watching), pass_and_close(ends[0], nested[1]), close(nested[0]);
    wait_here();
    char found[20] = "";
    file = receive(ends[1]), pipes[0] = receive(ends[1]), pipes[1] = receive(ends[1]), others[1] = receive(ends[1]);
    watching = receive(ends[1]), nested[1] = receive(ends[1]), expect_nothing(ends[1]);
    EXPECT(read(pipes[0], found, 20) == 11 && write(pipes[1], "more", 4) == 4 && read(pipes[0], found, 20) == 4, "it is not the pipe");
    expect_text(others[1], "waits"), say(others[1], "back");
    EXPECT(epoll_wait(watching, &event, 1, 0) == 1 && event.data.u64 == 77, "it does not watch");
    expect_text(others[0], "wakesback");
    int same = receive(nested[1]);
    EXPECT_EQUAL("offset", lseek(file, 0, SEEK_CUR), 3);
    lseek(same, 5, SEEK_SET);
    EXPECT_EQUAL("shared offset", lseek(file, 0, SEEK_CUR), 5);
    EXPECT_EQUAL("what is open", open("/dev/null", O_RDONLY), same + 1);
}

/* The other end was closed before all was read there; nobody has been told yet. */
static void reset(int kind) {
    int ends[2];
    char byte;
    if (socketpair(AF_UNIX, kind, 0, ends)) cannot("make a pair");
    say(ends[1], "unread"), close(ends[0]);
    wait_here();
    EXPECT(recv(ends[1], &byte, 1, 0) == -1 && errno == ECONNRESET, "it is not told: %s", strerror(errno));
    EXPECT_EQUAL("end", recv(ends[1], &byte, 1, 0), 0);
}

static void reset_stream(void) { reset(SOCK_STREAM); }
static void reset_packets(void) { reset(SOCK_SEQPACKET); }

int main(int count, char **arguments) {
    static const struct socket_case cases[] = {
        {"ghost_left", ghost_left},
        {"ghost_directory", ghost_directory},
        {"name_taken_again", name_taken_again},
        {"waiting_stream", waiting_stream},
        {"waiting_packets", waiting_packets},
        {"named_senders", named_senders},
        {"named_pair", named_pair},
        {"makers", makers},
        {"reset_stream", reset_stream},
        {"reset_packets", reset_packets},
        {"travelling", travelling},
    };
    return run_case(count, arguments, cases, sizeof cases / sizeof *cases);
}
