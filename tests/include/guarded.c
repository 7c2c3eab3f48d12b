/* A program under a guard: tells what it begins with, then obeys a letter at a time from standard input and answers on descriptor 3.
 *
 *     c: print its number, count and commit     w: wait 10 s for the newest commit     W: the same for 1 ms
 *     p: print until its pipe is full            f: fork, and have the child say what it has of the guard */
#include "failover.h"

#include <sys/wait.h>

static int64_t number;
static char large[200000];

__attribute__((format(printf, 1, 2))) static void say(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vdprintf(3, format, arguments);
    va_end(arguments);
}

static void tell_resumed(const failover_resumption *resumed, void *context)
{
    (void)context;
    say("resumed %s|%s|epoch %llu|generation %llu|commit %llu|%.3f s|%s", resumed->robot, resumed->why, (unsigned long long)resumed->epoch,
        (unsigned long long)resumed->generation, (unsigned long long)resumed->commit, resumed->age_s, resumed->notes);
    say("\n");
}

static void say_outcome(const char *what, int64_t outcome)
{
    say("%s %lld %s\n", what, (long long)outcome, outcome < 0 ? failover_error() : "");
}

static void fill_the_pipe(void)
{
    char line[4096] = "";
    fcntl(1, F_SETFL, fcntl(1, F_GETFL) | O_NONBLOCK);
    while (write(1, line, sizeof line) > 0)
        continue;
    fcntl(1, F_SETFL, fcntl(1, F_GETFL) & ~O_NONBLOCK);
    printf("held back");
    say("full\n");
}

static void fork_a_child(int guard)
{
    pid_t child = fork();
    if (child == 0) {
        say("child %d %s\n", fcntl(guard, F_GETFD), getenv("FAILOVER_TASK") == NULL ? "no variable" : "variable");
        _exit(0);
    }
    waitpid(child, NULL, 0);
}

int main(void)
{
    failover_region(&number, sizeof number, "number");
    failover_region(large, sizeof large, "large");
    failover_on_resume(tell_resumed, NULL);
    int outcome = failover_open("guarded");
    say_outcome("open", outcome);
    if (outcome < 0)
        return 1;
    say("at %lld, epoch %llu, last byte %d\n", (long long)number, (unsigned long long)failover_epoch(), large[sizeof large - 1]);
    for (int letter = getchar(); letter != EOF; letter = getchar()) {
        if (letter == 'c') {
            printf("%lld\n", (long long)++number);
            large[sizeof large - 1] = (char)number;
            say_outcome("commit", failover_commit());
        } else if (letter == 'w' || letter == 'W') {
            say_outcome("wait", failover_wait(letter == 'w' ? 10000 : 1));
        } else if (letter == 'p') {
            fill_the_pipe();
        } else if (letter == 'f') {
            fork_a_child(failover_the_task_.guard);
        }
    }
    return 0;
}
