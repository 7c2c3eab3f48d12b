/* Rings of asynchronous I/O; the case is named by the second argument. */
#include "tracee.h"

#include <linux/aio_abi.h>

static const char *go;

static void wait_here(void) {
    ready();
    wait_for_go(go);
}

static aio_context_t ring(unsigned events) {
    aio_context_t made = 0;
    if (syscall(SYS_io_setup, events, &made)) cannot("make a ring");
    return made;
}

static long submit(aio_context_t ring, int file, int code, void *buffer, size_t size, uint64_t word) {
    struct iocb request = {.aio_fildes = file, .aio_lio_opcode = code, .aio_buf = (uintptr_t)buffer, .aio_nbytes = size, .aio_data = word};
    return syscall(SYS_io_submit, ring, 1, (struct iocb *[]){&request});
}

static long take(aio_context_t ring, struct io_event *event) {
    return syscall(SYS_io_getevents, ring, 1, 1, event, &(struct timespec){5, 0});
}

static void expect(aio_context_t ring, uint64_t word, long result) {
    struct io_event event = {0};
    EXPECT_EQUAL("events", take(ring, &event), 1);
    EXPECT_EQUAL("word", event.data, word);
    EXPECT_EQUAL("result", event.res, result);
}

static void expect_none(aio_context_t ring) {
    struct io_event event;
    EXPECT_EQUAL("events", syscall(SYS_io_getevents, ring, 0, 1, &event, NULL), 0);
}

/* Two rings of different sizes, of which one has the number of a third that is gone before it. */
static void aio_events(void) {
    char text[8] = "content";
    int file = open("written", O_RDWR | O_CREAT | O_TRUNC, 0600);
    aio_context_t gone = ring(1), small = ring(1), large = ring(3000);
    if (file < 0 || submit(small, file, IOCB_CMD_PWRITE, text, 7, 1) != 1) cannot("write");
    syscall(SYS_io_destroy, gone);
    for (uint64_t word = 0; word < 70; word++)
        if (submit(large, file, IOCB_CMD_PREAD, text, 7, word) != 1) cannot("read");
    for (uint64_t word = 0; word < 60; word++) expect(large, word, 7);
    wait_here();
    expect(small, 1, 7), expect_none(small);
    for (uint64_t word = 60; word < 70; word++) expect(large, word, 7);
    expect_none(large);
    char found[8] = "";
    EXPECT(submit(small, file, IOCB_CMD_PREAD, found, 7, 9) == 1, "it takes no request: %s", strerror(errno));
    expect(small, 9, 7);
    EXPECT(!memcmp(found, "content", 7), "it read '%s'", found);
    EXPECT(syscall(SYS_io_destroy, small) == 0 && syscall(SYS_io_destroy, large) == 0, "it cannot be removed: %s", strerror(errno));
}

/* The places of events have been used up some times, and there is room for as many as before. */
static void aio_around(void) {
    char text[8];
    int file = open("/proc/self/exe", O_RDONLY);
    aio_context_t only = ring(1);
    unsigned count = ((unsigned *)only)[1];
    for (uint64_t word = 0; word < 3 * count + 5; word++) {
        if (submit(only, file, IOCB_CMD_PREAD, text, 1, word) != 1) cannot("read");
        if (word >= 3) expect(only, word - 3, 1);
    }
    wait_here();
    unsigned room = 0;
    while (room < count && submit(only, file, IOCB_CMD_PREAD, text, 1, 3 * count + 5 + room) == 1) room++;
    EXPECT(room >= count / 2, "there is room for %u more of %u", room, count);
    for (uint64_t word = 3 * count + 2; word < 3 * count + 5 + room; word++) expect(only, word, 1);
    expect_none(only);
}

/* Direct reads of a disk are always under way. */
static void aio_direct(void) {
    enum { REQUESTS = 4, SIZE = 1 << 16 };
    static char texts[REQUESTS][SIZE] __attribute__((aligned(4096)));
    int file = open("direct", O_RDWR | O_CREAT | O_TRUNC | O_DIRECT, 0600);
    aio_context_t only = ring(REQUESTS);
    if (file < 0 || write(file, texts, sizeof texts) != sizeof texts) cannot("write past the page cache");
    for (uint64_t word = 0; word < REQUESTS; word++)
        if (submit(only, file, IOCB_CMD_PREAD, texts[word], SIZE, word) != 1) cannot("read");
    ready();
    while (!is_told(go)) {
        struct io_event event = {0};
        long count = take(only, &event);
        EXPECT(count == 1 && event.res == SIZE, "io_getevents: %ld, %lld (%s)", count, (long long)event.res, strerror(errno));
        if (count != 1) return;
        usleep(500);
        EXPECT(submit(only, file, IOCB_CMD_PREAD, texts[event.data], SIZE, event.data) == 1, "it takes no request: %s", strerror(errno));
    }
}

/* A thread waits for events when it is captured; a child has inherited the mapping, which serves it nothing. */
static void aio_waiting(void) {
    char text[8];
    int file = open("/proc/self/exe", O_RDONLY);
    aio_context_t only = ring(10);
    pid_t child = fork();
    if (child == 0) {
        while (!is_told(go)) usleep(2000);
        _exit(((unsigned *)only)[1] < 10);
    }
    struct io_event event;
    ready();
    while (!is_told(go)) {
        long count = syscall(SYS_io_getevents, only, 1, 1, &event, &(struct timespec){0, 5000000});
        EXPECT(count == 0, "io_getevents: %ld (%s)", count, strerror(errno));
    }
    EXPECT(submit(only, file, IOCB_CMD_PREAD, text, 1, 7) == 1, "it takes no request: %s", strerror(errno));
    expect(only, 7, 1);
    int status = -1;
    EXPECT(waitpid(child, &status, 0) == child && status == 0, "its child: %x", status);
}

int main(int count, char **arguments) {
    go = arguments[1];
    if (count > 2 && !strcmp(arguments[2], "aio_events")) aio_events();
    else if (count > 2 && !strcmp(arguments[2], "aio_around")) aio_around();
    else if (count > 2 && !strcmp(arguments[2], "aio_direct")) aio_direct();
    else if (count > 2 && !strcmp(arguments[2], "aio_waiting")) aio_waiting();
    else cannot("find the case");
    return finish();
}
