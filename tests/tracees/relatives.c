/* Processes that share their table of descriptors ("files"), or directories and umask ("directories"), with their parent.
 *
 * A child, and a child of it, share with the first process; another child has a table of its own, which it shares with its own child.
 */
#include "tracee.h"

#define THEIRS 77 /* opened by the youngest once it is told */
#define OURS 78   /* opened by the first process after that */

static const char *go;
static int ends[2];

static pid_t born_with(unsigned long flags) { return syscall(SYS_clone, flags | SIGCHLD, 0, 0, 0, 0); }

static int is_open(int number) { return fcntl(number, F_GETFL) >= 0; }

static int ended_well(pid_t child) {
    int status;
    return waitpid(child, &status, 0) == child && status == 0;
}

static void opens_for_all(void) {
    while (!is_told(go)) usleep(2000);
    if (dup2(STDIN_FILENO, THEIRS) < 0) _exit(1);
    while (!is_open(OURS)) usleep(2000);
    _exit(0);
}

static void closes_for_its_parent(void) {
    while (!is_told(go)) usleep(2000);
    close(ends[1]);
    _exit(is_open(THEIRS));
}

static void has_a_table_of_its_own(void) {
    pid_t child = born_with(CLONE_FILES);
    if (!child) closes_for_its_parent();
    _exit(!ended_well(child) || is_open(ends[1]));
}

static void files(void) {
    pid_t other = fork();
    if (!other) has_a_table_of_its_own();
    pid_t child = born_with(CLONE_FILES);
    if (!child) {
        pid_t youngest = born_with(CLONE_FILES);
        if (!youngest) opens_for_all();
        _exit(!ended_well(youngest));
    }
    ready();
    wait_for_go(go);
    EXPECT(ended_well(other), "a process with a table of its own");
    while (!is_open(THEIRS)) usleep(2000);
    dup2(STDIN_FILENO, OURS);
    EXPECT(ended_well(child), "processes with the table of the first one");
    EXPECT(is_open(ends[1]), "a pipe is closed that another table has lost");
}

static void moves_all(void) {
    while (!is_told(go)) usleep(2000);
    umask(0137);
    mkdir("inside", 0755);
    _exit(chdir("inside") != 0);
}

static void directories(void) {
    char path[4096];
    pid_t child = born_with(CLONE_FS);
    if (!child) moves_all();
    ready();
    EXPECT(ended_well(child), "the child that moves");
    EXPECT(getcwd(path, sizeof path) && strstr(path, "/inside"), "the directory is %s", path);
    EXPECT(umask(0) == 0137, "the umask");
}

int main(int count, char **words) {
    if (count < 3) return 2;
    go = words[1];
    if (pipe(ends)) cannot("make a pipe");
    if (!strcmp(words[2], "files")) files();
    else directories();
    return finish();
}
