/* A program that steps through itself: the trap flag is set, and each instruction ends in a SIGTRAP. */
#include "tracee.h"

static volatile long steps;

static void step(int signal_number) {
    (void)signal_number;
    steps++;
}

int main(int count, char **arguments) {
    (void)count;
    struct sigaction action = {.sa_handler = step, .sa_flags = SA_RESTART};
    sigaction(SIGTRAP, &action, NULL);
    ready();
    __asm__ volatile("pushfq; orq $0x100, (%%rsp); popfq" ::: "cc", "memory");
    while (!is_told(arguments[1]))
        for (volatile int work = 0; work < 20; work++)
            ;
    long before = steps;
    for (volatile int work = 0; work < 10; work++)
        ;
    EXPECT(steps > before + 10, "it does not step any more");
    __asm__ volatile("pushfq; andq $~0x100, (%%rsp); popfq" ::: "cc", "memory");
    return finish();
}
