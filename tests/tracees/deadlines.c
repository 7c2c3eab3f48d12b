/* What only sched_setattr(2) sets: a deadline, or a slice of its own; the second argument says which. */
#include "tracee.h"

#include <sched.h>

struct attributes {
    uint32_t size, policy;
    uint64_t flags;
    int32_t nice;
    uint32_t priority;
    uint64_t runtime, deadline, period;
};

static struct attributes asked(void) {
    struct attributes found = {.size = sizeof found};
    if (syscall(SYS_sched_getattr, 0, &found, sizeof found, 0)) cannot("ask");
    return found;
}

int main(int count, char **arguments) {
    int has_deadline = count > 2 && !strcmp(arguments[2], "deadline");
    struct attributes wanted = {.size = sizeof wanted, .policy = SCHED_BATCH, .nice = 3, .runtime = 7 * 1000000};
    if (has_deadline) wanted = (struct attributes){sizeof wanted, 6, 1, 0, 0, 1000000, 10000000, 20000000};
    if (syscall(SYS_sched_setattr, 0, &wanted, 0)) cannot("be scheduled so");
    struct attributes before = asked(), after;
    if (!has_deadline && before.runtime != wanted.runtime) cannot("have a slice of its own");
    ready();
    wait_for_go(arguments[1]);
    after = asked();
    EXPECT_EQUAL("policy", after.policy, before.policy);
    EXPECT_EQUAL("flags", after.flags, before.flags);
    EXPECT_EQUAL("nice", after.nice, before.nice);
    EXPECT_EQUAL("runtime", after.runtime, before.runtime);
    EXPECT_EQUAL("deadline", after.deadline, before.deadline);
    EXPECT_EQUAL("period", after.period, before.period);
    return finish();
}
