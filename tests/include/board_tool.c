/* A program with a board that does what its standard input says, a line at a time, and answers each with one line. */
#include "failover_board.h"
#include "failover_rtdb.h"

#include <inttypes.h>
#include <sys/wait.h>

enum { ITEMS = 16, WORDS = 16 };

static fb_board *board;
static struct {
    char name[64];
    fb_item *item;
    fb_component *of;
} found[ITEMS];

static fb_item *item_of(const char *name)
{
    for (int index = 0; index < ITEMS; index++)
        if (strcmp(found[index].name, name) == 0)
            return found[index].item;
    return NULL;
}

static void answer(int64_t outcome)
{
    if (outcome < 0)
        printf("%s: %s\n", strerror((int)-outcome), fb_error());
    else
        printf("ok\n");
}

static const char *robot_of(const char *word) { return strcmp(word, "-") == 0 ? FB_OWN : FB_ROBOT(word); }

static void get(const char *name, const char *robot)
{
    static char value[65536];
    fb_reading reading;
    int outcome = fb_get_reading(item_of(name), robot_of(robot), value, &reading);
    if (outcome != 0)
        answer(outcome);
    else
        printf("%.*s age %" PRId64 " max %" PRId64 " number %" PRIu64 " stale %d\n", (int)reading.size, value, reading.age_ns,
               reading.age_max_ns, reading.number, reading.stale);
}

static void wait_for(const char *name, const char *robot, const char *after, const char *ms)
{
    long long milliseconds = atoll(ms);
    struct timespec limit = {(time_t)(milliseconds / 1000), (long)(milliseconds % 1000) * 1000000};
    answer(fb_wait(item_of(name), robot_of(robot), strtoull(after, NULL, 10), &limit));
}

/* "NAME ROBOT AFTER NAME ROBOT AFTER … MS": the place of the first that was put. */
static void wait_for_any(char **words, int count)
{
    fb_watched watched[8];
    long long milliseconds = atoll(words[count - 1]);
    struct timespec limit = {(time_t)(milliseconds / 1000), (long)(milliseconds % 1000) * 1000000};
    for (int index = 0; index < count / 3; index++) {
        watched[index].item = item_of(words[3 * index]);
        watched[index].robot = robot_of(words[3 * index + 1]);
        watched[index].after = strtoull(words[3 * index + 2], NULL, 10);
    }
    int outcome = fb_wait_any(watched, (size_t)(count / 3), &limit);
    if (outcome < 0)
        answer(outcome);
    else
        printf("item %d\n", outcome);
}

static void youngest(const char *name)
{
    static char value[65536];
    char robot[65] = "";
    fb_reading reading;
    int outcome = fb_youngest(item_of(name), value, &reading, robot);
    if (outcome != 0)
        answer(outcome);
    else
        printf("%s %.*s\n", robot, (int)reading.size, value);
}

static void tell(void *context, const char *robot, const char *item, const void *value, const fb_reading *reading)
{
    printf("%s/%s=%.*s/%" PRIu64 "/%" PRId64 "/%" PRId64 "/%d ", robot, item, (int)reading->size, (const char *)value, reading->number,
           reading->age_ns, reading->age_max_ns, reading->stale);
    ++*(int *)context;
}

static void snapshot(void)
{
    int told = 0, outcome = fb_snapshot(board, tell, &told);
    if (outcome < 0)
        answer(outcome);
    else
        printf("%s\n", told == outcome ? "" : "miscounted");
}

static fb_component *component_of(const char *name)
{
    for (int index = 0; index < ITEMS; index++)
        if (strcmp(found[index].name, name) == 0)
            return found[index].of;
    return NULL;
}

static void follow(const char *name, const char *component)
{
    fb_component *made = fb_of(item_of(name), component);
    for (int index = 0; made != NULL && index < ITEMS; index++)
        if (strcmp(found[index].name, name) == 0)
            found[index].of = made;
    answer(made == NULL ? -errno : 0);
}

/* The number that a component has put; with `ms`: once it is another than that of `after`. */
static void of_component(const char *name, const char *after, const char *ms)
{
    long long milliseconds = atoll(ms);
    struct timespec limit = {(time_t)(milliseconds / 1000), (long)(milliseconds % 1000) * 1000000};
    uint64_t value = 77;
    fb_reading reading;
    int outcome = *ms == '\0' ? fb_component_get(component_of(name), &value, &reading)
                              : fb_component_wait(component_of(name), &value, &reading, strtoull(after, NULL, 10), &limit);
    if (outcome != 0 && value != 77)
        printf("failed, and wrote the value %" PRIu64 "\n", value);
    else if (outcome != 0)
        answer(outcome);
    else
        printf("%" PRIu64 " %s number %" PRIu64 " age %" PRId64 " max %" PRId64 "\n", value, fb_component_robot(component_of(name)),
               reading.number, reading.age_ns, reading.age_max_ns);
}

static void add(const char *name, const char *size, const char *area, const char *type)
{
    fb_declaration wanted = {0};
    wanted.name = name;
    wanted.size = (uint32_t)atoi(size);
    wanted.is_private = strcmp(area, "private") == 0;
    wanted.kind = *type != '\0' ? FB_STRUCT : FB_BYTES;
    wanted.type = *type != '\0' ? type : NULL;
    answer(fb_add(board, &wanted));
}

static void find(const char *name, const char *size, const char *digest)
{
    fb_item *item = fb_find(board, name, (size_t)atoi(size), strtoull(digest, NULL, 16));
    if (item == NULL) {
        answer(-errno);
        return;
    }
    for (int index = 0; index < ITEMS; index++)
        if (found[index].item == NULL) {
            snprintf(found[index].name, sizeof found[index].name, "%s", name);
            found[index].item = item;
            break;
        }
    printf("ok\n");
}

static void put_in_child(const char *name, const char *value)
{
    fflush(stdout);
    pid_t child = fork();
    if (child == 0) {
        answer(fb_put_sized(item_of(name), value, strlen(value), FB_NOW));
        fflush(stdout);
        _exit(0);
    }
    waitpid(child, NULL, 0);
}

static void database(char **words)
{
    char value[65536];
    memset(value, 0, sizeof value);
    if (strcmp(words[1], "init") == 0)
        printf("%d\n", DB_init());
    else if (strcmp(words[1], "free") == 0)
        DB_free(), printf("0\n");
    else if (strcmp(words[1], "who") == 0)
        printf("%d\n", Whoami());
    else if (strcmp(words[1], "put") == 0)
        snprintf(value, sizeof value, "%s", words[3]), printf("%d\n", DB_put(atoi(words[2]), value));
    else {
        int life = DB_get(strcmp(words[2], "-") == 0 ? SELF : atoi(words[2]), atoi(words[3]), value);
        printf("%d %s\n", life, value);
    }
}

static void digest(const char *size)
{
    static unsigned char bytes[70000];
    for (size_t index = 0; index < sizeof bytes; index++)
        bytes[index] = (unsigned char)(index * 131 + (index >> 8));
    printf("%016" PRIx64 "\n", fb_digest_(bytes, strtoull(size, NULL, 10)));
}

int main(void)
{
    char line[70000], *words[WORDS], nothing[] = "";
    setvbuf(stdout, NULL, _IOLBF, 0);
    while (fgets(line, sizeof line, stdin) != NULL) {
        char *kept = NULL;
        int count = 0;
        line[strcspn(line, "\n")] = '\0';
        for (int index = 0; index < WORDS; index++)
            words[index] = nothing;
        for (char *word = strtok_r(line, " ", &kept); word != NULL && count < WORDS; word = strtok_r(NULL, " ", &kept))
            words[count++] = word;
        if (strcmp(words[0], "open") == 0)
            board = fb_open(*words[1] == '\0' ? NULL : words[1]), answer(board == NULL ? -errno : 0);
        else if (strcmp(words[0], "close") == 0)
            fb_close(board), board = NULL, memset(found, 0, sizeof found), printf("ok\n");
        else if (strcmp(words[0], "add") == 0)
            add(words[1], words[2], words[3], words[4]);
        else if (strcmp(words[0], "remove") == 0)
            answer(fb_remove(board, words[1]));
        else if (strcmp(words[0], "follow") == 0)
            follow(words[1], words[2]);
        else if (strcmp(words[0], "of") == 0)
            of_component(words[1], words[2], words[3]);
        else if (strcmp(words[0], "find") == 0)
            find(words[1], words[2], words[3]);
        else if (strcmp(words[0], "put") == 0)
            answer(fb_put_sized(item_of(words[1]), words[2], strlen(words[2]), *words[3] == '\0' ? FB_NOW : atoll(words[3])));
        else if (strcmp(words[0], "get") == 0)
            get(words[1], words[2]);
        else if (strcmp(words[0], "wait") == 0)
            wait_for(words[1], words[2], words[3], words[4]);
        else if (strcmp(words[0], "any") == 0)
            wait_for_any(words + 1, count - 1);
        else if (strcmp(words[0], "youngest") == 0)
            youngest(words[1]);
        else if (strcmp(words[0], "user") == 0)
            answer(setresuid((uid_t)atoi(words[1]), (uid_t)atoi(words[1]), (uid_t)atoi(words[1])) == 0 ? 0 : -errno);
        else if (strcmp(words[0], "snapshot") == 0)
            snapshot();
        else if (strcmp(words[0], "child") == 0)
            put_in_child(words[1], words[2]);
        else if (strcmp(words[0], "db") == 0)
            database(words);
        else if (strcmp(words[0], "digest") == 0)
            digest(words[1]);
        else if (strcmp(words[0], "robot") == 0) {
            char name[65] = "";
            int outcome = fb_robot(board, name, sizeof name);
            outcome != 0 ? answer(outcome) : (void)printf("%s\n", name);
        } else
            printf("what?\n");
    }
    return 0;
}
