"""The few system calls that a guard needs and that Python does not offer.

Sources: prctl(2), mlock(2), fallocate(2), sigqueue(3).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import threading
from collections.abc import Iterable
from typing import Final

PR_SET_CHILD_SUBREAPER: Final = 36
MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
MCL_ONFAULT: Final = 4
FALLOC_FL_KEEP_SIZE: Final = 1
FALLOC_FL_PUNCH_HOLE: Final = 2
THREAD_STACK: Final = 256 << 10
"""Bytes; the usual 8 MB are for programs that know nothing of their threads."""

_libc = ctypes.CDLL(None, use_errno=True)
_libc.mlock.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
_libc.fallocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)


def become_subreaper() -> None:
    """Become the parent of every descendant whose own parent dies.

    Raises:
        OSError: the kernel says no (it has known this since 3.4).
    """
    _check(_libc.prctl(PR_SET_CHILD_SUBREAPER, ctypes.c_ulong(1), 0, 0, 0), "prctl(PR_SET_CHILD_SUBREAPER)")


def small_stacks() -> None:
    """Have threads that are started from now on use `THREAD_STACK`: where memory is locked, every byte of it is there."""
    threading.stack_size(THREAD_STACK)


def give_back() -> None:
    """Let the kernel have what the C library holds free: after a start, a megabyte. Source: malloc_trim(3); not in every libc."""
    with contextlib.suppress(AttributeError):
        _libc.malloc_trim(0)


def become_realtime(priority: int) -> int:
    """Run this process ahead of ordinary ones (SCHED_FIFO), its children not; the priority that it has, which may be less.

    All threads that it has by now do: one at ordinary priority that waits for a processor with the interpreter's lock in its hand
    would hold up the others.

    Raises:
        OSError: none at all is allowed. With neither CAP_SYS_NICE nor a limit (RLIMIT_RTPRIO) above 0, none is.

    Source: sched(7).
    """
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    wanted = [priority, limit] if 0 < limit < priority else [priority]
    for one in wanted:
        try:
            for thread in os.listdir("/proc/self/task"):
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.sched_setscheduler(int(thread), os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(one))
            return one
        except PermissionError as error:
            refusal = error
    raise refusal


def lock_memory() -> None:
    """Keep every page of this process in memory, also those of mappings that are still to come; children do not inherit it.

    What comes from files, or has been swapped out, is all read now: never will a disk be waited for. Memory that begins as zeros
    stays when it is first used: until then the unused parts of stacks, and of the tables that allocators spread over address
    space, take nothing. Such a first use costs a microsecond, and whoever runs in real time gets its page from what the kernel
    holds back for that.

    Who has threads calls `small_stacks` before the first of them.

    Raises:
        OSError: RLIMIT_MEMLOCK is too small and CAP_IPC_LOCK is missing.

    Source: mlock(2); gfp_to_alloc_flags in mm/page_alloc.c.
    """
    _check(_libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT), "mlockall")
    with open("/proc/self/smaps") as smaps:
        spans = on_disk(smaps)
    for address, size in spans:
        _check(_libc.mlock(address, size), "mlock")
    _check(_libc.mlockall(MCL_FUTURE), "mlockall")  # what will be mapped: whole, as it is mapped


def on_disk(smaps: Iterable[str]) -> list[tuple[int, int]]:
    """(address, size) of readable mappings of which a part may lie on a disk only: those of files, and of what was swapped out.

    Line by line: their whole text would leave a hole in the memory that is about to be locked. Source: proc_pid_smaps(5).
    """
    spans: list[tuple[int, int]] = []
    span, mode, inode = "", "", ""
    for line in smaps:
        name, *values = line.split(maxsplit=5)
        if not name.endswith(":"):
            span, mode, inode = name, values[0], values[3]
        elif name == "Swap:" and mode.startswith("r") and (inode != "0" or values[0] != "0"):
            start, end = (int(part, 16) for part in span.split("-"))
            spans.append((start, end - start))
    return spans


def punch_hole(descriptor: int, offset: int, size: int) -> None:
    """Give the file's bytes [offset, offset + size) back to the disk; they read as zeros, the file keeps its size.

    Raises:
        OSError: EOPNOTSUPP where the filesystem cannot.
    """
    _check(_libc.fallocate(descriptor, FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE, offset, size), "fallocate(PUNCH_HOLE)")


def queue_signal(pid: int, number: int, value: int) -> None:
    """Send a process a signal with a value, which a handler with SA_SIGINFO finds as ``si_value.sival_ptr``.

    Raises:
        OSError: ESRCH, EPERM; EAGAIN where too many wait already.
    """
    _check(_libc.sigqueue(pid, number, ctypes.c_void_p(value)), "sigqueue")


def _check(result: int, what: str) -> None:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
