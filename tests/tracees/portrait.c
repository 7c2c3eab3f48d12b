/* What a process is besides its memory: one attribute is set to something unusual, then all are compared.
 *
 * Usage: portrait GO ATTRIBUTE. "plain" changes nothing. Process ids are not part of it.
 */
#include "tracee.h"

#include <grp.h>
#include <linux/capability.h>
#include <linux/securebits.h>
#include <sys/auxv.h>
#include <sys/personality.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/utsname.h>

#define LIMIT 120
static char lines[2][LIMIT][700];
static int line_count[2];
extern char **environ;

__attribute__((format(printf, 2, 3))) static void add(int when, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    if (line_count[when] < LIMIT) vsnprintf(lines[when][line_count[when]++], 700, format, arguments);
    va_end(arguments);
}

static void add_file(int when, const char *path) {
    unsigned char bytes[3000];
    int file = open(path, O_RDONLY), size = file < 0 ? -1 : (int)read(file, bytes, sizeof bytes);
    uint64_t sum = 0;
    for (int index = 0; index < size; index++) sum = mix(sum ^ bytes[index]);
    add(when, "%s: %d bytes, sum %llx, starts %.*s", path, size, (unsigned long long)sum,
        size < 0 ? 0 : size < 60 ? size : 60, (char *)bytes);
    if (file >= 0) close(file);
}

static void add_status(int when) {
    static const char *const wanted[] = {"Name:",   "Umask:",  "Uid:",    "Gid:",     "Groups:", "CapInh:",
                                         "CapPrm:", "CapEff:", "CapBnd:", "CapAmb:",  "NoNewPrivs:", "Seccomp:",
                                         "SigBlk:", "SigIgn:", "SigCgt:", "THP_enabled:", "Cpus_allowed:", "CoreDumping:",
                                         "Threads:", "Speculation_Store_Bypass:"};
    char line[700];
    FILE *status = fopen("/proc/self/status", "r");
    while (status && fgets(line, sizeof line, status))
        for (size_t index = 0; index < sizeof wanted / sizeof *wanted; index++)
            if (!strncmp(line, wanted[index], strlen(wanted[index]))) add(when, "%s", strtok(line, "\n"));
    if (status) fclose(status);
}

static void add_layout(int when) { /* of proc_pid_stat(5): 26..28 code and stack, 45..51 data, brk, args, env */
    char text[2000], *field;
    FILE *stat = fopen("/proc/self/stat", "r");
    int number = 2;
    text[stat ? fread(text, 1, sizeof text - 1, stat) : 0] = 0;
    if (stat) fclose(stat);
    for (field = strtok(strrchr(text, ')'), " "); field; field = strtok(NULL, " "), number++)
        if ((number >= 26 && number <= 28) || (number >= 45 && number <= 51)) add(when, "stat field %d: %s", number, field);
}

static void paint(int when) {
    char text[600], name[16] = "";
    cpu_set_t processors;
    int ssize = readlink("/proc/self/exe", text, 500), option;
    text[ssize > 0 ? ssize : 0] = 0;
    add(when, "exe %s", text);
    ssize = readlink("/proc/self/cwd", text, 500);
    text[ssize > 0 ? ssize : 0] = 0;
    add(when, "cwd %s", text);
    add_file(when, "/proc/self/cmdline");
    add_file(when, "/proc/self/comm");
    add_file(when, "/proc/self/environ");
    add_file(when, "/proc/self/auxv");
    add_file(when, "/proc/self/oom_score_adj");
    add_file(when, "/proc/self/timerslack_ns");
    add_file(when, "/proc/self/personality");
    add_file(when, "/proc/self/coredump_filter");
    if (!access("/proc/self/loginuid", R_OK)) add_file(when, "/proc/self/loginuid");
    add_status(when);
    add_layout(when);
    prctl(PR_GET_NAME, name);
    add(when, "name %s", name);
    add(when, "nice %d", getpriority(PRIO_PROCESS, 0));
    for (int limit = 0; limit < 16; limit++) {
        struct rlimit now;
        getrlimit(limit, &now);
        add(when, "limit %d: %llx %llx", limit, (long long)now.rlim_cur, (long long)now.rlim_max);
    }
    add(when, "personality %x", personality(0xffffffff));
    add(when, "dumpable %d, keep caps %d, securebits %x, timer slack %d", prctl(PR_GET_DUMPABLE), prctl(PR_GET_KEEPCAPS),
        prctl(PR_GET_SECUREBITS), prctl(PR_GET_TIMERSLACK));
    prctl(PR_GET_PDEATHSIG, &option);
    add(when, "parent death signal %d", option);
    prctl(PR_GET_CHILD_SUBREAPER, &option);
    add(when, "child subreaper %d, huge pages off %d", option, prctl(PR_GET_THP_DISABLE, 0, 0, 0, 0));
    prctl(PR_GET_TSC, &option);
    add(when, "tsc %d, memory merge %d, mce kill %d, io flusher %d", option, prctl(68 /* PR_GET_MEMORY_MERGE */, 0, 0, 0, 0),
        prctl(PR_MCE_KILL_GET, 0, 0, 0, 0), prctl(PR_GET_IO_FLUSHER, 0, 0, 0, 0));
    add(when, "store bypass %d, memory write execute %d", prctl(PR_GET_SPECULATION_CTRL, 0, 0, 0, 0),
        prctl(66 /* PR_GET_MDWE */, 0, 0, 0, 0));
    add(when, "registered for memory barriers %lx", syscall(SYS_membarrier, 1 << 9 /* MEMBARRIER_CMD_GET_REGISTRATIONS */, 0, 0));
    sched_getaffinity(0, sizeof processors, &processors);
    add(when, "processors %d", CPU_COUNT(&processors));
    struct {
        uint32_t size, policy;
        uint64_t flags;
        int32_t nice;
        uint32_t priority;
        uint64_t runtime, deadline, period;
        uint32_t low, high;
    } policy = {0};
    syscall(SYS_sched_getattr, 0, &policy, sizeof policy, 0);
    add(when, "policy %u flags %llx nice %d priority %u runtime %llu", policy.policy, (long long)policy.flags, policy.nice,
        policy.priority, (unsigned long long)policy.runtime);
    add(when, "io priority %ld", syscall(SYS_ioprio_get, 1, 0));
    add(when, "page size from auxv %ld, random bytes at %lx, session %d", getauxval(AT_PAGESZ), getauxval(AT_RANDOM),
        getsid(0) == getpid());
}

static void drop(const char *what) {
    if (!strcmp(what, "user") || !strcmp(what, "groups")) {
        gid_t groups[] = {65534, 1000, 70000};
        if (setgroups(3, groups)) cannot("set groups");
    }
    if (!strcmp(what, "user") && (setresgid(65534, 1001, 1002) || setresuid(65534, 65534, 65534))) cannot("set ids");
    if (!strcmp(what, "setuid") && (setresgid(65534, 1001, 0) || setresuid(65534, 1001, 0))) cannot("set ids");
    if (!strcmp(what, "effective") && (setegid(65534) || seteuid(65534))) cannot("set effective ids");
    if (!strcmp(what, "fsuid")) syscall(SYS_setfsgid, 1000), syscall(SYS_setfsuid, 1000);
    if (!strcmp(what, "capabilities")) {
        struct __user_cap_header_struct header = {_LINUX_CAPABILITY_VERSION_3, 0};
        struct __user_cap_data_struct sets[2] = {{1 << CAP_NET_RAW | 1 << CAP_CHOWN, 1 << CAP_NET_RAW | 1 << CAP_CHOWN |
                                                  1 << CAP_KILL, 1 << CAP_CHOWN}, {0, 0, 0}};
        prctl(PR_CAPBSET_DROP, CAP_SYS_MODULE, 0, 0, 0);
        if (syscall(SYS_capset, &header, sets)) cannot("set capabilities");
        if (prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_CHOWN, 0, 0)) cannot("raise an ambient capability");
    }
    if (!strcmp(what, "securebits") && prctl(PR_SET_SECUREBITS, SECBIT_NOROOT | SECBIT_KEEP_CAPS_LOCKED))
        cannot("set securebits");
    if (!strcmp(what, "keep_caps")) prctl(PR_SET_KEEPCAPS, 1);
    if (!strcmp(what, "no_new_privs")) prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
}

static void tune(const char *what) {
    struct rlimit limit = {77, 99};
    cpu_set_t one;
    CPU_ZERO(&one);
    CPU_SET(sched_getcpu(), &one);
    if (!strcmp(what, "name")) prctl(PR_SET_NAME, " )\n\\n\rUid:0( ");
    if (!strcmp(what, "umask")) umask(0135);
    if (!strcmp(what, "nice") && nice(7) == -1) cannot("be nice");
    if (!strcmp(what, "limits")) {
        setrlimit(RLIMIT_NOFILE, &limit);
        limit.rlim_cur = limit.rlim_max = 0;
        setrlimit(RLIMIT_CORE, &limit);
        limit.rlim_cur = 4 << 20, limit.rlim_max = RLIM_INFINITY;
        setrlimit(RLIMIT_STACK, &limit);
    }
    if (!strcmp(what, "personality")) personality(ADDR_NO_RANDOMIZE | UNAME26);
    if (!strcmp(what, "membarrier") && (syscall(SYS_membarrier, 1 << 4, 0, 0) || syscall(SYS_membarrier, 1 << 6, 0, 0)))
        cannot("register for memory barriers");
    if (!strcmp(what, "dumpable")) prctl(PR_SET_DUMPABLE, 0);
    if (!strcmp(what, "parent_death_signal")) prctl(PR_SET_PDEATHSIG, SIGUSR2);
    if (!strcmp(what, "subreaper")) prctl(PR_SET_CHILD_SUBREAPER, 1);
    if (!strcmp(what, "huge_pages_off")) prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0);
    if (!strcmp(what, "huge_pages_advised") && prctl(PR_SET_THP_DISABLE, 1, 2, 0, 0)) cannot("have huge pages where advised");
    if (!strcmp(what, "timer_slack")) prctl(PR_SET_TIMERSLACK, 1234567);
    if (!strcmp(what, "affinity") && sched_setaffinity(0, sizeof one, &one)) cannot("bind to a processor");
    if (!strcmp(what, "batch") && sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){0})) cannot("batch");
    if (!strcmp(what, "idle") && sched_setscheduler(0, SCHED_IDLE, &(struct sched_param){0})) cannot("idle");
    if (!strcmp(what, "realtime") &&
        sched_setscheduler(0, SCHED_RR | SCHED_RESET_ON_FORK, &(struct sched_param){.sched_priority = 3}))
        cannot("set a realtime policy");
    if (!strcmp(what, "io_priority") && syscall(SYS_ioprio_set, 1, 0, 3 << 13 | 0)) cannot("set the io priority");
    if (!strcmp(what, "io_priority_best") && syscall(SYS_ioprio_set, 1, 0, 2 << 13 | 6)) cannot("set the io priority");
    if (!strcmp(what, "no_tsc")) prctl(PR_SET_TSC, PR_TSC_SIGSEGV);
    if (!strcmp(what, "memory_merge") && prctl(67 /* PR_SET_MEMORY_MERGE */, 1, 0, 0, 0)) cannot("merge memory");
    if (!strcmp(what, "mdwe")) prctl(65 /* PR_SET_MDWE */, 1, 0, 0, 0);
    if (!strcmp(what, "store_bypass")) prctl(PR_SET_SPECULATION_CTRL, 0, 4, 0, 0);
    if (!strcmp(what, "mce_kill")) prctl(PR_MCE_KILL, PR_MCE_KILL_SET, PR_MCE_KILL_EARLY, 0, 0);
    if (!strcmp(what, "directory") && (mkdir("a directory", 0700) || chdir("a directory"))) cannot("change directory");
    if (!strcmp(what, "deleted_directory") && (mkdir("gone", 0700) || chdir("gone") || rmdir("../gone")))
        cannot("delete the working directory");
}

static void write_word(const char *path, const char *word) {
    int file = open(path, O_WRONLY);
    if (file < 0 || write(file, word, strlen(word)) < 0) cannot("write %s", path);
    close(file);
}

int main(int count, char **arguments) {
    const char *what = count > 2 ? arguments[2] : "plain";
    int moves = !strcmp(what, "directory"); /* the others may become a user who cannot walk down to the working directory */
    char path[700];
    snprintf(path, sizeof path, "%s%s%s", moves ? realpath(".", NULL) : "", moves ? "/" : "", arguments[1]);
    tune(what);
    drop(what);
    if (!strcmp(what, "oom")) write_word("/proc/self/oom_score_adj", "321");
    if (!strcmp(what, "coredump_filter")) write_word("/proc/self/coredump_filter", "0x71");
    if (!strcmp(what, "login")) write_word("/proc/self/loginuid", "4321");
    if (!strcmp(what, "arguments")) { /* as setproctitle does: the words in place are overwritten */
        memset(arguments[2], 'x', strlen(arguments[2]));
        setenv("LATER", "set", 1);
        environ[0][0] = 'Z';
    }
    paint(0);
    ready();
    if (strcmp(what, "no_tsc"))
        wait_for_go(path);
    else
        while (!is_told(path)) sched_yield();
    paint(1);
    EXPECT_EQUAL("lines of the portrait", line_count[1], line_count[0]);
    for (int index = 0; index < line_count[0]; index++)
        EXPECT(!strcmp(lines[0][index], lines[1][index]), "%s || was || %s", lines[1][index], lines[0][index]);
    return finish();
}
