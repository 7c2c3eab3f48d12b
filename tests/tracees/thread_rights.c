/* Threads with rights of their own, asked of the kernel directly: the C library would change those of all. */
#include "tracee.h"

#include <grp.h>
#include <linux/capability.h>
#include <pthread.h>
#include <sys/fsuid.h>
#include <sys/prctl.h>

static const char *go;
static pthread_barrier_t all_here;

static void only_user(void) {
    gid_t groups[] = {7, 1234};
    if (syscall(SYS_setgroups, 2, groups) || syscall(SYS_setresgid, 11, 12, 13) || syscall(SYS_setresuid, 21, 22, 23))
        cannot("become another user");
}

static void only_capabilities(void) {
    struct __user_cap_header_struct head = {_LINUX_CAPABILITY_VERSION_3, 0};
    struct __user_cap_data_struct sets[2];
    if (syscall(SYS_capget, &head, sets)) cannot("read capabilities");
    sets[0].effective &= ~(1 << CAP_NET_ADMIN), sets[0].permitted &= ~(1 << CAP_SYS_TIME), sets[0].effective &= sets[0].permitted;
    if (syscall(SYS_capset, &head, sets)) cannot("give up capabilities");
}

static void only_privileges(void) {
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)) cannot("give up privileges");
}

static void only_file_user(void) { syscall(SYS_setfsuid, 99), syscall(SYS_setfsgid, 98); }
static void nothing(void) {}

static void (*const changes[])(void) = {nothing, only_user, only_capabilities, only_privileges, only_file_user};
#define THREADS 5

/* The lines of /proc/thread-self/status that tell its rights. */
static void look(char *found, size_t size) {
    char line[300];
    FILE *status = fopen("/proc/thread-self/status", "r");
    found[0] = 0;
    while (status && fgets(line, sizeof line, status))
        if (!strncmp(line, "Uid", 3) || !strncmp(line, "Gid", 3) || !strncmp(line, "Groups", 6) || !strncmp(line, "Cap", 3) ||
            !strncmp(line, "NoNew", 5))
            strncat(found, line, size - strlen(found) - 1);
    if (status) fclose(status);
}

static void *work(void *argument) {
    long number = (long)argument;
    static __thread char before[2000], after[2000];
    changes[number]();
    look(before, sizeof before);
    if (!before[0]) cannot("read its own rights");
    pthread_barrier_wait(&all_here);
    wait_for_go(go);
    look(after, sizeof after);
    if (strcmp(before, after)) differs("thread %ld has\n%sand had\n%s", number, after, before);
    return NULL;
}

int main(int count, char **arguments) {
    pthread_t threads[THREADS];
    char before[2000], after[2000];
    (void)count;
    go = arguments[1];
    if (geteuid()) cannot("change users");
    pthread_barrier_init(&all_here, NULL, THREADS + 1);
    for (long number = 0; number < THREADS; number++)
        if (pthread_create(&threads[number], NULL, work, (void *)number)) cannot("start a thread");
    pthread_barrier_wait(&all_here);
    look(before, sizeof before);
    ready();
    wait_for_go(go);
    look(after, sizeof after);
    if (strcmp(before, after)) differs("the first has\n%sand had\n%s", after, before);
    for (int number = 0; number < THREADS; number++) pthread_join(threads[number], NULL);
    return finish();
}
