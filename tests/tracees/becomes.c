/* A program that comes by other rights, when a file of its directory says so: it executes another one, which may be a copy of
 * itself with the set-user-id bit, or has a child do it.
 *
 * becomes NEXT: says its user ids, then waits for the file "exec" (it executes NEXT), or "fork" (a child executes NEXT; the file
 * "end" ends that child). Without NEXT it only waits.
 */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <unistd.h>

static int is_there(const char *name)
{
    return access(name, F_OK) == 0;
}

static void say(const char *what)
{
    uid_t real, effective, saved;

    getresuid(&real, &effective, &saved);
    printf("%s %d %d %d\n", what, (int)real, (int)effective, (int)saved);
    fflush(stdout);
}

int main(int argc, char **argv)
{
    int is_child = argc > 2;

    say(is_child ? "child" : argc > 1 ? "ready" : "became");
    for (;;) {
        if (!is_child && argc > 1 && is_there("exec")) {
            execl(argv[1], argv[1], (char *)NULL);
            perror("exec");
            return 1;
        }
        if (!is_child && argc > 1 && is_there("fork")) {
            pid_t child = fork();

            if (child == 0) {
                execl(argv[1], argv[1], "-", "child", (char *)NULL);
                _exit(1);
            }
            waitpid(child, NULL, 0);
            unlink("fork");
            say("alone");
        }
        if (is_child && is_there("end"))
            return 0;
        usleep(1000);
    }
}
