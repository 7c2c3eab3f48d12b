/* An unmodified program: it commands the actuator in each step. count NAME ACTUATOR PERIOD_MS */
#define _GNU_SOURCE
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { BALLAST = 1 << 20, PAGE = 4096 };
static unsigned char ballast[BALLAST]; /* a part of it is written in each step: something to capture */

static void command(const char *path, const char *said) {
    struct sockaddr_un to = {.sun_family = AF_UNIX};
    int link = socket(AF_UNIX, SOCK_DGRAM, 0);
    strncpy(to.sun_path, path, sizeof to.sun_path - 1);
    if (link < 0) return;
    sendto(link, said, strlen(said), 0, (struct sockaddr *)&to, sizeof to);
    close(link);
}

int main(int count, char **words) {
    uint32_t seal = 0, dice;
    char said[512], network[64];
    if (count != 4) return 2;
    long period_ns = atol(words[3]) * 1000000;
    for (unsigned long step = 1;; step++) {
        uint32_t before = seal;
        if (getrandom(&dice, sizeof dice, 0) != sizeof dice) return 1;
        seal = (seal * 31 + dice) | 1;
        memcpy(ballast + step * PAGE % BALLAST, &seal, sizeof seal);
        ssize_t size = readlink("/proc/self/ns/net", network, sizeof network - 1);
        network[size < 0 ? 0 : size] = 0;
        const char *epoch = getenv("FAILOVER_EPOCH");
        snprintf(said, sizeof said, "%s %lu %u %u %s %s", words[1], step, before, seal, epoch ? epoch : "0", network);
        command(words[2], said);
        snprintf(said, sizeof said, "%lu %u\n", step, seal);
        if (write(1, said, strlen(said)) < 0) return 1;
        struct timespec pause = {.tv_nsec = period_ns};
        nanosleep(&pause, NULL);
    }
}
