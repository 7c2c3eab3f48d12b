/* Confines itself by seccomp(2), in the way that its second argument names, and must be confined just so ever after.
 *
 * Whatever a capture or a restore asks of it kills it, and so does restart_syscall(2), which no program calls by itself.
 */
#include "tracee.h"

#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <stddef.h>
#include <sys/prctl.h>

#ifdef __aarch64__
#define NATIVE_CALLS AUDIT_ARCH_AARCH64
#else
#define NATIVE_CALLS AUDIT_ARCH_X86_64
#endif

#define CALL(number, verdict) \
    BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, number, 0, 1), BPF_STMT(BPF_RET | BPF_K, verdict)
#define LOAD(field) BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, field))
#define INSTALL(flags, ...) install((struct sock_filter[]){__VA_ARGS__}, \
    sizeof((struct sock_filter[]){__VA_ARGS__}) / sizeof(struct sock_filter), flags)

static const char *go, *kind;

static int install(struct sock_filter *code, unsigned short length, unsigned flags) {
    struct sock_fprog program = {length, code};
    return (int)syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, flags, &program);
}

/* getppid answers EXDEV; what only a tracer has us do kills. */
static int install_deadly(unsigned flags) {
    return INSTALL(flags, LOAD(arch), BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, NATIVE_CALLS, 1, 0),
                   BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS), LOAD(nr),
                   CALL(SYS_getppid, SECCOMP_RET_ERRNO | EXDEV), CALL(SYS_prctl, SECCOMP_RET_KILL_PROCESS),
                   CALL(SYS_rt_sigaction, SECCOMP_RET_KILL_PROCESS), CALL(SYS_rt_sigtimedwait, SECCOMP_RET_KILL_PROCESS),
                   CALL(SYS_sigaltstack, SECCOMP_RET_KILL_PROCESS), CALL(SYS_getitimer, SECCOMP_RET_KILL_PROCESS),
                   CALL(SYS_membarrier, SECCOMP_RET_KILL_PROCESS), CALL(SYS_userfaultfd, SECCOMP_RET_KILL_PROCESS),
                   CALL(SYS_restart_syscall, SECCOMP_RET_KILL_PROCESS), BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
}

/* getppid answers this error; of two filters that both do, the newer one's counts. */
static int install_answer(int error, unsigned flags) {
    return INSTALL(flags, LOAD(nr), CALL(SYS_getppid, SECCOMP_RET_ERRNO | error), BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
}

static void forbid_new_privileges(void) {
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)) cannot("forbid new privileges");
}

/* Mode, and number of filters where the kernel tells it, of the calling thread. */
static void expect_status(int mode, int filters) {
    char path[64], text[8192];
    snprintf(path, sizeof path, "/proc/self/task/%d/status", (int)syscall(SYS_gettid));
    int file = open(path, O_RDONLY);
    ssize_t size = file < 0 ? -1 : read(file, text, sizeof text - 1);
    if (size < 0) return differs("%s cannot be read: %s", path, strerror(errno));
    close(file);
    text[size] = 0;
    const char *found = strstr(text, "\nSeccomp:"), *counted = strstr(text, "\nSeccomp_filters:");
    EXPECT_EQUAL("seccomp's mode", found ? atoi(found + 9) : -1, mode);
    if (counted) EXPECT_EQUAL("number of filters", atoi(counted + 17), filters);
}

static void expect_answer(int error) {
    errno = 0;
    long answer = syscall(SYS_getppid);
    EXPECT_EQUAL("getppid", answer < 0 ? errno : 0, error);
}

static void *confined_alone(void *began) {
    if (install_deadly(0)) cannot("confine a thread");
    *(volatile int *)began = 1;
    wait_for_go(go);
    expect_status(2, 1), expect_answer(EXDEV);
    return NULL;
}

static void *confined_with_all(void *began) {
    *(volatile int *)began = 1;
    wait_for_go(go);
    while (access("added", F_OK)) usleep(1000);
    expect_answer(ENOTBLK);
    return NULL;
}

static void *confined_late(void *began) {
    *(volatile int *)began = 1;
    while (access("confine", F_OK)) usleep(1000);
    if (install_deadly(0)) differs("cannot confine the thread: %s", strerror(errno));
    puts("confined"), fflush(stdout);
    wait_for_go(go);
    expect_status(2, 1), expect_answer(EXDEV);
    return NULL;
}

static void notified(void) {
    forbid_new_privileges();
    int listener = INSTALL(SECCOMP_FILTER_FLAG_NEW_LISTENER, LOAD(nr), CALL(SYS_getppid, SECCOMP_RET_USER_NOTIF),
                           BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
    if (listener < 0 || close(listener)) cannot("install a filter with a listener");
    ready(), wait_for_go(go);
    expect_answer(ENOSYS);
}

static void with_thread(void *(*body)(void *), void (*confine)(void), void (*check)(void)) {
    volatile int began = 0;
    pthread_t thread;
    if (pthread_create(&thread, NULL, body, (void *)&began)) cannot("start a thread");
    while (!began) usleep(1000);
    confine();
    ready(), wait_for_go(go);
    check();
    pthread_join(thread, NULL);
}

static void nothing(void) {}
static void expect_free(void) {
    expect_status(0, 0);
    EXPECT_EQUAL("getppid", syscall(SYS_getppid) > 0, 1);
}

static void confine_all(void) {
    if (install_answer(EXDEV, SECCOMP_FILTER_FLAG_TSYNC)) cannot("confine all threads");
}

/* All threads have the very same filters still: one more can be given to all. */
static void add_to_all(void) {
    expect_answer(EXDEV);
    EXPECT_EQUAL("a filter for all threads", install_answer(ENOTBLK, SECCOMP_FILTER_FLAG_TSYNC), 0);
    close(open("added", O_CREAT | O_WRONLY, 0600));
}

static void stack(void) {
    forbid_new_privileges();
    if (install_answer(EXDEV, 0) || install_answer(ENOTBLK, SECCOMP_FILTER_FLAG_LOG) || install_deadly(0)) cannot("install");
    ready(), wait_for_go(go);
    expect_status(2, 3), expect_answer(EXDEV);
}

/* Without no_new_privs, and without a right to install one any more. */
static void as_user(void) {
    if (install_deadly(0)) cannot("install a filter");
    if (setresgid(65534, 65534, 65534) || setresuid(65534, 65534, 65534)) cannot("become nobody");
    ready(), wait_for_go(go);
    expect_status(2, 1), expect_answer(EXDEV);
    EXPECT_EQUAL("uid", getuid(), 65534);
}

static void family(void) {
    forbid_new_privileges();
    if (install_answer(EXDEV, 0)) cannot("install a filter");
    pid_t child = fork();
    if (child == 0) {
        if (install_deadly(0)) _exit(3);
        close(open("born", O_CREAT | O_WRONLY, 0600));
        wait_for_go(go);
        expect_status(2, 2), expect_answer(EXDEV);
        fflush(stdout);
        _exit(differences ? 1 : 0);
    }
    while (access("born", F_OK)) usleep(1000);
    ready(), wait_for_go(go);
    expect_status(2, 1), expect_answer(EXDEV);
    int status = -1;
    EXPECT_EQUAL("the child", waitpid(child, &status, 0), child);
    EXPECT_EQUAL("its status", status, 0);
}

int main(int count, char **arguments) {
    if (count < 3) cannot("find the go file and a kind");
    go = arguments[1], kind = arguments[2];
    if (!strcmp(kind, "stack")) stack();
    else if (!strcmp(kind, "user")) as_user();
    else if (!strcmp(kind, "thread")) forbid_new_privileges(), with_thread(confined_alone, nothing, expect_free);
    else if (!strcmp(kind, "all")) forbid_new_privileges(), with_thread(confined_with_all, confine_all, add_to_all);
    else if (!strcmp(kind, "late")) forbid_new_privileges(), with_thread(confined_late, nothing, expect_free);
    else if (!strcmp(kind, "notified")) notified();
    else if (!strcmp(kind, "family")) family();
    else cannot("know the kind %s", kind);
    return finish();
}
