/* Waits in sigsuspend (or pause, with "pause") and must not leave it before SIGUSR1 comes. */
#include "tracee.h"

int main(int count, char **arguments) {
    sigset_t blocked, inside, now;
    (void)arguments;
    listen_for_signal();
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGHUP);
    if (count <= 2) sigaddset(&blocked, SIGUSR1);
    sigprocmask(SIG_SETMASK, &blocked, NULL);
    sigemptyset(&inside);
    sigaddset(&inside, SIGTERM);
    ready();
    int result = count > 2 ? pause() : sigsuspend(&inside);
    EXPECT(result == -1 && errno == EINTR, "it returned %d: %s", result, strerror(errno));
    EXPECT(told, "it returned without a signal");
    sigprocmask(SIG_BLOCK, NULL, &now);
    EXPECT(sigismember(&now, SIGHUP) && !sigismember(&now, SIGTERM), "the mask outside is not the one from before");
    return finish();
}
