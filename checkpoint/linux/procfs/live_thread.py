"""Find the thread by whose id a process is inspected: its first one, or a live one where the first one has ended.

A first thread that ends before the others (pthread_exit in main) stays as a zombie that keeps the process's id. It has no memory,
maps or descriptors any more, no tracer can trace it, and it can answer no question. But the facts that /proc and the kernel's
calls report of a process they report by the id of any of its threads; only the list of /proc does not name those. So an
inspection uses the id of a live thread (its spokesman), and the id that other processes use stays the same
(`checkpoint.linux.procfs.procfs.Status.tgid`).

Source: proc_pid(5), pid_namespaces(7); proc_pid_lookup() in fs/proc/base.c; PIDFD_THREAD of pidfd_open(2), since Linux 6.9.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from typing import Final, TypeVar

from checkpoint.errors import CheckpointError, ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids

Answer = TypeVar("Answer")
PIDFD_THREAD: Final = os.O_EXCL
SPOKESMEN_MAX: Final = 8
"""How many spokesmen of a process may end, one after the other, during one look."""
_NOT_A_PROCESS: Final = (errno.EINVAL, errno.ENOENT)
"""The errors of pidfd_open(2) for a thread that is not the first one."""


def spokesman_of(pid: int) -> int:
    """The id by which we look at a process; its own as long as its first thread lives, and once all of it has ended.

    Raises:
        ProcessGoneError: it has ended, and its parent has taken note.
    """
    if not _ends(procfs.stat(pid)):
        return pid
    for tid in thread_ids(pid):
        with contextlib.suppress(ProcessGoneError):
            if tid != pid and not _ends(procfs.thread_stat(pid, tid)):
                return tid
    return pid


def told_by_spokesman(pid: int, question: Callable[[int], Answer]) -> Answer:
    """The answer of a process that is looked at by the id of its spokesman; asked again where that ends meanwhile.

    Raises:
        CheckpointError: the question raises it.
        ProbeError: one spokesman ends after the other.
    """
    for _ in range(SPOKESMEN_MAX):
        spokesman = spokesman_of(pid)
        try:
            answer = question(spokesman)
        except CheckpointError:
            if spokesman_of(pid) == spokesman:
                raise
        else:
            if spokesman_of(pid) == spokesman:
                return answer
    raise ProbeError(f"cannot examine pid {pid}: its threads end while failover examines it; try again")


def _ends(stat: procfs.Stat) -> bool:
    return stat.state in "ZX" or bool(stat.flags & procfs.PF_EXITING)


def pidfd_of(tid: int) -> int:
    """A pidfd of a process, by which its descriptors can be had; of a spokesman too.

    Raises:
        OSError: it has ended; or, of a spokesman, this kernel has none (Linux 6.9 has).
    """
    try:
        return os.pidfd_open(tid)
    except OSError as error:
        if error.errno not in _NOT_A_PROCESS:
            raise
    return os.pidfd_open(tid, PIDFD_THREAD)


def can_look_through(tid: int) -> bool:
    """Whether this kernel lends the descriptors of a process whose spokesman is not its first thread."""
    try:
        os.close(pidfd_of(tid))
    except OSError as error:
        return error.errno not in _NOT_A_PROCESS
    return True
