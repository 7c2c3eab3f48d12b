/* TCP connections, with itself and with others; the case is named by the second argument. */
#include "tracee.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static int listens = -1;

static void set(int file, int level, int name, int value) {
    if (setsockopt(file, level, name, &value, sizeof value)) cannot("set option %d of level %d", name, level);
}

static int option(int file, int level, int name) {
    int value = -1;
    socklen_t size = sizeof value;
    getsockopt(file, level, name, &value, &size);
    return value;
}

/* A connection with ourselves; the listener stays unless the case closes it. */
static void connect_with_itself(int family, int ends[2]) {
    struct sockaddr_storage address = {.ss_family = family};
    socklen_t size = sizeof address;
    if (family == AF_INET) inet_pton(AF_INET, "127.0.0.1", &((struct sockaddr_in *)&address)->sin_addr);
    else inet_pton(AF_INET6, "::1", &((struct sockaddr_in6 *)&address)->sin6_addr);
    listens = socket(family, SOCK_STREAM, 0);
    if (bind(listens, (struct sockaddr *)&address, sizeof address) || listen(listens, 5)) cannot("listen");
    getsockname(listens, (struct sockaddr *)&address, &size);
    ends[0] = socket(family, SOCK_STREAM, 0);
    if (connect(ends[0], (struct sockaddr *)&address, size)) cannot("connect");
    ends[1] = accept(listens, NULL, NULL);
}

static void say(int file, const char *text) {
    if (send(file, text, strlen(text), MSG_NOSIGNAL) != (ssize_t)strlen(text)) differs("fd %d: cannot send", file);
}

static void expect_text(int file, const char *wanted) {
    char found[200] = "";
    ssize_t size = recv(file, found, strlen(wanted), MSG_WAITALL);
    EXPECT(size == (ssize_t)strlen(wanted) && !memcmp(found, wanted, size), "fd %d: received %zd '%s', not '%s' (%s)", file, size,
           found, wanted, size < 0 ? strerror(errno) : "");
}

static void expect_end(int file) {
    char byte;
    ssize_t size = recv(file, &byte, 1, 0);
    EXPECT(size == 0, "fd %d: %zd (%s), not its end", file, size, size < 0 ? strerror(errno) : "a byte");
}

static void expect_reset(int file) {
    char byte;
    ssize_t size = recv(file, &byte, 1, 0);
    EXPECT(size == -1 && errno == ECONNRESET, "fd %d: %zd (%s), not reset", file, size, size < 0 ? strerror(errno) : "");
    EXPECT(send(file, "x", 1, MSG_NOSIGNAL) == -1 && errno == EPIPE, "fd %d: it can be written to", file);
}

static void same_addresses(int ends[2], struct sockaddr_storage was[2]) {
    for (int end = 0; end < 2; end++) {
        struct sockaddr_storage now = {0};
        socklen_t size = sizeof now;
        getsockname(ends[end], (struct sockaddr *)&now, &size);
        EXPECT(!memcmp(&now, &was[end], sizeof now), "end %d has another address", end);
        memset(&now, 0, sizeof now), size = sizeof now;
        getpeername(ends[end], (struct sockaddr *)&now, &size);
        EXPECT(!memcmp(&now, &was[!end], sizeof now), "end %d has another peer", end);
    }
}

static void talk(int family) {
    int ends[2];
    struct sockaddr_storage was[2] = {0};
    connect_with_itself(family, ends);
    set(ends[0], IPPROTO_TCP, TCP_NODELAY, 1);
    set(ends[1], SOL_SOCKET, SO_KEEPALIVE, 1);
    fcntl(ends[1], F_SETFL, O_NONBLOCK);
    for (int end = 0; end < 2; end++) {
        socklen_t size = sizeof was[end];
        getsockname(ends[end], (struct sockaddr *)&was[end], &size);
    }
    say(ends[0], "to the server"), say(ends[1], "to the client");
    wait_here();
    EXPECT_EQUAL("flags", fcntl(ends[1], F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    fcntl(ends[1], F_SETFL, 0);
    expect_text(ends[1], "to the server"), expect_text(ends[0], "to the client");
    say(ends[0], "again"), expect_text(ends[1], "again");
    say(ends[1], "back"), expect_text(ends[0], "back");
    EXPECT_EQUAL("no delay", option(ends[0], IPPROTO_TCP, TCP_NODELAY), 1);
    EXPECT_EQUAL("no delay", option(ends[1], IPPROTO_TCP, TCP_NODELAY), 0);
    EXPECT_EQUAL("keep alive", option(ends[1], SOL_SOCKET, SO_KEEPALIVE), 1);
    EXPECT_EQUAL("reuse", option(ends[1], SOL_SOCKET, SO_REUSEADDR), 0);
    EXPECT_EQUAL("reuse", option(listens, SOL_SOCKET, SO_REUSEADDR), 0);
    same_addresses(ends, was);
    close(ends[0]), expect_end(ends[1]);
    int more[2] = {socket(family, SOCK_STREAM, 0)};
    socklen_t size = sizeof was[0];
    getsockname(listens, (struct sockaddr *)&was[0], &size);
    EXPECT(connect(more[0], (struct sockaddr *)&was[0], size) == 0, "the listener is deaf: %s", strerror(errno));
}

static void itself_4(void) { talk(AF_INET); }
static void itself_6(void) { talk(AF_INET6); }

static void itself_much(void) {
    int ends[2];
    char piece[1024];
    uint64_t sent = 0, found = 0;
    connect_with_itself(AF_INET, ends);
    for (; sent < 40960 / 8; sent += sizeof piece / 8) {
        fill(piece, sizeof piece, sent);
        if (send(ends[0], piece, sizeof piece, MSG_DONTWAIT) != sizeof piece) break;
    }
    for (int left = 1; left; usleep(1000)) ioctl(ends[0], TIOCOUTQ, &left);
    wait_here();
    shutdown(ends[0], SHUT_WR);
    for (; recv(ends[1], piece, sizeof piece, MSG_WAITALL) == sizeof piece; found += sizeof piece / 8)
        expect_filled("piece", piece, sizeof piece, found);
    EXPECT_EQUAL("pieces", found, sent);
    EXPECT(option(ends[1], SOL_SOCKET, 72) == 0, "the size of its buffers is fixed");
}

/* More than its other end takes: some of it waits at this end. */
static void itself_full(void) {
    int ends[2];
    char piece[1024] = {0};
    connect_with_itself(AF_INET, ends);
    while (send(ends[0], piece, sizeof piece, MSG_DONTWAIT) > 0) continue;
    wait_here();
}

/* With a layer of the kernel's between the program and TCP, which only a kernel with CONFIG_TLS has. */
static void itself_encrypted(void) {
    int ends[2];
    connect_with_itself(AF_INET, ends);
    if (setsockopt(ends[1], IPPROTO_TCP, 31 /* TCP_ULP */, "tls", sizeof "tls")) cannot("have the kernel encrypt");
    wait_here();
}

static void itself_half_closed(void) {
    int ends[2];
    connect_with_itself(AF_INET, ends);
    close(listens);
    say(ends[0], "last"), shutdown(ends[0], SHUT_WR);
    wait_here();
    expect_text(ends[1], "last"), expect_end(ends[1]);
    say(ends[1], "back"), expect_text(ends[0], "back");
    EXPECT(send(ends[0], "x", 1, MSG_NOSIGNAL) == -1 && errno == EPIPE, "it can be written to");
}

/* One side reads no more, and the other one has not ended; both can be written to. */
static void itself_deaf(void) {
    int ends[2];
    connect_with_itself(AF_INET, ends);
    shutdown(ends[0], SHUT_RD);
    wait_here();
    expect_end(ends[0]);
    say(ends[0], "spoken"), poll(&(struct pollfd){ends[1], POLLIN, 0}, 1, 5000), expect_text(ends[1], "spoken");
    EXPECT(poll(&(struct pollfd){ends[1], POLLRDHUP, 0}, 1, 0) == 0, "the other side reads the end, too");
}

static void itself_ended(void) {
    int ends[2];
    connect_with_itself(AF_INET, ends);
    shutdown(ends[0], SHUT_RDWR), shutdown(ends[1], SHUT_RDWR);
    wait_here();
    expect_end(ends[0]), expect_end(ends[1]);
    EXPECT(send(ends[0], "x", 1, MSG_NOSIGNAL) == -1 && errno == EPIPE, "it can be written to");
}

/* The other process of a connection: a helper that outlives us, in a session of its own, and is nobody's child. */
static int connect_with_other(const char *port) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(atoi(port)), .sin_addr = {htonl(INADDR_LOOPBACK)}};
    int file = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(file, (struct sockaddr *)&address, sizeof address)) cannot("connect to port %s", port);
    return file;
}

static void other_reset(const char *port) {
    int file = connect_with_other(port), polled = epoll_create1(0);
    struct epoll_event event = {.events = EPOLLIN | EPOLLRDHUP, .data.fd = 77};
    epoll_ctl(polled, EPOLL_CTL_ADD, file, &event);
    wait_here();
    memset(&event, 0, sizeof event);
    EXPECT_EQUAL("events", epoll_wait(polled, &event, 1, 0), 1);
    EXPECT(event.data.fd == 77 && (event.events & (EPOLLHUP | EPOLLERR)) == (EPOLLHUP | EPOLLERR), "events %x", event.events);
    expect_reset(file);
}

/* It has read everything up to the end, and ended its own side: nothing is left but the descriptor. */
static void other_told(const char *port) {
    int file = connect_with_other(port);
    say(file, "end\n");
    expect_text(file, "last"), expect_end(file);
    shutdown(file, SHUT_WR);
    for (struct tcp_info told = {0}; told.tcpi_state != TCP_CLOSE; usleep(1000)) {
        socklen_t size = sizeof told;
        getsockopt(file, IPPROTO_TCP, TCP_INFO, &told, &size);
    }
    wait_here();
    expect_end(file);
    EXPECT(send(file, "x", 1, MSG_NOSIGNAL) == -1 && errno == EPIPE, "it can be written to");
}

/* The other side says "last" and ends: what was not read is lost, so nothing may look like an orderly end. */
static void other_ended_unread(const char *port) {
    int file = connect_with_other(port), size = 0;
    say(file, "end\n");
    while (size < 4) ioctl(file, FIONREAD, &size), usleep(1000);
    wait_here();
    expect_reset(file);
}

static void other_ended(const char *port) {
    int file = connect_with_other(port);
    say(file, "end\n");
    expect_text(file, "last");
    struct pollfd ended = {file, POLLRDHUP, 0};
    poll(&ended, 1, -1);
    wait_here();
    expect_end(file);
}

static void other_asked(const char *port) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(atoi(port)), .sin_addr = {htonl(INADDR_LOOPBACK)}};
    int file = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0);
    if (connect(file, (struct sockaddr *)&address, sizeof address) != -1 || errno != EINPROGRESS) cannot("ask for a connection");
    wait_here();
    struct pollfd answered = {file, POLLOUT, 0};
    EXPECT_EQUAL("poll", poll(&answered, 1, 60000), 1);
    EXPECT_EQUAL("error", option(file, SOL_SOCKET, SO_ERROR), 0);
    fcntl(file, F_SETFL, 0);
    say(file, "end\n"), expect_text(file, "last"), expect_end(file);
}

int main(int count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
        void (*with)(const char *port);
    } cases[] = {{"itself_4", itself_4, NULL},
                 {"itself_6", itself_6, NULL},
                 {"itself_much", itself_much, NULL},
                 {"itself_full", itself_full, NULL},
                 {"itself_encrypted", itself_encrypted, NULL},
                 {"itself_half_closed", itself_half_closed, NULL}, {"itself_deaf", itself_deaf, NULL},
                 {"itself_ended", itself_ended, NULL},
                 {"other_reset", NULL, other_reset},
                 {"other_told", NULL, other_told},
                 {"other_ended_unread", NULL, other_ended_unread},
                 {"other_ended", NULL, other_ended},
                 {"other_asked", NULL, other_asked}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            if (cases[index].act) cases[index].act();
            else cases[index].with(arguments[3]);
            return finish();
        }
    cannot("find the case");
}
