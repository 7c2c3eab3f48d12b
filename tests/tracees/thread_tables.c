/* Threads that have a working directory, a umask or a table of descriptors for themselves, and one that shares all of it. */
#include "tracee.h"

#include <pthread.h>

static const char *go;
static int log_file, notes, far;
static pthread_barrier_t all_set;

static void is_set(void) {
    pthread_barrier_wait(&all_set);
    wait_for_go(go);
}

static void expect_offset(const char *what, int file, off_t wanted) { EXPECT_EQUAL(what, lseek(file, 0, SEEK_CUR), wanted); }

static mode_t own_umask(void) {
    mode_t now = umask(0);
    umask(now);
    return now;
}

static void *work_elsewhere(void *unused) {
    char here[64] = "";
    int beside = open(".", O_RDONLY | O_DIRECTORY);
    if (unshare(CLONE_FS) || chdir("/tmp")) cannot("work in another directory");
    umask(027);
    pthread_barrier_wait(&all_set);
    while (faccessat(beside, go, F_OK, 0)) usleep(2000);
    EXPECT(getcwd(here, sizeof here) && !strcmp(here, "/tmp"), "it works in %s", here);
    EXPECT_EQUAL("its umask", own_umask(), 027);
    return unused;
}

/* Its log is where the notes of the others are, their notes are at a number of its own, and what is far it has closed. */
static void *file_elsewhere(void *unused) {
    if (unshare(CLONE_FILES)) cannot("have a table of its own");
    int spare = dup(log_file), mine = 90;
    dup2(notes, log_file), dup2(spare, notes), dup2(notes, mine), close(spare), close(far);
    fcntl(log_file, F_SETFD, FD_CLOEXEC);
    is_set();
    expect_offset("its notes", log_file, 200), expect_offset("its log", notes, 100), expect_offset("its copy", mine, 100);
    EXPECT_EQUAL("mark", fcntl(log_file, F_GETFD), FD_CLOEXEC);
    EXPECT_EQUAL("mark", fcntl(notes, F_GETFD), 0);
    EXPECT(fcntl(far, F_GETFD) == -1, "what it had closed is open");
    lseek(notes, 111, SEEK_SET);
    close(notes);
    return unused;
}

static void *share_all(void *unused) {
    is_set();
    expect_offset("the notes for all", notes, 200);
    EXPECT_EQUAL("the umask for all", own_umask(), 022);
    return unused;
}

int main(int count, char **arguments) {
    void *(*acts[])(void *) = {work_elsewhere, file_elsewhere, share_all};
    pthread_t threads[3];
    char before[600] = "", after[600] = "";
    go = arguments[1];
    umask(022);
    log_file = open("log", O_RDWR | O_CREAT, 0600), notes = open("notes", O_RDWR | O_CREAT, 0600);
    if (count < 2 || log_file < 0 || notes < 0 || (far = fcntl(log_file, F_DUPFD, 300)) < 0) cannot("open files");
    lseek(log_file, 100, SEEK_SET), lseek(notes, 200, SEEK_SET);
    pthread_barrier_init(&all_set, NULL, 4);
    if (!getcwd(before, sizeof before)) cannot("tell where it works");
    for (int index = 0; index < 3; index++) pthread_create(&threads[index], NULL, acts[index], NULL);
    pthread_barrier_wait(&all_set);
    ready();
    wait_for_go(go);
    for (int index = 0; index < 3; index++) pthread_join(threads[index], NULL);
    EXPECT(getcwd(after, sizeof after) && !strcmp(after, before), "it works in %s", after);
    expect_offset("log", log_file, 111), expect_offset("far", far, 111), expect_offset("notes", notes, 200);
    EXPECT(fcntl(90, F_GETFD) == -1, "it has what is its thread's");
    return finish();
}
