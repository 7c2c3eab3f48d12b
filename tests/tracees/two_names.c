/* A file that two processes reach under two names, one of which is gone: both count in it, and each must see the other.
 *
 * Arguments: the go file; how the parent and how the child hold it, a word each ("map", "read", "open", "lock", "semaphore"); the
 * name that goes, and the one that stays. The parent makes the file under the first, links it to the second and unlinks the first,
 * as sem_open(3) does; the child, which executes this program anew, opens it by the second. With "parent" alone there is no child.
 */
#include "tracee.h"

#include <semaphore.h>
#include <sys/file.h>

#define TURNS 200

struct held {
    const char *how;
    int file;
    volatile int *place;
};

static struct held hold(const char *how, int file) {
    int protection = strcmp(how, "read") ? PROT_READ | PROT_WRITE : PROT_READ;
    struct held held = {how, file, NULL};
    if (!strcmp(how, "open")) return held;
    if (!strcmp(how, "lock")) {
        if (flock(file, LOCK_SH | LOCK_NB)) cannot("lock it");
        return held;
    }
    held.place = mmap(NULL, PAGE, protection, MAP_SHARED, file, 0);
    if (held.place == MAP_FAILED) cannot("map it");
    close(file);
    held.file = -1;
    return held;
}

static int value(struct held held) {
    int found = -1;
    if (held.place) return *held.place;
    if (pread(held.file, &found, sizeof found, 0) != sizeof found) differs("cannot read: %s", strerror(errno));
    return found;
}

static void put(struct held held, int number) {
    if (!strcmp(held.how, "read")) return;
    if (held.place)
        *held.place = number;
    else if (pwrite(held.file, &number, sizeof number, 0) != sizeof number)
        differs("cannot write: %s", strerror(errno));
}

/* Until the other one has written it; ten seconds are for ever. */
static void await(struct held held, int wanted) {
    int64_t deadline = now_ns(CLOCK_MONOTONIC) + 10 * SECOND;
    while (value(held) != wanted && now_ns(CLOCK_MONOTONIC) < deadline) {
        struct timespec nap = {0, 100000};
        nanosleep(&nap, NULL);
    }
    EXPECT_EQUAL("what the other one wrote", value(held), wanted);
}

static int in_child(const char *how, const char *name, int asked, int answers) {
    char word;
    sem_t *semaphore = SEM_FAILED;
    struct held held = {how, -1, NULL};
    if (!strcmp(how, "semaphore"))
        semaphore = sem_open(name, 0);
    else
        held = hold(how, open(name, strcmp(how, "read") ? O_RDWR : O_RDONLY));
    if (write(answers, "r", 1) != 1) return 1;
    for (int turn = 0; read(asked, &word, 1) == 1; turn++) {
        if (semaphore != SEM_FAILED) {
            struct timespec limit = {time(NULL) + 10, 0};
            EXPECT(sem_timedwait(semaphore, &limit) == 0, "the semaphore was not raised: %s", strerror(errno));
        } else {
            await(held, 2 * turn + 1);
            put(held, 2 * turn + 2);
        }
        if (write(answers, differences ? "n" : "y", 1) != 1) return 1;
        if (differences) return finish();
    }
    return 0;
}

int main(int count, char **arguments) {
    if (count < 6) cannot("do without arguments");
    const char *go = arguments[1], *mine = arguments[2], *theirs = arguments[3], *lost = arguments[4], *kept = arguments[5];
    if (count > 6) return in_child(theirs, kept, atoi(arguments[6]), atoi(arguments[7]));
    sem_t *semaphore = SEM_FAILED;
    struct held held = {mine, -1, NULL};
    int number = 1, asked[2], answers[2];
    char word = 0, first[12], second[12];
    if (!strcmp(mine, "semaphore")) {
        semaphore = sem_open(kept, O_CREAT | O_EXCL, 0600, 0);
        if (semaphore == SEM_FAILED) cannot("make a semaphore");
    } else {
        int made = open(lost, O_RDWR | O_CREAT | O_EXCL, 0600);
        if (made < 0 || ftruncate(made, PAGE)) cannot("make %s", lost);
        if (link(lost, kept)) cannot("link it");
        int file = strcmp(mine, "read") ? made : open(lost, O_RDONLY);
        if (unlink(lost)) cannot("unlink it");
        held = hold(mine, file);
        if (file != made) close(made);
    }
    if (!strcmp(theirs, "nobody")) {
        ready();
        wait_for_go(go);
        int file = open(kept, O_RDWR), seen = -1;
        if (strcmp(mine, "read"))
            put(held, 77);
        else if (pwrite(file, &(int){77}, sizeof(int), 0) != sizeof(int))
            differs("cannot write: %s", strerror(errno));
        EXPECT_EQUAL("what is written, under the name that is gone", value(held), 77);
        EXPECT(pread(file, &seen, sizeof seen, 0) == sizeof seen, "%s cannot be read: %s", kept, strerror(errno));
        EXPECT_EQUAL("the same under the name that is left", seen, 77);
        return finish();
    }
    if (pipe(asked) || pipe(answers)) cannot("make pipes");
    snprintf(first, sizeof first, "%d", asked[0]);
    snprintf(second, sizeof second, "%d", answers[1]);
    if (fork() == 0) {
        close(asked[1]);
        close(answers[0]);
        if (held.file >= 0) close(held.file);
        execl("/proc/self/exe", arguments[0], go, mine, theirs, lost, kept, first, second, NULL);
        _exit(1);
    }
    close(asked[0]);
    close(answers[1]);
    if (read(answers[0], &word, 1) != 1) cannot("hear of the child");
    ready();
    wait_for_go(go);
    for (int turn = 0; turn < TURNS && !differences; turn++) {
        if (semaphore != SEM_FAILED)
            sem_post(semaphore);
        else
            put(held, number);
        if (write(asked[1], "c", 1) != 1) differs("the child is gone");
        if (read(answers[0], &word, 1) != 1 || word != 'y') differs("the child did not see turn %d", turn);
        if (semaphore == SEM_FAILED) EXPECT_EQUAL("what the child answered", value(held), number + 1);
        number += 2;
    }
    close(asked[1]);
    wait(NULL);
    return finish();
}
