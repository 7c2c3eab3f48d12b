"""What the engines bring back of every program besides what it has open: rows of the table, see `checkpoint.capability`."""

from __future__ import annotations

from typing import Final

from checkpoint.capability import Area, by_rule, preserved, refused

CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "name, arguments, environment, executable, directory, umask, limits, nice, switches of prctl(2)",
        "as they were",
    ),
    preserved(
        Area.PROCESS,
        "a root directory of its own (chroot)",
        "entered again, by who may (CAP_SYS_CHROOT), under an agent of root that is a program of root; it must be there",
    ),
    refused(
        Area.THERE,
        "a root directory of its own (chroot), without CAP_SYS_CHROOT",
        "restore it as root, or in a user namespace (`failover run`)",
        "and to enter it takes CAP_SYS_CHROOT",
    ),
    preserved(
        Area.PROCESS,
        "signals: actions, masks, what is pending, alternate stacks",
        "as they were; how often a timer went off while its signal was pending is lost",
    ),
    by_rule(
        Area.PROCESS,
        "the PID",
        "the same in a PID namespace of `failover run` (also for ordinary users), or where it is free; else another, and noted",
    ),
    by_rule(
        Area.PROCESS,
        "keys and keyrings of the kernel (keyctl); rules of Landlock, labels of AppArmor and SELinux",
        "they stay behind: the program has those of whoever restores it",
    ),
    by_rule(
        Area.MEMORY,
        "policies for the memory of several nodes (mbind, set_mempolicy)",
        "the other machine’s own: its nodes are others",
    ),
    by_rule(
        Area.PROCESS,
        "user, groups, capabilities",
        "as far as the agent has them; the program of an ordinary user comes back with his and no more",
        "of the program are not kept: we do not have them",
    ),
    preserved(
        Area.THREADS,
        "system calls in which a thread sleeps or waits",
        "made again with the time that is left; a few with a finite timeout end early with EINTR (README)",
    ),
    refused(
        Area.THERE,
        "a PID or thread id that is taken, of a program of several threads or one whose lock names it",
        "free it, or start the program with `failover run`, in PIDs of its own",
        "by which they know it, cannot be had",
        "it holds a lock that names its own pid",
        "and a lock that the program holds names it",
        "that id is in use",
        "choosing an id needs CAP_CHECKPOINT_RESTORE",
    ),
    preserved(
        Area.MEMORY,
        "private memory: heap, stacks, mapped files",
        "with protection, guard pages and advice; zero pages and untouched ones cost nothing, swapped ones are carried",
    ),
    preserved(
        Area.MEMORY,
        "shared memory that is the program's alone: anonymous, POSIX (/dev/shm), files",
        "made again, or mapped again where the file is",
    ),
    preserved(
        Area.PROCESS,
        "registers, floating point, SSE, AVX and AVX-512, scalable vectors (SVE), thread-local storage",
        "as they were",
    ),
    preserved(
        Area.TIME,
        "interval timers, POSIX timers, sleeps, relative or absolute, of the realtime, monotonic, boot and TAI clocks",
        "go on with what was left, the outage counted; where the hour is set later, a POSIX timer does not follow",
    ),
    preserved(
        Area.TIME,
        "timers of processor time (setitimer, CLOCK_PROCESS_CPUTIME_ID, CLOCK_THREAD_CPUTIME_ID)",
        "go on with what was left; the clocks themselves, and what getrusage tells, begin anew",
    ),
    by_rule(
        Area.TIME,
        "monotonic and boot clocks",
        "never go back, and go on from their reading where `failover run` gave a time namespace; the hour is the machine's",
    ),
)
