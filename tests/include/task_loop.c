/* A task as the arguments say: NAME PERIOD PHASE DEADLINE OVERRUN AFTER|- COUNT WORK [EARLY] (ns). Each activation is a line: number, due,
 * missed, begun, ended; then how early it wakes. COUNT 0: until there is none. A period of 0: it runs once, 1 ms from now. PERIOD "-": it
 * is declared already. */
#include "failover_task.h"

static int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

int main(int count, char **words)
{
    ft_terms terms;
    ft_tick tick;
    ft_task *task;
    int64_t most, work;
    int outcome = 0;
    if (count != 9 && count != 10)
        return 2;
    memset(&terms, 0, sizeof terms);
    terms.period_ns = atoll(words[2]);
    terms.phase_ns = atoll(words[3]);
    terms.deadline_ns = atoll(words[4]);
    terms.overrun = atoi(words[5]);
    terms.at_ns = terms.period_ns != 0 ? 0 : clock_ns() + 1000000;
    if (strcmp(words[6], "-") != 0)
        terms.after[0] = words[6];
    terms.early_ns = count == 10 ? atoll(words[9]) : FT_LEARN;
    most = atoll(words[7]);
    work = atoll(words[8]);
    task = ft_begin(NULL, words[1], strcmp(words[2], "-") == 0 ? NULL : &terms);
    if (task == NULL) {
        printf("error %d %s\n", errno, fb_error());
        return 1;
    }
    for (int64_t turn = 0; most == 0 || turn < most; turn++) {
        int64_t begun, ended;
        outcome = ft_wait(task, &tick);
        if (outcome != 0)
            break;
        begun = clock_ns();
        while (clock_ns() < begun + work)
            ;
        ended = clock_ns();
        printf("%llu %lld %llu %lld %lld\n", (unsigned long long)tick.number, (long long)tick.due_ns, (unsigned long long)tick.missed,
               (long long)begun, (long long)ended);
        fflush(stdout);
        ft_end(task);
    }
    printf("over %d\nearly %lld\n", outcome, (long long)ft_early_(task));
    ft_close(task);
    return 0;
}
