/* Sockets of TCP, UDP and their like, one feature each; the case is named by the second argument. */
#include "sockets.h"

static int udp(void) { return socket(AF_INET, SOCK_DGRAM, 0); }

static int poll_ends(int file) {
    struct pollfd asked = {file, POLLRDHUP, 0};
    poll(&asked, 1, 0);
    return asked.revents & (POLLRDHUP | POLLHUP);
}

static int error_of_send(int file) { return send(file, "x", 1, MSG_DONTWAIT | MSG_NOSIGNAL) == -1 ? errno : 0; }

/* shutdown(2) of sockets for datagrams, of each direction; one that is bound to no port says that it is not connected. */
static void udp_shut_down(void) {
    struct sockaddr_storage address;
    int receiver = bound(AF_INET, SOCK_DGRAM, "127.0.0.1", 0, &address), files[4], fresh = udp();
    for (int how = 0; how < 4; how++) {
        files[how] = udp();
        if (connect(files[how], (struct sockaddr *)&address, 16)) cannot("connect");
        if (how < 3) shutdown(files[how], how);
    }
    shutdown(fresh, SHUT_RD);
    wait_here();
    EXPECT_EQUAL("only reading is shut down", error_of_send(files[SHUT_RD]), 0);
    EXPECT_EQUAL("only reading is shut down", poll_ends(files[SHUT_RD]), POLLRDHUP);
    EXPECT_EQUAL("sending is shut down", error_of_send(files[SHUT_WR]), EPIPE);
    EXPECT_EQUAL("only sending is shut down", poll_ends(files[SHUT_WR]), 0);
    EXPECT_EQUAL("both are shut down", error_of_send(files[SHUT_RDWR]), EPIPE);
    EXPECT_EQUAL("both are shut down", poll_ends(files[SHUT_RDWR]), POLLRDHUP | POLLHUP);
    EXPECT_EQUAL("nothing is shut down", error_of_send(files[3]), 0);
    EXPECT_EQUAL("it is shut down, though it is not connected", poll_ends(fresh), POLLRDHUP);
    expect_text(receiver, "x");
}

/* Bound to addresses that the machine does not have, by an option that was taken off again. */
static void foreign_address(void) {
    struct sockaddr_in four = {.sin_family = AF_INET, .sin_port = htons(7)};
    struct sockaddr_in6 six = {.sin6_family = AF_INET6, .sin6_port = htons(7)};
    struct sockaddr_storage names[3];
    int files[3] = {udp(), socket(AF_INET6, SOCK_STREAM, 0), udp()};
    socklen_t size;
    inet_aton("192.0.2.77", &four.sin_addr), inet_pton(AF_INET6, "2001:db8::77", &six.sin6_addr);
    for (int index = 0; index < 3; index++) set(files[index], IPPROTO_IP, IP_FREEBIND, 1);
    if (bind(files[0], (struct sockaddr *)&four, 16) || bind(files[1], (struct sockaddr *)&six, 28)) cannot("bind");
    four.sin_port = htons(9);
    if (bind(files[2], (struct sockaddr *)&four, 16)) cannot("bind");
    set(files[0], IPPROTO_IP, IP_FREEBIND, 0), set(files[1], IPPROTO_IP, IP_FREEBIND, 0);
    for (int index = 0; index < 3; index++) {
        memset(&names[index], 0, size = sizeof names[index]);
        getsockname(files[index], (struct sockaddr *)&names[index], &size);
    }
    wait_here();
    for (int index = 0; index < 3; index++) {
        expect_same_name(files[index], &names[index]);
        EXPECT_EQUAL("free", option(files[index], IPPROTO_IP, IP_FREEBIND), index == 2);
    }
}

/* An accepted connection: it shows options that no stream can be given. */
static void accepted_stream(int family, const char *host) {
    struct sockaddr_storage address;
    int listens = bound(family, SOCK_STREAM, host, 0, &address), client = socket(family, SOCK_STREAM, 0);
    if (listen(listens, 1) || connect(client, (struct sockaddr *)&address, family == AF_INET ? 16 : 28)) cannot("connect");
    int accepted = accept(listens, NULL, NULL), only = option(accepted, IPPROTO_IPV6, IPV6_V6ONLY);
    wait_here();
    EXPECT_EQUAL("only IPv6", option(accepted, IPPROTO_IPV6, IPV6_V6ONLY), only);
    say(client, "hello");
    poll(&(struct pollfd){accepted, POLLIN, 0}, 1, 5000);
    expect_text(accepted, "hello");
}

static void accepted_stream_4(void) { accepted_stream(AF_INET, "127.0.0.1"); }
static void accepted_stream_6(void) { accepted_stream(AF_INET6, "::1"); }

/* A connection with itself of which both sides have ended, and what one of them has not read. */
static void closed_connection(int family, const char *host) {
    struct sockaddr_storage names[2], name;
    int listens = bound(family, SOCK_STREAM, host, 0, &names[1]), files[2] = {socket(family, SOCK_STREAM, 0)};
    socklen_t size = family == AF_INET ? 16 : 28, length = size;
    if (listen(listens, 1) || connect(files[0], (struct sockaddr *)&names[1], size)) cannot("connect");
    files[1] = accept(listens, NULL, NULL);
    close(listens), say(files[0], "unread");
    getsockname(files[0], (struct sockaddr *)&names[0], &length);
    for (int index = 0; index < 2; index++) shutdown(files[index], SHUT_WR);
    wait_here();
    for (int index = 0; index < 2; index++) {
        char found[10] = "";
        EXPECT(getsockopt(files[index], SOL_SOCKET, SO_PEERNAME, &name, &length) == 0 && !memcmp(&name, &names[!index], 8),
               "fd %d: connected with something else", files[index]);
        EXPECT(getsockname(files[index], (struct sockaddr *)&name, &length) == 0 && !memcmp(&name, &names[index], 8), "fd %d: bound",
               files[index]);
        EXPECT(recv(files[index], found, 10, 0) == 6 * index && !strcmp(found, index ? "unread" : ""), "it reads '%s'", found);
        EXPECT(recv(files[index], found, 10, 0) == 0, "it has not ended");
        EXPECT_EQUAL("it sends", error_of_send(files[index]), EPIPE);
    }
}

/* Options that a socket carries in every packet, and whose socket it is. */
static void rare_options(void) {
    unsigned char four[4] = {148, 4, 0, 0}, six[8] = {0, 0, 1, 4, 0, 0, 0, 0}, found[16] = "";
    int file = udp(), other = socket(AF_INET6, SOCK_DGRAM, 0), stream = socket(AF_INET, SOCK_STREAM, 0);
    if (setsockopt(file, IPPROTO_IP, IP_OPTIONS, four, 4) || setsockopt(other, IPPROTO_IPV6, IPV6_DSTOPTS, six, 8)) cannot("set options");
    set(other, IPPROTO_IPV6, IPV6_DONTFRAG, 1), set(stream, IPPROTO_IP, 24 /* IP_BIND_ADDRESS_NO_PORT */, 1);
    if (fchown(file, 1234, 4321)) cannot("give a socket away");
    wait_here();
    socklen_t size = sizeof found;
    EXPECT(getsockopt(file, IPPROTO_IP, IP_OPTIONS, found, &size) == 0 && size == 4 && !memcmp(found, four, 4), "%u bytes", size);
    size = sizeof found;
    EXPECT(getsockopt(other, IPPROTO_IPV6, IPV6_DSTOPTS, found, &size) == 0 && size == 8 && !memcmp(found, six, 8), "%u bytes", size);
    EXPECT_EQUAL("fragments", option(other, IPPROTO_IPV6, IPV6_DONTFRAG), 1);
    EXPECT_EQUAL("no port", option(stream, IPPROTO_IP, 24), 1);
    struct stat about = {0};
    fstat(file, &about);
    EXPECT(about.st_uid == 1234 && about.st_gid == 4321, "it is %u's", about.st_uid);
}

static void closed_connection_4(void) { closed_connection(AF_INET, "127.0.0.1"); }
static void closed_connection_6(void) { closed_connection(AF_INET6, "::1"); }

int main(int count, char **arguments) {
    static const struct socket_case cases[] = {
        {"udp_shut_down", udp_shut_down},
        {"foreign_address", foreign_address},
        {"accepted_stream_4", accepted_stream_4},
        {"accepted_stream_6", accepted_stream_6},
        {"rare_options", rare_options},
        {"closed_connection_4", closed_connection_4},
        {"closed_connection_6", closed_connection_6},
    };
    return run_case(count, arguments, cases, sizeof cases / sizeof *cases);
}
