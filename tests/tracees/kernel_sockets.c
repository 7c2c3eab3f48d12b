/* Sockets that lead to the kernel or to an interface alone, while nothing waits in them; the case is named by the second argument. */
#include "sockets.h"

#include <linux/filter.h>
#include <linux/icmp.h>
#include <linux/if_packet.h>
#include <linux/netlink.h>
#include <linux/rtnetlink.h>
#include <net/ethernet.h>

static void expect_members(int file, unsigned wanted) {
    unsigned groups[4] = {0};
    socklen_t size = sizeof groups;
    getsockopt(file, SOL_NETLINK, NETLINK_LIST_MEMBERSHIPS, groups, &size);
    EXPECT_EQUAL("groups", groups[0], wanted);
}

static void netlink(void) {
    int routes = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_ROUTE), events = socket(AF_NETLINK, SOCK_DGRAM, NETLINK_KOBJECT_UEVENT);
    int fresh = socket(AF_NETLINK, SOCK_RAW | SOCK_NONBLOCK, NETLINK_ROUTE), generic = socket(AF_NETLINK, SOCK_RAW, NETLINK_GENERIC);
    struct sockaddr_nl name = {.nl_family = AF_NETLINK, .nl_groups = RTMGRP_NOTIFY}, found = {0};
    socklen_t size = sizeof found;
    if (bind(routes, (struct sockaddr *)&name, sizeof name)) cannot("bind");
    set(routes, SOL_NETLINK, NETLINK_ADD_MEMBERSHIP, RTNLGRP_TC), set(routes, SOL_NETLINK, NETLINK_EXT_ACK, 1);
    name.nl_groups = 0, name.nl_pid = 4000000;
    if (bind(events, (struct sockaddr *)&name, sizeof name)) cannot("bind");
    name.nl_pid = 0;
    if (connect(generic, (struct sockaddr *)&name, sizeof name)) cannot("connect");
    getsockname(routes, (struct sockaddr *)&name, &size);
    wait_here();
    getsockname(routes, (struct sockaddr *)&found, &size);
    EXPECT_EQUAL("number", found.nl_pid, name.nl_pid);
    getsockname(events, (struct sockaddr *)&found, &size);
    EXPECT_EQUAL("number", found.nl_pid, 4000000);
    expect_members(routes, RTMGRP_NOTIFY | 1 << (RTNLGRP_TC - 1)), expect_members(events, 0);
    EXPECT_EQUAL("option", option(routes, SOL_NETLINK, NETLINK_EXT_ACK), 1);
    EXPECT_EQUAL("flags", fcntl(fresh, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    struct {
        struct nlmsghdr head;
        struct rtgenmsg what;
    } request = {{sizeof request, RTM_GETLINK, NLM_F_REQUEST | NLM_F_DUMP, 1, 0}, {AF_UNSPEC}};
    char answer[8192];
    send(routes, &request, sizeof request, 0);
    EXPECT(recv(routes, answer, sizeof answer, 0) > 16, "the kernel does not answer");
}

static void raw(void) {
    struct sockaddr_in address = {.sin_family = AF_INET};
    struct sockaddr_in6 six = {.sin6_family = AF_INET6};
    int echoes = socket(AF_INET, SOCK_RAW, IPPROTO_ICMP), own = socket(AF_INET, SOCK_RAW, IPPROTO_RAW), other;
    struct icmp_filter filter = {~(1U << ICMP_ECHOREPLY)}, found = {0};
    socklen_t size = sizeof found;
    address.sin_addr.s_addr = htonl(0x7f000001), inet_pton(AF_INET6, "::1", &six.sin6_addr);
    if (setsockopt(echoes, 255, ICMP_FILTER, &filter, sizeof filter)) cannot("filter");
    if (bind(echoes, (struct sockaddr *)&address, 16) || connect(echoes, (struct sockaddr *)&address, 16)) cannot("bind");
    other = socket(AF_INET6, SOCK_RAW, 253);
    if (bind(other, (struct sockaddr *)&six, 28)) cannot("bind");
    set(own, IPPROTO_IP, IP_HDRINCL, 0), set(other, IPPROTO_IPV6, IPV6_UNICAST_HOPS, 7);
    wait_here();
    EXPECT_EQUAL("header", option(own, IPPROTO_IP, IP_HDRINCL), 0);
    EXPECT_EQUAL("hops", option(other, IPPROTO_IPV6, IPV6_UNICAST_HOPS), 7);
    getsockopt(echoes, 255, ICMP_FILTER, &found, &size);
    EXPECT_EQUAL("filter", found.data, filter.data);
    struct icmphdr echo = {.type = ICMP_ECHO, .checksum = htons(0xf7ff - 7), .un.echo.id = htons(7)};
    char answer[100] = "";
    EXPECT(send(echoes, &echo, sizeof echo, 0) == sizeof echo, "it is not connected: %s", strerror(errno));
    poll(&(struct pollfd){echoes, POLLIN, 0}, 1, 5000);
    EXPECT(recv(echoes, answer, sizeof answer, MSG_DONTWAIT) == 28 && answer[20] == ICMP_ECHOREPLY, "no echo");
    EXPECT(sendto(other, "x", 1, 0, (struct sockaddr *)&six, 28) == 1 && recv(other, answer, 10, 0) == 1, "nothing comes back");
}

static void light_datagrams(void) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(0x7f000001)}, from;
    int receiver = socket(AF_INET, SOCK_DGRAM, IPPROTO_UDPLITE), sender = socket(AF_INET, SOCK_DGRAM, IPPROTO_UDPLITE);
    socklen_t size = sizeof address;
    if (receiver < 0 || bind(receiver, (struct sockaddr *)&address, 16)) cannot("make a socket of UDP-Lite");
    getsockname(receiver, (struct sockaddr *)&address, &size);
    if (connect(sender, (struct sockaddr *)&address, 16)) cannot("connect");
    set(sender, IPPROTO_UDPLITE, 10 /* UDPLITE_SEND_CSCOV */, 12), say(sender, "waits");
    int other = socket(AF_INET, SOCK_DGRAM, IPPROTO_UDPLITE);
    sendto(other, "of somebody", 11, 0, (struct sockaddr *)&address, 16), close(other);
    wait_here();
    EXPECT_EQUAL("coverage", option(sender, IPPROTO_UDPLITE, 10), 12);
    char found[20] = "";
    getsockname(sender, (struct sockaddr *)&address, &size);
    EXPECT(recvfrom(receiver, found, 20, MSG_DONTWAIT, (struct sockaddr *)&from, &size) == 5 && from.sin_port == address.sin_port,
           "'%s' came from port %d", found, ntohs(from.sin_port));
    expect_text(receiver, "of somebody"), say(sender, "more");
    poll(&(struct pollfd){receiver, POLLIN, 0}, 1, 5000);
    expect_text(receiver, "more");
}

static void packets(void) {
    struct sock_filter nothing[] = {{0x06, 0, 0, 0}};
    struct sock_fprog program = {1, nothing};
    int lo = if_nametoindex("lo"), sees = socket(AF_PACKET, SOCK_RAW, 0), ring = socket(AF_PACKET, SOCK_DGRAM, 0);
    struct sockaddr_ll address = {.sll_family = AF_PACKET, .sll_protocol = htons(0x88b5), .sll_ifindex = lo}, found = {0};
    struct packet_mreq request = {.mr_ifindex = lo, .mr_type = PACKET_MR_MULTICAST, .mr_alen = 6, .mr_address = {1, 0, 94, 1, 2, 3}};
    struct tpacket_req pages = {.tp_block_size = PAGE, .tp_block_nr = 2, .tp_frame_size = 2048, .tp_frame_nr = 2 * PAGE / 2048};
    socklen_t size = sizeof address;
    if (sees < 0 || setsockopt(ring, SOL_SOCKET, SO_ATTACH_FILTER, &program, sizeof program)) cannot("make packet sockets");
    if (bind(sees, (struct sockaddr *)&address, sizeof address)) cannot("bind");
    for (int index = 0; index < 2; index++)
        if (setsockopt(sees, SOL_PACKET, PACKET_ADD_MEMBERSHIP, &request, sizeof request)) cannot("join");
    set(sees, SOL_PACKET, PACKET_AUXDATA, 1), set(ring, SOL_PACKET, PACKET_VERSION, TPACKET_V2);
    if (setsockopt(ring, SOL_PACKET, PACKET_RX_RING, &pages, sizeof pages)) cannot("make a ring");
    set(sees, SOL_PACKET, PACKET_FANOUT, 77 | PACKET_FANOUT_HASH << 16);
    wait_here();
    EXPECT(getsockname(sees, (struct sockaddr *)&found, &size) == 0 && found.sll_ifindex == lo && found.sll_protocol == htons(0x88b5),
           "it is bound to %d, %x", found.sll_ifindex, found.sll_protocol);
    EXPECT_EQUAL("data", option(sees, SOL_PACKET, PACKET_AUXDATA), 1);
    EXPECT_EQUAL("version", option(ring, SOL_PACKET, PACKET_VERSION), TPACKET_V2);
    EXPECT_EQUAL("fanout", option(sees, SOL_PACKET, PACKET_FANOUT) & 0xffff, 77);
    for (int index = 0; index < 3; index++) {
        int result = setsockopt(sees, SOL_PACKET, PACKET_DROP_MEMBERSHIP, &request, sizeof request);
        EXPECT(result == (index < 2 ? 0 : -1) || index == 2, "it was a member %d times", index);
    }
    EXPECT(mmap(NULL, 2 * PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, ring, 0) != MAP_FAILED, "it has no ring: %s", strerror(errno));
    EXPECT_EQUAL("filter", option(ring, SOL_SOCKET, SO_LOCK_FILTER), 0);
    char frame[64] = {[12] = (char)0x88, [13] = (char)0xb5};
    EXPECT(sendto(sees, frame, sizeof frame, 0, (struct sockaddr *)&address, sizeof address) == sizeof frame, "cannot send");
    EXPECT(recv(sees, frame, sizeof frame, 0) == sizeof frame, "nothing comes back");
}

int main(int count, char **arguments) {
    static const struct socket_case cases[] = {
        {"netlink", netlink},
        {"raw", raw},
        {"light_datagrams", light_datagrams},
        {"packets", packets},
    };
    return run_case(count, arguments, cases, sizeof cases / sizeof *cases);
}
