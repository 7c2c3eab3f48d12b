/* What tracees of sockets share: cases that are named by the second argument, and what is said and heard over a socket. */
#ifndef SOCKETS_H
#define SOCKETS_H

#include "tracee.h"

#include <arpa/inet.h>
#include <net/if.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stddef.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>

static const char *go;

__attribute__((unused)) static void wait_here(void) {
    ready();
    wait_for_go(go);
}

__attribute__((unused)) static void expect_text(int file, const char *wanted) {
    char found[200] = "";
    int size = recv(file, found, sizeof found - 1, MSG_DONTWAIT);
    EXPECT(size == (int)strlen(wanted) && !memcmp(found, wanted, size), "fd %d: received %d '%s', not '%s' (%s)", file, size,
           found, wanted, size < 0 ? strerror(errno) : "");
}

__attribute__((unused)) static void expect_nothing(int file) {
    char byte;
    EXPECT(recv(file, &byte, 1, MSG_DONTWAIT) == -1 && errno == EAGAIN, "fd %d: something is left", file);
}

__attribute__((unused)) static void say(int file, const char *text) {
    if (send(file, text, strlen(text), MSG_NOSIGNAL) != (ssize_t)strlen(text)) differs("fd %d: cannot send", file);
}

__attribute__((unused)) static int option(int file, int level, int name) {
    int value = -1;
    socklen_t size = sizeof value;
    getsockopt(file, level, name, &value, &size);
    return value;
}

__attribute__((unused)) static void set(int file, int level, int name, int value) {
    if (setsockopt(file, level, name, &value, sizeof value)) cannot("set option %d of level %d", name, level);
}

__attribute__((unused)) static int bound(int family, int kind, const char *host, int port, struct sockaddr_storage *address) {
    memset(address, 0, sizeof *address);
    struct sockaddr_in *four = (void *)address;
    struct sockaddr_in6 *six = (void *)address;
    address->ss_family = family;
    if (family == AF_INET) four->sin_port = htons(port), inet_pton(family, host, &four->sin_addr);
    else six->sin6_port = htons(port), inet_pton(family, host, &six->sin6_addr);
    int file = socket(family, kind, 0);
    set(file, SOL_SOCKET, SO_REUSEADDR, 1);
    socklen_t size = sizeof *address;
    if (bind(file, (struct sockaddr *)address, family == AF_INET ? 16 : 28)) cannot("bind to %s", host);
    getsockname(file, (struct sockaddr *)address, &size);
    return file;
}

__attribute__((unused)) static void expect_same_name(int file, const struct sockaddr_storage *wanted) {
    struct sockaddr_storage found;
    socklen_t size = sizeof found;
    memset(&found, 0, sizeof found);
    getsockname(file, (struct sockaddr *)&found, &size);
    EXPECT(!memcmp(&found, wanted, size), "fd %d: bound to something else", file);
}

struct socket_case {
    const char *name;
    void (*act)(void);
};

__attribute__((unused)) static int run_case(int count, char **arguments, const struct socket_case *cases, size_t size) {
    go = arguments[1];
    for (size_t index = 0; index < size; index++)
        if (count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}

#endif
