/* The sketch as a program of this PC.
 *
 *     engine            speaks on standard input and output
 *     engine PORT       makes a pseudo-terminal, and PORT a link to it: a device that is plugged in until the program ends
 *     engine tcp:7000   takes one TCP connection after the other at this port of the loopback, as with an Ethernet shield
 *
 * Its motor is simulated: what the sketch writes to a pin goes to standard error, and takes $PWM_MS (50) milliseconds.
 */
#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "../arduino.ino"

static int input = STDIN_FILENO, output = STDOUT_FILENO, listening = -1;
static char heard[512];
static ssize_t heard_size, heard_at;
static long pwm_ms = 50;

static void end(const char *what)
{
    perror(what);
    exit(1);
}

void pinMode(uint8_t pin, uint8_t mode)
{
    (void)pin;
    (void)mode;
}

void digitalWrite(uint8_t pin, uint8_t level)
{
    dprintf(STDERR_FILENO, "digital %d %d\n", pin, level);
}

void analogWrite(uint8_t pin, int value)
{
    struct timespec left = {pwm_ms / 1000, pwm_ms % 1000 * 1000000};

    dprintf(STDERR_FILENO, "analog %d %d\n", pin, value);
    while (nanosleep(&left, &left) != 0)
        continue;
}

static void serial_begin(unsigned long baud)
{
    (void)baud;
}

static void take_connection(void)
{
    while ((input = accept(listening, NULL, NULL)) < 0)
        if (errno != EINTR && errno != ECONNABORTED)
            end("cannot take a connection");
    output = input;
}

/* Waits for the first byte, where an Arduino would ask again and again. */
static int serial_available(void)
{
    if (heard_at == heard_size) {
        heard_at = heard_size = 0;
        while ((heard_size = read(input, heard, sizeof heard)) < 0 && errno == EINTR)
            continue;
        if (heard_size <= 0) {
            if (listening < 0)
                exit(heard_size < 0);
            heard_size = 0;
            close(input);
            take_connection();
        }
    }
    return (int)(heard_size - heard_at);
}

static int serial_read(void)
{
    return heard_at < heard_size ? (unsigned char)heard[heard_at++] : -1;
}

static size_t serial_write(const char *text, size_t size)
{
    size_t done = 0;

    while (done < size) {
        ssize_t count = write(output, text + done, size - done);
        if (count < 0 && errno != EINTR && listening >= 0)
            break; /* the connection is gone: the next read tells */
        if (count < 0 && errno != EINTR)
            end("cannot write the answer");
        done += count < 0 ? 0 : (size_t)count;
    }
    return size;
}

const struct serial_port Serial = {serial_begin, serial_available, serial_read, serial_write};

static void plug_in(const char *port)
{
    struct termios raw;
    int ours = posix_openpt(O_RDWR | O_NOCTTY);
    const char *theirs = ours < 0 || grantpt(ours) != 0 || unlockpt(ours) != 0 ? NULL : ptsname(ours);

    /* The second descriptor stays open: without it, reading would fail whenever no driver has the port open. */
    if (theirs == NULL || open(theirs, O_RDWR | O_NOCTTY) < 0 || tcgetattr(ours, &raw) != 0)
        end("cannot make a pseudo-terminal");
    cfmakeraw(&raw); /* no echo: the sketch would answer its own answers */
    tcsetattr(ours, TCSANOW, &raw);
    input = output = ours;
    unlink(port);
    if (symlink(theirs, port) != 0)
        end(port);
}

static void listen_at(long port)
{
    struct sockaddr_in at;
    int yes = 1;

    memset(&at, 0, sizeof at);
    at.sin_family = AF_INET;
    at.sin_port = htons((uint16_t)port);
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    signal(SIGPIPE, SIG_IGN);
    listening = socket(AF_INET, SOCK_STREAM, 0);
    if (listening < 0 || setsockopt(listening, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) != 0 ||
        bind(listening, (struct sockaddr *)&at, sizeof at) != 0 || listen(listening, 1) != 0)
        end("cannot listen");
    take_connection();
}

int main(int count, char **words)
{
    const char *told = getenv("PWM_MS");

    if (told != NULL)
        pwm_ms = strtol(told, NULL, 10);
    if (count > 1 && strncmp(words[1], "tcp:", 4) == 0)
        listen_at(strtol(words[1] + 4, NULL, 10));
    else if (count > 1)
        plug_in(words[1]);
    setup();
    for (;;)
        loop();
}
