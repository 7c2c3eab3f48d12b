/* Options that few programs set, and sockets that look like others; the case is named by the second argument. */
#include "sockets.h"

struct setting {
    int level, number, value;
};

/* What can be set here is told again as it was told after it was set. */
static void keep_settings(int file, const struct setting *settings, int count) {
    int told[32], is_set[32];
    for (int index = 0; index < count; index++)
        is_set[index] = !setsockopt(file, settings[index].level, settings[index].number, &settings[index].value, sizeof(int));
    for (int index = 0; index < count; index++) told[index] = option(file, settings[index].level, settings[index].number);
    wait_here();
    for (int index = 0; index < count; index++) {
        int found = option(file, settings[index].level, settings[index].number);
        EXPECT(!is_set[index] || found == told[index], "option %d of level %d is %d, was %d", settings[index].number,
               settings[index].level, found, told[index]);
    }
}
#define KEEP(file, ...) \
    do { \
        static const struct setting settings[] = {__VA_ARGS__}; \
        keep_settings(file, settings, sizeof settings / sizeof *settings); \
    } while (0)

/* SO_DEBUG, SELECT_ERR_QUEUE, TXREHASH, RCVMARK, RCVPRIORITY; what comes with a datagram; UDP_ENCAP. */
static void of_datagrams(void) {
    KEEP(socket(AF_INET, SOCK_DGRAM, 0), {SOL_SOCKET, 1, 1}, {SOL_SOCKET, 45, 1}, {SOL_SOCKET, 75, 1}, {SOL_SOCKET, 82, 1}, {0, 6, 1},
         {0, 7, 1}, {0, 18, 1}, {0, 23, 1}, {0, 25, 1}, {0, 26, 1}, {IPPROTO_UDP, 100, 2}, {SOL_SOCKET, 63, 1});
}

static void of_datagrams_6(void) {
    KEEP(socket(AF_INET6, SOCK_DGRAM, 0), {41, 2, 1}, {41, 3, 1}, {41, 4, 1}, {41, 5, 1}, {41, 8, 1}, {41, 11, 1}, {41, 30, 1},
         {41, 31, 1}, {41, 33, 1}, {41, 77, 1}, {SOL_SOCKET, 64, 1}, {SOL_SOCKET, 65, 0x18});
}

/* TCP_MAXSEG, THIN_LINEAR_TIMEOUTS, SAVE_SYN, FASTOPEN_NO_COOKIE, RTO_MAX_MS, RTO_MIN_US, DELACK_MAX_US. */
#define OF_TCP \
    {6, 2, 777}, {6, 16, 1}, {6, 27, 1}, {6, 34, 1}, {6, 44, 5000}, {6, 45, 5000}, {6, 46, 5000}, {SOL_SOCKET, 74, 0}, {SOL_SOCKET, 75, 1}

static void of_streams(void) { KEEP(socket(AF_INET, SOCK_STREAM, 0), OF_TCP); }

static void of_listeners(void) {
    struct sockaddr_storage address;
    int file = bound(AF_INET6, SOCK_STREAM, "::1", 0, &address);
    if (listen(file, 3)) cannot("listen");
    KEEP(file, OF_TCP);
}

/* SO_PASSPIDFD, PASSRIGHTS. */
static void of_unix(void) {
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends)) cannot("make a pair");
    KEEP(ends[0], {SOL_SOCKET, 76, 1}, {SOL_SOCKET, 83, 0});
}

/* IPV6_CHECKSUM, HDRINCL. */
static void of_raw_6(void) { KEEP(socket(AF_INET6, SOCK_RAW, 89), {41, 7, 2}, {41, 36, 1}); }

/* IP_ROUTER_ALERT, NODEFRAG. */
static void of_raw(void) { KEEP(socket(AF_INET, SOCK_RAW, 46), {0, 5, 1}, {0, 22, 1}); }

/* Protocols of other families, and raw sockets, that have the number of TCP. */
static void numbered_like_tcp(void) {
    int policies = socket(AF_NETLINK, SOCK_RAW, 6 /* NETLINK_XFRM */), raw = socket(AF_INET, SOCK_RAW, IPPROTO_TCP);
    int raw_6 = socket(AF_INET6, SOCK_RAW, IPPROTO_TCP);
    if (policies < 0 || raw < 0 || raw_6 < 0) cannot("make sockets");
    wait_here();
    EXPECT_EQUAL("protocol", option(policies, SOL_SOCKET, SO_PROTOCOL), 6);
    EXPECT_EQUAL("type", option(raw, SOL_SOCKET, SO_TYPE), SOCK_RAW);
    EXPECT_EQUAL("protocol", option(raw_6, SOL_SOCKET, SO_PROTOCOL), IPPROTO_TCP);
}

static void send_to(int sender, const char *text, const struct sockaddr_storage *target) {
    socklen_t size = target->ss_family == AF_INET ? 16 : 28;
    if (sendto(sender, text, strlen(text), 0, (const struct sockaddr *)target, size) != (ssize_t)strlen(text)) cannot("send");
}

static void expect_from(int receiver, const char *wanted, const struct sockaddr_storage *sender) {
    struct sockaddr_storage from = {0};
    socklen_t size = sizeof from;
    char found[20] = "";
    recvfrom(receiver, found, sizeof found - 1, MSG_DONTWAIT, (struct sockaddr *)&from, &size);
    EXPECT(!strcmp(found, wanted), "'%s' waited, not '%s'", found, wanted);
    in_port_t got = ((struct sockaddr_in *)&from)->sin_port, sent = ((const struct sockaddr_in *)sender)->sin_port;
    EXPECT(got == sent, "'%s' came from port %d, not %d", wanted, ntohs(got), ntohs(sent));
}

/* Datagrams that wait, of senders that are bound to a port and to no address, as one is that has just sent. */
static void wide_senders(void) {
    struct sockaddr_storage at, at_6, four, six;
    int receiver = bound(AF_INET, SOCK_DGRAM, "127.0.0.1", 0, &at), receiver_6 = bound(AF_INET6, SOCK_DGRAM, "::", 0, &at_6);
    int sender = bound(AF_INET, SOCK_DGRAM, "0.0.0.0", 0, &four), sender_6 = bound(AF_INET6, SOCK_DGRAM, "::", 0, &six);
    struct sockaddr_in6 mapped = *(struct sockaddr_in6 *)&at_6, own = mapped;
    struct sockaddr_in plain = {.sin_family = AF_INET, .sin_port = mapped.sin6_port, .sin_addr.s_addr = htonl(0x7f000001)};
    inet_pton(AF_INET6, "::1", &own.sin6_addr), inet_pton(AF_INET6, "::ffff:127.0.0.1", &mapped.sin6_addr);
    send_to(sender, "four", &at);
    send_to(sender_6, "six", (void *)&own), send_to(sender_6, "mapped", (void *)&mapped);
    if (sendto(sender, "plain", 5, 0, (struct sockaddr *)&plain, 16) != 5) cannot("send");
    set(sender, IPPROTO_UDP, 1 /* UDP_CORK */, 1);
    wait_here();
    EXPECT_EQUAL("cork", option(sender, IPPROTO_UDP, 1), 1);
    expect_from(receiver, "four", &four);
    expect_from(receiver_6, "six", &six), expect_from(receiver_6, "mapped", &six), expect_from(receiver_6, "plain", &four);
}

int main(int count, char **arguments) {
    static const struct socket_case cases[] = {
        {"of_datagrams", of_datagrams},
        {"of_datagrams_6", of_datagrams_6},
        {"of_streams", of_streams},
        {"of_listeners", of_listeners},
        {"of_unix", of_unix},
        {"of_raw", of_raw},
        {"of_raw_6", of_raw_6},
        {"numbered_like_tcp", numbered_like_tcp},
        {"wide_senders", wide_senders},
    };
    return run_case(count, arguments, cases, sizeof cases / sizeof *cases);
}
