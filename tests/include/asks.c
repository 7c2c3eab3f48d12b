/* Asks for one thing that is refused, or not; prints what came of it. */
#include "failover.h"

#include <sys/wait.h>

static int value = 7;
static char bytes[8192], other[16];

static void say(const char *what, int64_t outcome)
{
    printf("%s %lld %s\n", what, (long long)outcome, outcome < 0 ? failover_error() : "");
}

static int is(const char *word, const char *wanted) { return strcmp(word, wanted) == 0; }

static void register_too_many(void)
{
    static char many[1025];
    char name[16];
    for (int index = 0; index < 1025; index++) {
        snprintf(name, sizeof name, "r%d", index);
        failover_region(&many[index], 1, name);
    }
}

int main(int count, char **words)
{
    const char *what = count > 1 ? words[1] : "";
    if (is(what, "many"))
        register_too_many();
    else if (!is(what, "none"))
        failover_region(&value, sizeof value, "value");
    if (is(what, "overlap"))
        failover_region((char *)&value + 1, 1, "inside");
    if (is(what, "twice"))
        failover_region(bytes, sizeof bytes, "value");
    if (is(what, "latin"))
        failover_region(bytes, sizeof bytes, "gr\xfc" "n");
    if (is(what, "surrogate"))
        failover_region(bytes, sizeof bytes, "\xed\xa0\x80");
    if (is(what, "umlaut"))
        failover_region(bytes, sizeof bytes, "gr\xc3\xbcn \xf0\x9f\xa4\x96");
    if (is(what, "more"))
        failover_region(other, sizeof other, "other");
    if (is(what, "size"))
        failover_region(bytes, 100, "bytes");
    else if (is(what, "bytes"))
        failover_region(bytes, sizeof bytes, "bytes");
    if (is(what, "early"))
        say("commit", failover_commit());
    say("open", failover_open(is(what, "nameless") ? "//" : "asks"));
    if (failover_resumed() != NULL)
        printf("value %d\n%s", value, failover_resumed()->notes);
    value++;
    say("commit", failover_commit());
    if (is(what, "late"))
        say("region", failover_region(other, sizeof other, "other"));
    if (is(what, "child")) {
        fflush(stdout);
        if (fork() == 0) {
            say("child", failover_commit());
            exit(0);
        }
        wait(NULL);
        value++;
        say("commit", failover_commit());
    }
    if (is(what, "orphan") || is(what, "late orphan")) {
        if (is(what, "late orphan"))
            failover_wait(20000);
        fflush(stdout);
        if (fork() == 0) {
            say("child", 0);
            fflush(stdout);
            while (getchar() != EOF)
                continue;
            _exit(0);
        }
        say("wait", failover_wait(20000));
        fflush(stdout);
        pause();
    }
    if (is(what, "stay")) {
        fflush(stdout);
        say("wait", failover_wait(20000));
        fflush(stdout);
        while (getchar() == '\n') {
            value++;
            say("commit", failover_commit());
            fflush(stdout);
        }
    }
    say("close", failover_close());
    return 0;
}
