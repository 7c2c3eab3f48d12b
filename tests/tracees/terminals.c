/* Pseudo-terminals of the program's own, both ends; the case is named by the second argument. */
#include "tracee.h"

#include <poll.h>
#include <pty.h>
#include <sys/ioctl.h>
#include <termios.h>

static const char *go;
static int master, slave;
static char name[64];

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static void make_terminal(void) {
    if (openpty(&master, &slave, name, NULL, NULL)) cannot("open a pseudo-terminal");
}

static void expect_text(int file, const char *wanted) {
    char found[200] = "";
    size_t size = 0;
    struct pollfd there = {file, POLLIN, 0};
    while (size < strlen(wanted) && poll(&there, 1, 60000) == 1) {
        ssize_t got = read(file, found + size, strlen(wanted) - size);
        if (got <= 0) break;
        size += got;
    }
    EXPECT(!strcmp(found, wanted), "fd %d: '%s', not '%s' (%s)", file, found, wanted, strerror(errno));
}

static void say(int file, const char *text) {
    if (write(file, text, strlen(text)) != (ssize_t)strlen(text)) differs("fd %d: cannot write", file);
}

static int word(int file, unsigned long question) {
    int found = -1;
    if (ioctl(file, question, &found)) differs("ioctl %lx: %s", question, strerror(errno));
    return found;
}

static void raw(void) {
    struct termios settings;
    tcgetattr(slave, &settings);
    cfmakeraw(&settings);
    tcsetattr(slave, TCSANOW, &settings);
}

/* A line is edited, echoed and handed over; what the slave writes gets its carriage return. */
static void talk(void) {
    say(master, "hellp\177o\n");
    expect_text(master, "hellp\b \bo\r\n");
    expect_text(slave, "hello\n");
    say(slave, "back\n");
    expect_text(master, "back\r\n");
}

static void plain(void) {
    make_terminal();
    talk();
    wait_here();
    talk();
    EXPECT(!strcmp(ptsname(master) ?: "", ttyname(slave) ?: "none"), "%s leads to %s", ptsname(master), ttyname(slave));
}

static void settings(void) {
    struct termios was = {0}, now = {0}; /* the gaps between its fields, too */
    struct winsize size = {37, 111, 3, 4}, found = {0};
    make_terminal();
    tcgetattr(slave, &was);
    was.c_lflag &= ~(ECHO | ISIG), was.c_cc[VERASE] = '#', was.c_cc[VMIN] = 3, was.c_oflag &= ~ONLCR;
    cfsetspeed(&was, B19200);
    tcsetattr(slave, TCSANOW, &was);
    ioctl(master, TIOCSWINSZ, &size);
    fcntl(master, F_SETFL, O_RDWR | O_NONBLOCK);
    fcntl(slave, F_SETFD, FD_CLOEXEC);
    fchmod(slave, 0640);
    wait_here();
    tcgetattr(slave, &now);
    EXPECT(!memcmp(&now, &was, sizeof now), "the settings differ");
    ioctl(slave, TIOCGWINSZ, &found);
    EXPECT(!memcmp(&size, &found, sizeof size), "the window differs: %d x %d", found.ws_row, found.ws_col);
    EXPECT_EQUAL("flags", fcntl(master, F_GETFL) & O_NONBLOCK, O_NONBLOCK);
    EXPECT_EQUAL("flags", fcntl(slave, F_GETFL) & O_NONBLOCK, 0);
    EXPECT_EQUAL("mark", fcntl(slave, F_GETFD), FD_CLOEXEC);
    struct stat about;
    fstat(slave, &about);
    EXPECT_EQUAL("mode", about.st_mode & 0777, 0640);
    say(master, "ax#b\n"), expect_text(slave, "ab\n");
}

static void modes(void) {
    int on = 1;
    make_terminal();
    raw();
    ioctl(master, TIOCPKT, &on);
    ioctl(master, TIOCSPTLCK, &on);
    ioctl(slave, TIOCEXCL);
    wait_here();
    EXPECT_EQUAL("packet mode", word(master, TIOCGPKT), 1);
    EXPECT_EQUAL("lock", word(master, TIOCGPTLCK), 1);
    EXPECT_EQUAL("exclusive", word(slave, TIOCGEXCL), 1);
    EXPECT_EQUAL("exclusive", word(master, TIOCGEXCL), 0);
    say(slave, "x");
    char packet[8];
    EXPECT_EQUAL("packet", read(master, packet, sizeof packet), 2);
    EXPECT(packet[0] == TIOCPKT_DATA && packet[1] == 'x', "packet %d %c", packet[0], packet[1]);
}

static void several(void) {
    int more[3][2], copy;
    make_terminal();
    for (int index = 0; index < 3; index++) openpty(&more[index][0], &more[index][1], NULL, NULL, NULL);
    close(master), close(slave);
    copy = dup(more[1][1]);
    int again = open(ttyname(more[1][1]), O_RDONLY | O_NOCTTY);
    wait_here();
    for (int index = 0; index < 3; index++) {
        master = more[index][0], slave = more[index][1];
        talk();
    }
    say(more[1][0], "one\ntwo\n"), expect_text(copy, "one\n"), expect_text(again, "two\n");
    EXPECT(write(again, "x", 1) == -1, "what was opened for reading can be written to");
}

static volatile sig_atomic_t interrupts;
static void count(int number) {
    (void)number;
    interrupts++;
}

static void controlling(void) {
    if (setsid() < 0 && getsid(0) != getpid()) cannot("lead a session");
    make_terminal();
    if (ioctl(slave, TIOCSCTTY, 0)) cannot("have a controlling terminal");
    struct sigaction action = {.sa_handler = count, .sa_flags = SA_RESTART};
    sigaction(SIGINT, &action, NULL);
    int own = open("/dev/tty", O_RDWR);
    wait_here();
    EXPECT_EQUAL("session", tcgetsid(slave), getsid(0));
    EXPECT_EQUAL("foreground", tcgetpgrp(slave), getpgrp());
    say(own, "own\n"), expect_text(master, "own\r\n");
    int opened = open("/dev/tty", O_RDWR);
    EXPECT(opened >= 0, "it has no controlling terminal: %s", strerror(errno));
    say(opened, "tty\n"), expect_text(master, "tty\r\n");
    say(master, "\3");
    for (int turn = 0; !interrupts && turn < 60000; turn++) usleep(1000);
    EXPECT_EQUAL("interrupts", interrupts, 1);
}

static void named(void) {
    int passing[2];
    if (openpty(&passing[0], &passing[1], NULL, NULL, NULL)) cannot("open a pseudo-terminal");
    make_terminal();
    close(passing[0]), close(passing[1]), close(slave);
    slave = open(name, O_RDWR | O_NOCTTY);
    wait_here();
    EXPECT(!strcmp(ttyname(slave) ?: "", name), "its name is %s, not %s", ttyname(slave), name);
    EXPECT(!strcmp(ptsname(master) ?: "", name), "its name is %s, not %s", ptsname(master), name);
    talk();
}

static void alone(void) {
    make_terminal();
    close(slave);
    wait_here();
    struct pollfd there = {master, POLLIN, 0};
    EXPECT(poll(&there, 1, 0) == 1 && there.revents & POLLHUP, "it has not hung up: %x", there.revents);
    slave = open(ptsname(master), O_RDWR | O_NOCTTY);
    EXPECT(slave >= 0, "it cannot be opened: %s", strerror(errno));
    talk();
}

static void hung_up(void) {
    char byte;
    make_terminal();
    close(master);
    wait_here();
    EXPECT(read(slave, &byte, 1) == 0, "something is read");
    EXPECT(write(slave, "x", 1) == -1 && errno == EIO, "it can be written to");
}

static void unread(void) {
    make_terminal();
    say(slave, "unread");
    wait_here();
    expect_text(master, "unread");
}

int main(int argument_count, char **arguments) {
    static const struct {
        const char *name;
        void (*act)(void);
    } cases[] = {{"plain", plain},     {"settings", settings}, {"modes", modes},     {"several", several},
                 {"controlling", controlling}, {"alone", alone}, {"named", named}, {"hung_up", hung_up}, {"unread", unread}};
    go = arguments[1];
    for (size_t index = 0; index < sizeof cases / sizeof *cases; index++)
        if (argument_count > 2 && !strcmp(arguments[2], cases[index].name)) {
            cases[index].act();
            return finish();
        }
    cannot("find the case");
}
