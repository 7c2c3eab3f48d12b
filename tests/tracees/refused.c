/* Holds one thing that a snapshot cannot carry, named by the second argument, and must go on as if nobody had looked.
 *
 * Prints "ready", or "cannot: …" with status 77 where this machine does not have the thing.
 */
#include "tracee.h"

#include <linux/bpf.h>
#include <linux/filter.h>
#include <linux/io_uring.h>
#include <linux/perf_event.h>
#include <linux/userfaultfd.h>
#include <mqueue.h>
#include <netinet/in.h>
#include <pthread.h>
#include <sys/fanotify.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/pidfd.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/un.h>
#ifdef __x86_64__
#include <asm/ldt.h>
#include <sys/io.h>
#endif

static const char *go;
static int opened; /* what a kind that is a descriptor leaves here is looked at again at the end */
static pid_t child;

static void keep(int file, const char *what) {
    if (file < 0) cannot("open %s", what);
    opened = file;
}

static void *nap_along(void *unused) {
    (void)unused;
    wait_for_go(go);
    return NULL;
}

/* A thread that makes itself unlike the first one, says so, and naps along. */
static volatile int is_unlike;
static int (*make_unlike)(void);

static void *nap_unlike(void *unused) {
    is_unlike = make_unlike() ? -1 : 1;
    return nap_along(unused);
}

static void take_unlike_thread(int (*make)(void)) {
    pthread_t thread;
    make_unlike = make;
    if (pthread_create(&thread, NULL, nap_unlike, NULL)) cannot("start a thread");
    while (!is_unlike) usleep(1000);
    if (is_unlike < 0) cannot("have a thread that is unlike the first");
}

static int unshare_files(void) { return unshare(CLONE_FILES) || open("/dev/null", O_RDONLY) < 0; }
static int unshare_root(void) { return unshare(CLONE_FS) || chroot("/proc/self/root/tmp"); }
static int unshare_names(void) { return unshare(CLONE_NEWUTS); }
static void take_thread_files(void) { take_unlike_thread(unshare_files); }
static void take_thread_root(void) { take_unlike_thread(unshare_root); }
static void take_thread_namespace(void) { take_unlike_thread(unshare_names); }

static int sleep_beside(void *unused) {
    (void)unused;
    while (!is_told(go)) usleep(2000);
    _exit(0);
}

static void take_child_in_the_same_memory(void) {
    static char stack[65536] __attribute__((aligned(16)));
    child = clone(sleep_beside, stack + sizeof stack, CLONE_VM | SIGCHLD, NULL);
    if (child < 0) cannot("share memory with a child");
}

static void *bear(void *unused) {
    child = fork();
    if (child) return nap_along(unused);
    while (!is_told(go)) usleep(2000);
    _exit(0);
}

static void take_child_of_thread(void) {
    pthread_t thread;
    if (pthread_create(&thread, NULL, bear, NULL)) cannot("start a thread");
    while (!*(volatile pid_t *)&child) usleep(1000);
}

static void take_child(void) {
    child = fork();
    if (child) return;
    while (!is_told(go)) usleep(2000);
    _exit(0);
}

static void take_zombie_child(void) {
    siginfo_t about;
    child = fork();
    if (child == 0) _exit(0);
    waitid(P_PID, child, &about, WEXITED | WNOWAIT);
}

static char state_of(pid_t pid) {
    char path[64], content[256] = "";
    snprintf(path, sizeof path, "/proc/%d/stat", pid);
    int file = open(path, O_RDONLY);
    if (file < 0 || read(file, content, sizeof content - 1) < 0) cannot("look at a child");
    close(file);
    return strrchr(content, ')')[2];
}

static void take_child_without_first_thread(void) {
    pthread_t thread;
    child = fork();
    if (child == 0) {
        if (pthread_create(&thread, NULL, nap_along, NULL)) _exit(1);
        syscall(SYS_exit, 0);
    }
    while (state_of(child) != 'Z') usleep(1000);
}

static void take_pipe(void) {
    int ends[2];
    if (pipe(ends)) cannot("make a pipe");
    keep(ends[1], "a pipe");
}

static void take_unix_rights(void) {
    int ends[2];
    char byte = 0, room[CMSG_SPACE(sizeof(int))] = {0};
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends)) cannot("make sockets");
    struct iovec content = {&byte, 1};
    struct msghdr message = {.msg_iov = &content, .msg_iovlen = 1, .msg_control = room, .msg_controllen = sizeof room};
    struct cmsghdr *rights = CMSG_FIRSTHDR(&message);
    rights->cmsg_level = SOL_SOCKET, rights->cmsg_type = SCM_RIGHTS, rights->cmsg_len = CMSG_LEN(sizeof(int));
    int passed = open("locked", O_RDWR | O_CREAT, 0600);
    if (flock(passed, LOCK_EX)) cannot("lock a file");
    memcpy(CMSG_DATA(rights), &passed, sizeof(int));
    if (sendmsg(ends[0], &message, 0) != 1 || close(passed)) cannot("send a descriptor");
    keep(ends[1], "a socket");
}

static int ask_for_connection(void) {
    struct sockaddr_un address = {.sun_family = AF_UNIX, .sun_path = "waiting.sock"};
    int client = socket(AF_UNIX, SOCK_STREAM, 0);
    keep(socket(AF_UNIX, SOCK_STREAM, 0), "a socket");
    if (bind(opened, (struct sockaddr *)&address, sizeof address) || listen(opened, 1)) cannot("listen");
    if (connect(client, (struct sockaddr *)&address, sizeof address)) cannot("connect");
    return client;
}

static void take_unix_waiting_data(void) {
    if (write(ask_for_connection(), "x", 1) != 1) cannot("write");
}

static void take_unix_waiting_gone(void) { close(ask_for_connection()); }

static void take_unix_urgent(void) {
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends) || send(ends[0], "ab", 2, MSG_OOB) != 2) cannot("send out of band");
    keep(ends[1], "a socket");
}

static void take_udp_corked(void) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(9), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    int on = 1;
    keep(socket(AF_INET, SOCK_DGRAM, 0), "a socket");
    if (connect(opened, (struct sockaddr *)&address, sizeof address) || setsockopt(opened, IPPROTO_UDP, 1, &on, sizeof on)) cannot("cork");
    if (send(opened, "begun", 5, 0) != 5) cannot("send");
}

static void take_netlink_socket(void) { keep(socket(AF_NETLINK, SOCK_RAW, 12 /* NETLINK_NETFILTER */), "a socket"); }

static void take_netlink_answer(void) {
    int request[] = {17, 18 | 0x301 << 16, 1, 0, 0}; /* RTM_GETLINK, of all */
    keep(socket(AF_NETLINK, SOCK_RAW, 0), "a socket");
    if (send(opened, request, 17, 0) != 17) cannot("ask");
}

static void take_vsock(void) { keep(socket(AF_VSOCK, SOCK_STREAM, 0), "a socket"); }

static void take_fanotify(void) { keep(fanotify_init(FAN_CLASS_NOTIF, O_RDONLY), "fanotify"); }

static void take_io_uring(void) {
    struct io_uring_params parameters = {0};
    keep(syscall(SYS_io_uring_setup, 8, &parameters), "io_uring");
}

static void take_io_uring_mapped(void) {
    struct io_uring_params parameters = {0};
    int ring = syscall(SYS_io_uring_setup, 8, &parameters);
    if (ring < 0) cannot("open io_uring");
    if (mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, ring, IORING_OFF_SQ_RING) == MAP_FAILED) cannot("map it");
    close(ring);
}

static void take_userfaultfd(void) {
    struct uffdio_api api = {.api = UFFD_API};
    keep(syscall(SYS_userfaultfd, O_CLOEXEC), "userfaultfd");
    ioctl(opened, UFFDIO_API, &api);
}

static void take_userfaultfd_registered(void) {
    take_userfaultfd();
    struct uffdio_register range = {.range = {(uintptr_t)map_pages(4, PROT_READ | PROT_WRITE, 0), 4 * PAGE},
                                    .mode = UFFDIO_REGISTER_MODE_MISSING};
    if (ioctl(opened, UFFDIO_REGISTER, &range)) cannot("register memory");
}

#ifdef __x86_64__
static void take_segments(void) {
    struct user_desc segment = {.entry_number = 1, .limit = 0xfffff, .seg_32bit = 1, .limit_in_pages = 1, .useable = 1};
    if (syscall(SYS_modify_ldt, 1, &segment, sizeof segment)) cannot("make a segment");
}

static void take_ports(void) {
    if (ioperm(0x80, 1, 1)) cannot("use an I/O port");
}
#else
static void take_segments(void) { cannot("make a segment: this processor has none"); }
static void take_ports(void) { cannot("use an I/O port: this processor has none"); }
#endif

static void take_flusher(void) {
    if (prctl(PR_SET_IO_FLUSHER, 1, 0, 0, 0)) cannot("write back for a file system");
}

static void take_lease_deleted(void) {
    keep(open("leased", O_RDWR | O_CREAT, 0600), "a file");
    if (fcntl(opened, F_SETLEASE, F_WRLCK) || unlink("leased")) cannot("take a lease");
}

static void take_kernel_log(void) { keep(open("/dev/kmsg", O_RDONLY), "/dev/kmsg"); }
static void take_tun(void) { keep(open("/dev/net/tun", O_RDWR), "/dev/net/tun"); }
static void take_fuse(void) { keep(open("/dev/fuse", O_RDWR), "/dev/fuse"); }

static void take_device_memory(void) {
    int memory = open("/dev/mem", O_RDONLY);
    if (memory < 0 || mmap(NULL, PAGE, PROT_READ, MAP_SHARED, memory, 0) == MAP_FAILED) cannot("map /dev/mem");
    close(memory);
}

static unsigned char *attached(void) {
    int segment = shmget(IPC_PRIVATE, 4 * PAGE, IPC_CREAT | 0600);
    void *place = segment < 0 ? (void *)-1 : shmat(segment, NULL, 0);
    if (segment >= 0) shmctl(segment, IPC_RMID, NULL);
    if (place == (void *)-1) cannot("attach shared memory");
    return place;
}

/* With somebody who is no child of ours any more, nor of our session. */
static void take_system_v_memory(void) {
    pid_t us = getpid();
    volatile unsigned char *place = attached();
    pid_t child = fork();
    if (!child) {
        if (fork()) _exit(0);
        setsid();
        *place = 1;
        while (!kill(us, 0)) usleep(2000);
        _exit(0);
    }
    waitpid(child, 0, 0);
    while (!*place) usleep(2000);
}

static void take_system_v_part(void) { munmap(attached() + 3 * PAGE, PAGE); }

static void take_message_queue(void) {
    struct mq_attr attributes = {.mq_maxmsg = 2, .mq_msgsize = 8};
    keep(mq_open("/failover-tracee", O_RDWR | O_CREAT, 0600, &attributes), "a message queue");
    mq_unlink("/failover-tracee");
}

static void take_bpf_map(void) {
    union bpf_attr attributes = {.map_type = BPF_MAP_TYPE_ARRAY, .key_size = 4, .value_size = 4, .max_entries = 1};
    keep(syscall(SYS_bpf, BPF_MAP_CREATE, &attributes, sizeof attributes), "a BPF map");
}

static void take_perf_event(void) {
    struct perf_event_attr event = {.type = PERF_TYPE_SOFTWARE, .size = sizeof event, .config = PERF_COUNT_SW_TASK_CLOCK};
    keep(syscall(SYS_perf_event_open, &event, 0, -1, -1, 0), "a performance event");
}

static void take_pidfd_other(void) { keep(pidfd_open(1, 0), "a pidfd"); }
/* One of a child, which has left ours. */
static void take_namespace(void) {
    int ends[2];
    char path[40], word;
    if (pipe(ends)) cannot("make a pipe");
    pid_t child = fork();
    if (child == 0) {
        if (unshare(CLONE_NEWUTS) || write(ends[1], "x", 1) != 1) _exit(1);
        pause();
    }
    close(ends[1]);
    if (read(ends[0], &word, 1) != 1) cannot("make a namespace");
    close(ends[0]);
    snprintf(path, sizeof path, "/proc/%d/ns/uts", child);
    keep(open(path, O_RDONLY), "a namespace");
    kill(child, SIGKILL), waitpid(child, NULL, 0);
}

static void take_proc_file(void) { keep(open("/proc/2/status", O_RDONLY), "a file of /proc"); }
static void take_kernel_switch(void) { keep(open("/proc/sys/kernel/hostname", O_RDWR), "a switch of the kernel"); }

static void take_secret_memory(void) {
    int file = syscall(SYS_memfd_secret, 0);
    if (file < 0 || ftruncate(file, PAGE)) cannot("make secret memory");
    char *place = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (place == MAP_FAILED) cannot("map secret memory");
    place[0] = 1;
    close(file);
}

static void take_memory_file(void) {
    keep(memfd_create("scratch", 0), "a memory file");
    if (ftruncate(opened, PAGE) || mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, opened, 0) == MAP_FAILED)
        cannot("map a memory file");
}

static char dispatches;
static void take_call(int number) {
    (void)number;
    dispatches = 0;
    differs("a system call that it did not make");
}

static void take_user_dispatch(void) {
    signal(SIGSYS, take_call);
    if (prctl(PR_SET_SYSCALL_USER_DISPATCH, PR_SYS_DISPATCH_ON, 1, 1, &dispatches)) cannot("dispatch system calls");
}

static void take_no_vdso(void) {
    unsigned long start = 0, end = 0;
    char line[600];
    FILE *maps = fopen("/proc/self/maps", "r");
    while (maps && fgets(line, sizeof line, maps))
        if (strstr(line, "[vdso]") && sscanf(line, "%lx-%lx", &start, &end) == 2) break;
    if (maps) fclose(maps);
    if (!end || munmap((void *)start, end - start)) cannot("unmap the vdso");
}

static void take_traced_child(void) {
    child = fork();
    if (child == 0) {
        ptrace(PTRACE_TRACEME, 0, 0, 0);
        raise(SIGSTOP);
        _exit(0);
    }
    waitpid(child, NULL, 0);
}

static void take_namespace_of_children(void) {
    if (unshare(CLONE_NEWPID)) cannot("make a namespace");
}

static void take_own_namespace(void) {
    if (unshare(CLONE_NEWUTS)) cannot("make a namespace");
}


static void take_directory_notice(void) {
    keep(open(".", O_RDONLY | O_DIRECTORY), "the directory");
    signal(SIGIO, SIG_IGN);
    if (fcntl(opened, F_NOTIFY, DN_CREATE | DN_MULTISHOT)) cannot("ask for notices");
}

static void take_owner_group(void) {
    keep(open("owned", O_RDONLY | O_CREAT, 0600), "a file");
    if (getpgrp() != getpid() && setpgid(0, 0)) cannot("lead a process group");
    if (fcntl(opened, F_SETOWN, -getpgid(getppid()))) cannot("have another program's group own signals");
}

static const struct kind {
    const char *name;
    void (*take)(void);
} kinds[] = {{"nothing", NULL},
             {"thread_files", take_thread_files},
             {"thread_root", take_thread_root},
             {"thread_namespace", take_thread_namespace},
             {"namespace_of_children", take_namespace_of_children},
             {"child_in_the_same_memory", take_child_in_the_same_memory},
             {"child_of_thread", take_child_of_thread},
             {"child", take_child},
             {"zombie_child", take_zombie_child},
             {"child_without_first_thread", take_child_without_first_thread},
             {"traced_child", take_traced_child},
             {"pipe", take_pipe},
             {"unix_rights", take_unix_rights},
             {"unix_waiting_data", take_unix_waiting_data},
             {"unix_waiting_gone", take_unix_waiting_gone},
             {"unix_urgent", take_unix_urgent},
             {"udp_corked", take_udp_corked},
             {"netlink_socket", take_netlink_socket},
             {"netlink_answer", take_netlink_answer},
             {"vsock", take_vsock},
             {"fanotify", take_fanotify},
             {"io_uring", take_io_uring},
             {"io_uring_mapped", take_io_uring_mapped},
             {"userfaultfd", take_userfaultfd},
             {"userfaultfd_registered", take_userfaultfd_registered},
              {"segments", take_segments},
             {"ports", take_ports},
             {"flusher", take_flusher},
             {"lease_deleted", take_lease_deleted},
             {"kernel_log", take_kernel_log},
             {"tun", take_tun},
             {"fuse", take_fuse},
             {"device_memory", take_device_memory},
             {"system_v_memory", take_system_v_memory},
            {"system_v_part", take_system_v_part},
             {"message_queue", take_message_queue},
             {"bpf_map", take_bpf_map},
             {"perf_event", take_perf_event},
             {"pidfd_other", take_pidfd_other},
             {"namespace", take_namespace},
             {"proc_file", take_proc_file},
             {"kernel_switch", take_kernel_switch},
             {"secret_memory", take_secret_memory},
             {"memory_file", take_memory_file},
              {"no_vdso", take_no_vdso},
             {"user_dispatch", take_user_dispatch},
             {"own_namespace", take_own_namespace},
             {"owner_group", take_owner_group},
             {"directory_notice", take_directory_notice}};

int main(int count, char **arguments) {
    go = arguments[1];
    signal(SIGCHLD, SIG_DFL);
    for (size_t index = 0; index < sizeof kinds / sizeof *kinds; index++) {
        if (count < 3 || strcmp(arguments[2], kinds[index].name)) continue;
        if (kinds[index].take) kinds[index].take();
        ready();
        wait_for_go(go);
        EXPECT(!opened || fcntl(opened, F_GETFD) != -1, "the descriptor is gone");
        if (child) {
            ptrace(PTRACE_DETACH, child, 0, SIGCONT);
            EXPECT(waitpid(child, NULL, 0) == child, "the child is gone");
        }
        return finish();
    }
    cannot("find the kind");
}
