/* What the kernel keeps for the thread library: the robust list, the clear-on-exit address, rseq. */
#include "tracee.h"

#include <linux/futex.h>
#include <sys/prctl.h>
#include <sys/rseq.h>

int main(int count, char **arguments) {
    (void)count;
    void *head = NULL, *head_after = NULL;
    size_t length = 0, length_after = 0;
    unsigned long clear = 0, clear_after = 0;
    syscall(SYS_get_robust_list, 0, &head, &length);
    int known = prctl(PR_GET_TID_ADDRESS, &clear) == 0;
    ready();
    wait_for_go(arguments[1]);
    syscall(SYS_get_robust_list, 0, &head_after, &length_after);
    EXPECT_EQUAL("robust list", (uintptr_t)head_after, (uintptr_t)head);
    EXPECT_EQUAL("robust list length", length_after, length);
    if (known) {
        prctl(PR_GET_TID_ADDRESS, &clear_after);
        EXPECT_EQUAL("clear-on-exit address", clear_after, clear);
    }
    if (__rseq_size) {
        char *area = (char *)__builtin_thread_pointer() + __rseq_offset;
        EXPECT(syscall(SYS_rseq, area, 32, 0, RSEQ_SIG) == -1 && errno == EBUSY, "rseq is not registered");
    }
    return finish();
}
