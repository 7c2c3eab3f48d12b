/* Captured inside a signal handler on the alternate stack; afterwards it returns to where it interrupted. */
#include "tracee.h"

static unsigned char *area;
static const char *go;
static volatile sig_atomic_t inside_ok, returned;

static void linger(int signal_number, siginfo_t *about, void *context) {
    volatile uint64_t frame[256];
    (void)signal_number, (void)context;
    for (int index = 0; index < 256; index++) frame[index] = mix(index);
    ready();
    wait_for_go(go);
    stack_t now;
    sigaltstack(NULL, &now);
    unsigned char *here = (unsigned char *)frame;
    inside_ok = here > area && here < area + 16 * PAGE && now.ss_flags == SS_ONSTACK && now.ss_sp == area &&
                now.ss_size == 16 * PAGE && about->si_value.sival_int == 5;
    for (int index = 0; index < 256; index++)
        if (frame[index] != mix(index)) inside_ok = 0;
}

int main(int count, char **arguments) {
    (void)count;
    go = arguments[1];
    area = map_pages(16, PROT_READ | PROT_WRITE, 0);
    stack_t alternate = {.ss_sp = area, .ss_size = 16 * PAGE}, now;
    sigaltstack(&alternate, NULL);
    struct sigaction action = {.sa_sigaction = linger, .sa_flags = SA_SIGINFO | SA_ONSTACK};
    sigaction(SIGRTMIN, &action, NULL);
    volatile double kept = 1.0 / 3.0;
    sigqueue(getpid(), SIGRTMIN, (union sigval){.sival_int = 5});
    EXPECT(inside_ok, "inside the handler: wrong stack, flags or bytes");
    EXPECT(kept == 1.0 / 3.0, "a value across the handler is wrong");
    sigaltstack(NULL, &now);
    EXPECT(now.ss_sp == area && now.ss_flags == 0 && now.ss_size == 16 * PAGE, "the alternate stack is not set");
    sigset_t blocked;
    sigprocmask(SIG_BLOCK, NULL, &blocked);
    EXPECT(!sigismember(&blocked, SIGRTMIN), "the signal stayed blocked after its handler");
    return finish();
}
