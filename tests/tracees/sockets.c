/* Sockets of the program's own: pairs, listeners, datagrams; the case is named by the second argument. */
#include "sockets.h"

#include <linux/filter.h>

static void make_pair(int kind, int ends[2]) {
    if (socketpair(AF_UNIX, kind, 0, ends)) cannot("make a pair of sockets");
}

/* unix sockets */

static void pair_stream(void) {
    int ends[2];
    make_pair(SOCK_STREAM | SOCK_CLOEXEC, ends);
    fcntl(ends[1], F_SETFL, O_NONBLOCK);
    say(ends[0], "one "), say(ends[0], "two"), say(ends[1], "back");
    wait_here();
    expect_text(ends[1], "one two"), expect_text(ends[0], "back");
    expect_nothing(ends[0]), expect_nothing(ends[1]);
    say(ends[1], "again"), expect_text(ends[0], "again");
    EXPECT_EQUAL("flags", fcntl(ends[1], F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    EXPECT_EQUAL("flags", fcntl(ends[0], F_GETFL) & O_NONBLOCK, 0);
    EXPECT_EQUAL("mark", fcntl(ends[0], F_GETFD), FD_CLOEXEC);
    close(ends[0]);
    char byte;
    EXPECT(recv(ends[1], &byte, 1, 0) == 0, "no end");
}

static void pair_datagrams(int kind) {
    int ends[2];
    make_pair(kind, ends);
    say(ends[0], "one"), say(ends[0], "two"), say(ends[0], "three");
    wait_here();
    expect_text(ends[1], "one"), expect_text(ends[1], "two"), expect_text(ends[1], "three");
    expect_nothing(ends[1]);
    say(ends[1], "back"), expect_text(ends[0], "back");
}

static void pair_datagram(void) { pair_datagrams(SOCK_DGRAM); }
static void pair_packets(void) { pair_datagrams(SOCK_SEQPACKET); }

static void pair_much(void) {
    int ends[2];
    char piece[1000];
    uint64_t sent = 0, found = 0;
    make_pair(SOCK_STREAM | SOCK_NONBLOCK, ends);
    set(ends[0], SOL_SOCKET, SO_SNDBUF, 400000);
    for (;; sent += sizeof piece / 8) {
        fill(piece, sizeof piece, sent);
        if (send(ends[0], piece, sizeof piece, 0) != sizeof piece) break;
    }
    int buffer = option(ends[0], SOL_SOCKET, SO_SNDBUF);
    wait_here();
    EXPECT_EQUAL("buffer", option(ends[0], SOL_SOCKET, SO_SNDBUF), buffer);
    for (; recv(ends[1], piece, sizeof piece, MSG_WAITALL) == sizeof piece; found += sizeof piece / 8)
        expect_filled("piece", piece, sizeof piece, found);
    EXPECT_EQUAL("pieces", found, sent);
}

static void pair_options(void) {
    int ends[2];
    make_pair(SOCK_STREAM, ends);
    set(ends[1], SOL_SOCKET, SO_PASSCRED, 1);
    struct timeval wait = {3, 250000}, found;
    setsockopt(ends[0], SOL_SOCKET, SO_RCVTIMEO, &wait, sizeof wait);
    wait_here();
    socklen_t size = sizeof found;
    getsockopt(ends[0], SOL_SOCKET, SO_RCVTIMEO, &found, &size);
    EXPECT(found.tv_sec == 3, "timeout: %ld.%06ld", (long)found.tv_sec, (long)found.tv_usec);
    EXPECT_EQUAL("credentials", option(ends[1], SOL_SOCKET, SO_PASSCRED), 1);
    EXPECT_EQUAL("credentials", option(ends[0], SOL_SOCKET, SO_PASSCRED), 0);
}

static void pass(int file, const char *text, const int *passed, int count) {
    char room[CMSG_SPACE(4 * sizeof(int))] = {0};
    struct iovec content = {(char *)text, strlen(text)};
    struct msghdr message = {.msg_iov = &content, .msg_iovlen = 1, .msg_control = room, .msg_controllen = CMSG_SPACE(count * sizeof(int))};
    struct cmsghdr *rights = CMSG_FIRSTHDR(&message);
    rights->cmsg_level = SOL_SOCKET, rights->cmsg_type = SCM_RIGHTS, rights->cmsg_len = CMSG_LEN(count * sizeof(int));
    memcpy(CMSG_DATA(rights), passed, count * sizeof(int));
    if (sendmsg(file, &message, 0) != (ssize_t)strlen(text)) cannot("pass descriptors");
}

static int receive(int file, const char *wanted, int *passed) {
    char found[100] = "", room[CMSG_SPACE(4 * sizeof(int))];
    struct iovec content = {found, sizeof found - 1};
    struct msghdr message = {.msg_iov = &content, .msg_iovlen = 1, .msg_control = room, .msg_controllen = sizeof room};
    recvmsg(file, &message, MSG_DONTWAIT);
    EXPECT(!strcmp(found, wanted), "'%s' came, not '%s'", found, wanted);
    struct cmsghdr *rights = CMSG_FIRSTHDR(&message);
    if (!rights) return 0;
    memcpy(passed, CMSG_DATA(rights), rights->cmsg_len - CMSG_LEN(0));
    return (rights->cmsg_len - CMSG_LEN(0)) / sizeof(int);
}

static void pair_rights(int kind) {
    int ends[2], pipes[2], passed[4];
    make_pair(kind, ends);
    if (pipe(pipes)) cannot("make a pipe");
    int file = open("passed", O_RDWR | O_CREAT, 0600), both[] = {file, pipes[1]};
    say(ends[0], "plain"), pass(ends[0], "two", both, 2), pass(ends[0], "itself", &ends[1], 1);
    wait_here();
    if (kind == SOCK_DGRAM) EXPECT_EQUAL("passed", receive(ends[1], "plain", passed), 0);
    EXPECT_EQUAL("passed", receive(ends[1], kind == SOCK_DGRAM ? "two" : "plaintwo", passed), 2);
    EXPECT(write(passed[1], "x", 1) == 1 && read(pipes[0], both, 1) == 1, "it is not the pipe");
    lseek(file, 77, SEEK_SET);
    EXPECT_EQUAL("offset", lseek(passed[0], 0, SEEK_CUR), 77);
    EXPECT_EQUAL("passed", receive(ends[1], "itself", passed), 1);
    say(ends[0], "more"), expect_text(passed[0], "more");
}

static void rights_stream(void) { pair_rights(SOCK_STREAM); }
static void rights_datagram(void) { pair_rights(SOCK_DGRAM); }

static void pair_half_closed(void) {
    int ends[2];
    char byte;
    make_pair(SOCK_STREAM, ends);
    say(ends[0], "last"), shutdown(ends[0], SHUT_WR);
    wait_here();
    expect_text(ends[1], "last");
    EXPECT(recv(ends[1], &byte, 1, MSG_DONTWAIT) == 0, "it is not shut down: %s", strerror(errno));
    say(ends[1], "back"), expect_text(ends[0], "back");
}

static void pair_orphan(void) {
    int ends[2];
    char byte;
    make_pair(SOCK_STREAM, ends);
    say(ends[0], "last"), close(ends[0]);
    wait_here();
    expect_text(ends[1], "last");
    EXPECT(recv(ends[1], &byte, 1, MSG_DONTWAIT) == 0, "it is not at its end");
    EXPECT(send(ends[1], "x", 1, MSG_NOSIGNAL) == -1 && errno == EPIPE, "somebody is there");
}

static struct sockaddr_un unix_address(const char *name, socklen_t *size) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    size_t length = strlen(name + 1) + 1;
    memcpy(address.sun_path, name, length);
    *size = offsetof(struct sockaddr_un, sun_path) + length + (name[0] != 0);
    return address;
}

static int unix_bound(int kind, const char *name) {
    socklen_t size;
    struct sockaddr_un address = unix_address(name, &size);
    int file = socket(AF_UNIX, kind, 0);
    if (file < 0 || bind(file, (struct sockaddr *)&address, size)) cannot("bind");
    return file;
}

static int unix_connected(int kind, const char *name) {
    socklen_t size;
    struct sockaddr_un address = unix_address(name, &size);
    int file = socket(AF_UNIX, kind, 0);
    if (connect(file, (struct sockaddr *)&address, size)) differs("cannot connect to %s: %s", name, strerror(errno));
    return file;
}

static void listener(const char *name) {
    int listens = unix_bound(SOCK_STREAM, name);
    if (name[0]) chmod(name, 0740);
    listen(listens, 5);
    wait_here();
    EXPECT_EQUAL("listens", option(listens, SOL_SOCKET, SO_ACCEPTCONN), 1);
    int client = unix_connected(SOCK_STREAM, name), accepted = accept(listens, NULL, NULL);
    say(client, "hello"), expect_text(accepted, "hello");
    struct stat about;
    if (name[0]) EXPECT(stat(name, &about) == 0 && (about.st_mode & 0777) == 0740, "mode %o", about.st_mode);
}

static void listener_path(void) { listener("listens.sock"); }
static void listener_abstract(void) {
    static char name[40];
    snprintf(name + 1, 30, "failover-tracee-%d", getpid());
    listener(name);
}

static void unix_with_itself(void) {
    int listens = unix_bound(SOCK_STREAM, "own.sock");
    listen(listens, 1);
    int client = unix_connected(SOCK_STREAM, "own.sock"), accepted = accept(listens, NULL, NULL);
    close(listens);
    say(client, "to the server"), say(accepted, "to the client");
    wait_here();
    expect_text(accepted, "to the server"), expect_text(client, "to the client");
    struct sockaddr_un name = {0};
    socklen_t size = sizeof name;
    EXPECT(getpeername(client, (struct sockaddr *)&name, &size) == 0 && !strcmp(name.sun_path, "own.sock"), "its peer is '%s'",
           name.sun_path);
}

static void unix_datagrams(void) {
    int server = unix_bound(SOCK_DGRAM, "server.sock"), client = unix_connected(SOCK_DGRAM, "server.sock");
    say(client, "one"), say(client, "two");
    wait_here();
    expect_text(server, "one"), expect_text(server, "two"), expect_nothing(server);
    say(client, "three"), expect_text(server, "three");
}

static void unix_fresh(void) {
    int fresh = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0);
    wait_here();
    EXPECT(recv(fresh, &fresh, 1, 0) == -1, "it is connected");
    EXPECT_EQUAL("kind", option(fresh, SOL_SOCKET, SO_TYPE), SOCK_STREAM);
}

/* TCP and UDP */

static void tcp_listener(int family, const char *host) {
    struct sockaddr_storage address;
    int listens = bound(family, SOCK_STREAM, host, 0, &address);
    set(listens, IPPROTO_TCP, TCP_NODELAY, 1), set(listens, IPPROTO_TCP, TCP_KEEPIDLE, 77), set(listens, SOL_SOCKET, SO_KEEPALIVE, 1);
    listen(listens, 7);
    wait_here();
    expect_same_name(listens, &address);
    struct tcp_info about;
    socklen_t size = sizeof about;
    getsockopt(listens, IPPROTO_TCP, TCP_INFO, &about, &size);
    EXPECT_EQUAL("backlog", about.tcpi_sacked, 7);
    EXPECT_EQUAL("idle time", option(listens, IPPROTO_TCP, TCP_KEEPIDLE), 77);
    EXPECT_EQUAL("no delay", option(listens, IPPROTO_TCP, TCP_NODELAY), 1);
    int client = socket(family, SOCK_STREAM, 0);
    EXPECT(connect(client, (struct sockaddr *)&address, size < 28 ? 16 : 28) == 0, "cannot connect: %s", strerror(errno));
    int accepted = accept(listens, NULL, NULL);
    say(client, "hello");
    poll(&(struct pollfd){accepted, POLLIN, 0}, 1, 5000);
    expect_text(accepted, "hello");
}

static void tcp_listener_4(void) { tcp_listener(AF_INET, "127.0.0.1"); }
static void tcp_listener_6(void) { tcp_listener(AF_INET6, "::1"); }

static void tcp_fresh(void) {
    struct sockaddr_storage address;
    int fresh = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0), named = bound(AF_INET, SOCK_STREAM, "127.0.0.1", 0, &address);
    set(fresh, IPPROTO_TCP, TCP_USER_TIMEOUT, 1234);
    struct linger lingers = {1, 9}, found = {0};
    setsockopt(fresh, SOL_SOCKET, SO_LINGER, &lingers, sizeof lingers);
    wait_here();
    socklen_t size = sizeof found;
    getsockopt(fresh, SOL_SOCKET, SO_LINGER, &found, &size);
    EXPECT(found.l_onoff == 1 && found.l_linger == 9, "it lingers %d %d", found.l_onoff, found.l_linger);
    EXPECT_EQUAL("timeout", option(fresh, IPPROTO_TCP, TCP_USER_TIMEOUT), 1234);
    EXPECT_EQUAL("flags", fcntl(fresh, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    expect_same_name(named, &address);
}

/* Two listeners at one port, of which one would not share it any more. */
static void tcp_shared_port(void) {
    struct sockaddr_storage address;
    socklen_t size = sizeof address;
    int files[2];
    memset(&address, 0, size), address.ss_family = AF_INET;
    for (int index = 0; index < 2; index++) {
        files[index] = socket(AF_INET, SOCK_STREAM, 0);
        set(files[index], SOL_SOCKET, SO_REUSEPORT, 1);
        if (bind(files[index], (struct sockaddr *)&address, 16) || listen(files[index], 3)) cannot("listen");
        getsockname(files[index], (struct sockaddr *)&address, &size);
    }
    set(files[0], SOL_SOCKET, SO_REUSEPORT, 0);
    wait_here();
    for (int index = 0; index < 2; index++) {
        expect_same_name(files[index], &address);
        EXPECT_EQUAL("listens", option(files[index], SOL_SOCKET, SO_ACCEPTCONN), 1);
        EXPECT_EQUAL("shares", option(files[index], SOL_SOCKET, SO_REUSEPORT), index);
    }
}

static void udp_queue(void) {
    struct sockaddr_storage address, sender_address, from;
    int receiver = bound(AF_INET, SOCK_DGRAM, "127.0.0.1", 0, &address);
    int sender = bound(AF_INET, SOCK_DGRAM, "127.0.0.1", 0, &sender_address), other = socket(AF_INET, SOCK_DGRAM, 0);
    if (connect(sender, (struct sockaddr *)&address, 16)) cannot("connect");
    say(sender, "one"), say(sender, "two");
    if (sendto(other, "three", 5, 0, (struct sockaddr *)&address, 16) != 5) cannot("send");
    close(other);
    wait_here();
    expect_same_name(receiver, &address), expect_same_name(sender, &sender_address);
    char found[20] = "";
    socklen_t size = sizeof from;
    EXPECT(recvfrom(receiver, found, 20, MSG_DONTWAIT, (struct sockaddr *)&from, &size) == 3 && !strcmp(found, "one"), "not one");
    EXPECT(!memcmp(&from, &sender_address, 8), "it came from somebody else");
    expect_text(receiver, "two"), expect_text(receiver, "three"), expect_nothing(receiver);
    say(sender, "more");
    poll(&(struct pollfd){receiver, POLLIN, 0}, 1, 5000);
    expect_text(receiver, "more");
}

static void udp_options(void) {
    struct sockaddr_storage address;
    int file = bound(AF_INET6, SOCK_DGRAM, "::", 0, &address), fresh = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    set(fresh, SOL_SOCKET, SO_BROADCAST, 1), set(fresh, IPPROTO_IP, IP_TTL, 9), set(fresh, IPPROTO_IP, IP_TOS, 0x10);
    set(fresh, SOL_SOCKET, SO_RCVBUF, 50000), set(fresh, IPPROTO_IP, IP_MULTICAST_TTL, 4), set(fresh, IPPROTO_IP, IP_MULTICAST_LOOP, 0);
    set(file, IPPROTO_IPV6, IPV6_RECVPKTINFO, 1);
    int buffer = option(fresh, SOL_SOCKET, SO_RCVBUF), other = option(file, SOL_SOCKET, SO_RCVBUF);
    wait_here();
    EXPECT_EQUAL("broadcast", option(fresh, SOL_SOCKET, SO_BROADCAST), 1);
    EXPECT_EQUAL("hops", option(fresh, IPPROTO_IP, IP_TTL), 9);
    EXPECT_EQUAL("service", option(fresh, IPPROTO_IP, IP_TOS), 0x10);
    EXPECT_EQUAL("buffer", option(fresh, SOL_SOCKET, SO_RCVBUF), buffer);
    EXPECT_EQUAL("usual buffer", option(file, SOL_SOCKET, SO_RCVBUF), other);
    EXPECT_EQUAL("hops of a group", option(fresh, IPPROTO_IP, IP_MULTICAST_TTL), 4);
    EXPECT_EQUAL("loop", option(fresh, IPPROTO_IP, IP_MULTICAST_LOOP), 0);
    EXPECT_EQUAL("information", option(file, IPPROTO_IPV6, IPV6_RECVPKTINFO), 1);
    expect_same_name(file, &address);
}

/* What sifts a socket's messages, and a buffer that was set to what is usual: it does not grow by itself. */
static void filtered(void) {
    struct sock_filter wanted[] = {{0x28, 0, 0, 12}, {0x15, 0, 1, 0x0800}, {0x06, 0, 0, 0xffff}, {0x06, 0, 0, 3}}, found[8];
    struct sock_fprog program = {4, wanted};
    struct sockaddr_storage address;
    int receiver = bound(AF_INET, SOCK_DGRAM, "127.0.0.1", 0, &address), stream = socket(AF_INET, SOCK_STREAM, 0), ends[2];
    socklen_t count = 8, size = sizeof found;
    if (setsockopt(receiver, SOL_SOCKET, SO_ATTACH_FILTER, &program, sizeof program)) cannot("attach a filter");
    set(receiver, SOL_SOCKET, SO_LOCK_FILTER, 1);
    program.len = 1, program.filter = wanted + 3;
    if (socketpair(AF_UNIX, SOCK_DGRAM, 0, ends)) cannot("make a pair");
    if (setsockopt(ends[1], SOL_SOCKET, SO_ATTACH_FILTER, &program, sizeof program)) cannot("attach a filter");
    set(stream, SOL_SOCKET, SO_SNDBUF, option(stream, SOL_SOCKET, SO_SNDBUF) / 2);
    wait_here();
    memset(found, 0, sizeof found);
    EXPECT(getsockopt(receiver, SOL_SOCKET, SO_GET_FILTER, found, &count) == 0 && count == 4, "the filter has %u steps", count);
    EXPECT(!memcmp(found, wanted, sizeof wanted), "it is another filter");
    EXPECT_EQUAL("lock", option(receiver, SOL_SOCKET, SO_LOCK_FILTER), 1);
    EXPECT_EQUAL("locks of the buffers", option(stream, SOL_SOCKET, 72 /* SO_BUF_LOCK */), 1);
    say(ends[0], "cut off");
    EXPECT((size = read(ends[1], found, sizeof found)) == 3, "%u bytes came through", size);
}

static int is_member(int file, const char *group) {
    char line[200];
    struct in_addr wanted;
    int found = 0;
    (void)file;
    inet_aton(group, &wanted);
    FILE *groups = fopen("/proc/self/net/igmp", "r");
    while (groups && fgets(line, sizeof line, groups)) found |= line[0] == '\t' && strtoul(line, NULL, 16) == wanted.s_addr;
    if (groups) fclose(groups);
    return found;
}

static void udp_group(void) {
    struct sockaddr_storage address;
    int file = bound(AF_INET, SOCK_DGRAM, "0.0.0.0", 0, &address);
    struct ip_mreqn request = {.imr_ifindex = if_nametoindex("lo")};
    inet_aton("239.255.77.78", &request.imr_multiaddr);
    if (setsockopt(file, IPPROTO_IP, IP_ADD_MEMBERSHIP, &request, sizeof request)) cannot("join a group");
    wait_here();
    EXPECT(is_member(file, "239.255.77.78"), "the group is left");
    EXPECT(setsockopt(file, IPPROTO_IP, IP_ADD_MEMBERSHIP, &request, sizeof request) == -1 && errno == EADDRINUSE, "it joins anew");
}

/* A socket of IPv6 that is in a group of IPv4. */
static void udp_group_of_other_family(void) {
    struct sockaddr_storage address;
    int file = bound(AF_INET6, SOCK_DGRAM, "::", 0, &address);
    struct ip_mreqn request = {.imr_ifindex = if_nametoindex("lo")};
    inet_aton("239.255.77.79", &request.imr_multiaddr);
    if (setsockopt(file, IPPROTO_IP, IP_ADD_MEMBERSHIP, &request, sizeof request)) cannot("join a group");
    wait_here();
    EXPECT(is_member(file, "239.255.77.79"), "the group is left");
    EXPECT(setsockopt(file, IPPROTO_IP, IP_ADD_MEMBERSHIP, &request, sizeof request) == -1 && errno == EADDRINUSE, "it joins anew");
}

int main(int count, char **arguments) {
    static const struct socket_case cases[] = {
        {"pair_stream", pair_stream},
        {"pair_datagram", pair_datagram},
        {"pair_packets", pair_packets},
        {"pair_much", pair_much},
        {"pair_options", pair_options},
        {"rights_stream", rights_stream},
        {"rights_datagram", rights_datagram},
        {"pair_half_closed", pair_half_closed},
        {"pair_orphan", pair_orphan},
        {"listener_path", listener_path},
        {"listener_abstract", listener_abstract},
        {"unix_with_itself", unix_with_itself},
        {"unix_datagrams", unix_datagrams},
        {"unix_fresh", unix_fresh},
        {"tcp_listener_4", tcp_listener_4},
        {"tcp_listener_6", tcp_listener_6},
        {"tcp_fresh", tcp_fresh},
        {"tcp_shared_port", tcp_shared_port},
        {"udp_queue", udp_queue},
        {"udp_options", udp_options},
        {"filtered", filtered},
        {"udp_group", udp_group},
        {"udp_group_of_other_family", udp_group_of_other_family},
    };
    return run_case(count, arguments, cases, sizeof cases / sizeof *cases);
}
