"""Capability rows for the state that the engines restore of every program besides its open files, see `checkpoint.capability`."""

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
        "entered again, if failover has CAP_SYS_CHROOT and the directory is there; an agent of root does so for programs "
        "of root only",
    ),
    refused(
        Area.THERE,
        "a root directory of its own (chroot), without CAP_SYS_CHROOT",
        "restore it as root, or in a user namespace (`failover run`)",
        "and to enter it takes CAP_SYS_CHROOT",
    ),
    preserved(
        Area.PROCESS,
        "signals: actions, masks, pending signals, alternate stacks",
        "as they were; how often a timer went off while its signal was pending is lost",
    ),
    by_rule(
        Area.PROCESS,
        "the PID",
        "the same, in a PID namespace of `failover run` (also for ordinary users) or where it is free; otherwise another "
        "one, and a note says so",
    ),
    by_rule(
        Area.PROCESS,
        "keys and keyrings of the kernel (keyctl); rules of Landlock; labels of AppArmor and SELinux",
        "not carried: the program gets those of the process that restores it",
    ),
    by_rule(
        Area.MEMORY,
        "memory policies for several nodes (mbind, set_mempolicy)",
        "those of the other machine, which has other nodes",
    ),
    by_rule(
        Area.PROCESS,
        "user, groups, capabilities",
        "as far as the agent has them; the program of an ordinary user comes back with that user's rights and no more",
        "of the program are not kept: failover does not have them",
    ),
    preserved(
        Area.THREADS,
        "system calls in which a thread sleeps or waits",
        "made again with the time that is left; a few with a finite timeout end early with EINTR (docs/limits.md)",
    ),
    refused(
        Area.THERE,
        "a PID or thread id that is taken, if the program has several threads or one of its locks names the id",
        "free the id, or start the program with `failover run`, which gives it PIDs of its own",
        "by which they know it, is not available",
        "it holds a lock that names its own pid",
        "and a lock that the program holds names it",
        "that id is in use",
        "choosing an id needs CAP_CHECKPOINT_RESTORE",
    ),
    preserved(
        Area.MEMORY,
        "private memory: heap, stacks, mapped files",
        "with protection, guard pages and advice; zero pages and untouched pages cost nothing, swapped pages are carried",
    ),
    preserved(
        Area.MEMORY,
        "shared memory that the program alone has: anonymous, POSIX (/dev/shm), files",
        "made again, or mapped again where the file exists",
    ),
    preserved(
        Area.PROCESS,
        "registers, floating point, SSE, AVX and AVX-512, scalable vectors (SVE), thread-local storage",
        "as they were",
    ),
    preserved(
        Area.TIME,
        "interval timers, POSIX timers and sleeps, relative or absolute, of the realtime, monotonic, boot and TAI clocks",
        "continue with the time that was left, and count the outage; if the clock is set later, a POSIX timer does not follow",
    ),
    preserved(
        Area.TIME,
        "timers of processor time (setitimer, CLOCK_PROCESS_CPUTIME_ID, CLOCK_THREAD_CPUTIME_ID)",
        "continue with the time that was left; the clocks themselves, and the figures of getrusage, begin anew",
    ),
    by_rule(
        Area.TIME,
        "monotonic and boot clocks",
        "never go back; they continue from their reading where `failover run` gave the program a time namespace. The time of "
        "day is the machine's",
    ),
)
