/* A thread that waits inside the kernel, where nothing stops it, from the file "in" to the file "leave": it vforks. */
#include "tracee.h"

#include <pthread.h>

static const char *go;

static void *wait_inside(void *unused) {
    (void)unused;
    wait_for_go("in");
    pid_t child = vfork();
    if (child == 0) {
        while (access("leave", F_OK)) syscall(SYS_nanosleep, &(struct timespec){0, 2000000}, NULL);
        _exit(0);
    }
    EXPECT(waitpid(child, NULL, 0) == child, "the child is gone");
    puts("came out");
    fflush(stdout);
    wait_for_go(go);
    return NULL;
}

int main(int count, char **arguments) {
    (void)count;
    pthread_t thread;
    go = arguments[1];
    pthread_create(&thread, NULL, wait_inside, NULL);
    ready();
    wait_for_go(go);
    pthread_join(thread, NULL);
    return finish();
}
