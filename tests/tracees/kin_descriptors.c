/* Two processes and what one has of the other by descriptor: a pidfd of the child; signals of the child's pipe for its parent. */
#include "tracee.h"

#include <poll.h>
#include <sys/prctl.h>
#include <sys/wait.h>

static volatile int heard;

static void note(int number) { heard += number; }

/* Waits for SIGUSR1, then makes its end of the pipe readable, which only the parent is told of. */
static int live(int self_pipe, int other_end) {
    sigset_t user;
    int number;
    pid_t parent = getppid();
    int file = open("owned", O_RDONLY | O_CREAT, 0600);
    struct f_owner_ex owner = {F_OWNER_PID, parent};
    if (fcntl(self_pipe, F_SETOWN_EX, &owner) || fcntl(self_pipe, F_SETSIG, SIGUSR2) || fcntl(file, F_SETOWN, getpid())) return 11;
    if (fcntl(self_pipe, F_SETFL, fcntl(self_pipe, F_GETFL) | O_ASYNC)) return 12;
    prctl(PR_SET_NAME, "otherwise");
    sigemptyset(&user), sigaddset(&user, SIGUSR1);
    kill(parent, SIGUSR1);
    if (sigwait(&user, &number)) return 13;
    if (fcntl(self_pipe, F_GETOWN_EX, &owner) || owner.type != F_OWNER_PID || owner.pid != parent) return 14;
    if (!(fcntl(self_pipe, F_GETFL) & O_ASYNC) || fcntl(self_pipe, F_GETSIG) != SIGUSR2 || fcntl(file, F_GETOWN) != getpid()) return 15;
    if (write(other_end, "x", 1) != 1) return 16;
    return 5;
}

int main(int count, char **arguments) {
    sigset_t user;
    int ends[2], number;
    (void)count;
    sigemptyset(&user), sigaddset(&user, SIGUSR1);
    sigprocmask(SIG_BLOCK, &user, NULL);
    signal(SIGUSR2, note);
    if (pipe(ends)) cannot("make a pipe");
    pid_t child = fork();
    if (child == 0) _exit(live(ends[0], ends[1]));
    close(ends[0]), close(ends[1]);
    int of_child = syscall(SYS_pidfd_open, child, 0), of_self = syscall(SYS_pidfd_open, getpid(), 0);
    if (of_child < 0 || of_self < 0 || sigwait(&user, &number)) cannot("know the child");
    char path[40], told[16] = "";
    snprintf(path, sizeof path, "/proc/%d/comm", child);
    int name = open(path, O_RDONLY);
    if (name < 0) cannot("open a file of /proc");
    ready();
    wait_for_go(arguments[1]);
    struct pollfd ended = {of_child, POLLIN, 0};
    siginfo_t about = {0};
    EXPECT_EQUAL("it has ended", poll(&ended, 1, 0), 0);
    EXPECT(read(name, told, 15) == 10 && !strcmp(told, "otherwise\n"), "the child's name is %s", told);
    EXPECT(syscall(SYS_pidfd_send_signal, of_self, 0, NULL, 0) == 0, "the pidfd of itself: %s", strerror(errno));
    EXPECT(syscall(SYS_pidfd_send_signal, of_child, SIGUSR1, NULL, 0) == 0, "the pidfd of the child: %s", strerror(errno));
    EXPECT(poll(&ended, 1, 20000) == 1 || errno == EINTR, "it does not end");
    EXPECT(waitid(P_PIDFD, of_child, &about, WEXITED) == 0 && about.si_pid == child, "it is another process: %s", strerror(errno));
    EXPECT_EQUAL("exit status", about.si_status, 5);
    EXPECT(heard, "no signal of the child's pipe"); /* it was written to, and closed */
    return finish();
}
