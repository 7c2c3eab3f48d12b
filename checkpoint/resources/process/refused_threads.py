"""Refuse threads that do not share what the threads of a program normally share. This module only reads; it changes nothing.

A restored thread is in the namespaces of the first one, so it must be in them at the capture.
`checkpoint.resources.process.unshared_threads` lists what else a thread may have for itself.

Source: pthreads(7), credentials(7), unshare(2), kcmp(2).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import can_look_through
from checkpoint.linux.procfs.procfs import Status
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.procfs.timers import parse_timers
from checkpoint.linux.trace import seccomp as trace_seccomp
from checkpoint.linux.trace.threads import Threads
from checkpoint.resources.process import seccomp, unshared_threads
from checkpoint.sentences import AS_SOON_AS

CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "all threads of the program, up to 4,096",
        "frozen together; with ids, names, registers, signals, stacks, robust lists, rseq, scheduling, processors",
    ),
    preserved(
        Area.THREADS,
        "threads that run on after the first one has ended (pthread_exit in main)",
        "the first thread has ended again, with its status; needs Linux 6.9",
    ),
    refused(
        Area.THREADS,
        "threads that run on after the first one has ended, before Linux 6.9",
        "let the first thread wait for them",
        "this kernel lends no descriptors",
    ),
    refused(Area.THREADS, "more than 4,096 threads", "start fewer threads", "threads; the limit is"),
    refused(
        Area.THREADS,
        "threads that run on after the first one has ended (pthread_exit in main), in a program of several processes",
        "let the first thread wait for them",
        "its first thread has ended while",
    ),
    refused(
        Area.THREADS,
        "a thread with its own namespaces or personality",
        "let all threads share these",
        "lives in a namespace of its own ({})",
        "has an execution domain of its own",
    ),
    refused(
        Area.THREADS,
        "a thread that handles its own system calls (PR_SET_SYSCALL_USER_DISPATCH)",
        "run the program without it: a capture makes system calls in the thread",
        "handles its system calls itself",
    ),
    refused(Area.THREADS, "a thread under a debugger", "end the debugger", "is traced by pid"),
    refused(
        Area.TIME,
        "a timer on CLOCK_THREAD_CPUTIME_ID in a program of several threads",
        "use another clock: the kernel does not tell whose time the timer counts",
        "a timer that counts the processor time of one of its threads",
    ),
    refused(
        Area.PROCESS,
        "a process that shares its memory with its parent (vfork, clone(2))",
        f"wait: {AS_SOON_AS} it has executed a program",
        "it shares its {} with its parent",
    ),
)

THREAD_LIMIT: Final = 4096
"""Threads of one program: the state of each takes 3 to 12 KB, of 32 MiB."""

CLOCK_THREAD_CPUTIME: Final = 3
OF_SEVERAL: Final = (
    "its first thread has ended while others live, and its component has other processes, which is not kept yet: "
    "let the first one wait for the other threads"
)
_NAMESPACES: Final = ("net", "ipc", "uts", "cgroup", "mnt", "user", "pid_for_children", "time_for_children")


def refuse(pid: int, status: Status) -> Iterator[str]:
    """Why the threads of a process cannot be captured.

    Args:
        status: of the first one.
    """
    yield from refuse_shared_memory(pid, status)
    if status.threads == 1:
        return
    if pid != status.tgid and not can_look_through(pid):
        yield "its first thread has ended while others live, and this kernel lends no descriptors through another: Linux 6.9 does"
    if status.threads > THREAD_LIMIT:
        yield f"it has {status.threads} threads; the limit is {THREAD_LIMIT}: let the program start fewer"
        return
    if status.state in "ZX":
        yield from refuse_ended_first(status)
        return
    first = _Shared.of(pid, pid)
    for tid in thread_ids(pid):
        if tid != pid:
            try:
                yield from _refuse_thread(pid, first, tid)
            except (ProcessGoneError, ProbeError, FileNotFoundError):
                continue  # this one has ended
    if any(timer.clock == CLOCK_THREAD_CPUTIME for timer in parse_timers(procfs.read_text(pid, "timers"))):
        yield (
            "it has a timer that counts the processor time of one of its threads, and the kernel does not tell which: "
            "use another clock"
        )


def refuse_ended_first(status: Status) -> Iterator[str]:
    """Why a process whose first thread has ended cannot be captured; nothing stands against one that has ended as a whole."""
    if status.state in "ZX" and status.threads > 1:
        yield (
            f"its first thread has ended while {status.threads - 1} others live, which is not kept yet: "
            "let the first thread wait for them"
        )


def refuse_kin(threads: Threads) -> tuple[str, ...]:
    """Why a process that has children, or others in its component, cannot be captured: by its first thread they know it."""
    return (OF_SEVERAL,) if threads.process != threads.pid else ()


def refuse_shared_memory(pid: int, status: Status) -> Iterator[str]:
    """Why a process that shares its parent's memory cannot be captured: our calls in it would act on both."""
    if status.ppid > 1:
        yield from _refuse_shared(pid, status.ppid, ((abi.KCMP_VM, "memory"),))


def _refuse_shared(pid: int, parent: int, kinds: Iterable[tuple[int, str]]) -> Iterator[str]:
    for kind, what in kinds:
        if abi.kcmp(pid, parent, kind) == 0:
            yield f"it shares its {what} with its parent {parent}, a process of its own (vfork, clone), which is not kept yet"


def of_dispatching(tid: int) -> str:
    """Why a thread whose calls end in a handler of its own cannot be entered; only a tracer is told."""
    return f"its thread {tid} handles its system calls itself (PR_SET_SYSCALL_USER_DISPATCH): run it without"


class _Shared(Struct, frozen=True):
    """The facts that all threads of a program must have alike.

    Attributes:
        tracer: 0 also where we are the tracer: we may still hold threads that did not stop in time for an earlier look.
    """

    tracer: int
    seccomp: int
    namespaces: tuple[str, ...]
    personality: bytes

    @classmethod
    def of(cls, pid: int, tid: int) -> _Shared:
        status = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status"))
        return cls(
            tracer=0 if status.tracer == os.getpid() else status.tracer,
            seccomp=status.seccomp,
            namespaces=tuple(_namespace(pid, tid, kind) for kind in _NAMESPACES),
            personality=procfs.read_line(pid, f"task/{tid}/personality"),
        )


def _namespace(pid: int, tid: int, kind: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/task/{tid}/ns/{kind}")
    except OSError:
        return ""  # a kernel without this kind, or it has ended


def _refuse_thread(pid: int, first: _Shared, tid: int) -> tuple[str, ...]:
    """The reasons against one thread; none for a thread that is about to end, which shares less and less."""
    shared = _Shared.of(pid, tid)
    own = unshared_threads.own(pid, tid)
    if shared == first and not own:
        return ()
    reasons = tuple(_unlike(pid, tid, shared, first, own))
    return reasons if not procfs.thread_stat(pid, tid).flags & procfs.PF_EXITING else ()


def _unlike(pid: int, tid: int, shared: _Shared, first: _Shared, own: unshared_threads.Own) -> Iterator[str]:
    status = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status"))
    named = f"its thread {tid} ({status.name})"
    if shared.tracer:
        yield f"{named} is traced by pid {shared.tracer}: end that debugger"
    elif shared.seccomp and (why := trace_seccomp.why_not()):
        yield seccomp.not_ours(why, named)
    if own:
        yield from unshared_threads.refuse(pid, tid, own)
    pairs = zip(_NAMESPACES, shared.namespaces, first.namespaces, strict=True)
    if differing := [kind for kind, here, there in pairs if here != there]:
        yield f"{named} lives in a namespace of its own ({', '.join(differing)}), which is not kept yet"
    if shared.personality != first.personality:
        yield f"{named} has an execution domain of its own (personality), which is not kept yet"
