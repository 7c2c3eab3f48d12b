/* Its newest thread executes another program as soon as the go file is there; that says so, and ends once it may. */
#include "tracee.h"
#include <pthread.h>

#define IDLE 3

static char *own, *go;

static void *idle(void *unused) {
    for (;;) pause();
    return unused;
}

static void *execute(void *unused) {
    wait_for_go(go);
    execl("/proc/self/exe", own, "may-end", "executed", NULL);
    cannot("execute itself");
    return unused;
}

int main(int count, char **arguments) {
    pthread_t thread;
    own = arguments[0];
    go = arguments[1];
    if (count > 2) {
        puts("executed");
        fflush(stdout);
        wait_for_go(go);
        return finish();
    }
    for (int number = 0; number < IDLE; number++)
        if (pthread_create(&thread, NULL, idle, NULL)) cannot("start a thread");
    if (pthread_create(&thread, NULL, execute, NULL)) cannot("start a thread");
    ready();
    for (;;) pause();
}
