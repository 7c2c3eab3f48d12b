"""Find other processes that hold a file open for writing: a program is never restored onto a file that another one writes to.

The check asks the kernel first: it grants a read lease only on a file that no process may write to. That takes microseconds for
any number of processes. Only when the kernel refuses, or the file is not ours to lease or its file system has no leases, does the
check look through the descriptors of all processes, to find their names.

Source: F_SETLEASE in fcntl(2); fdinfo in proc_pid_fdinfo(5).
"""

from __future__ import annotations

import fcntl
import os
import signal
from collections.abc import Iterator, Mapping
from typing import Final

from checkpoint.errors import CheckpointError
from checkpoint.linux.procfs import procfs

DESCRIPTORS_MAX: Final = 100_000
"""Descriptors of other processes that are looked at: about half a second; beyond that a writer is not known by name."""


def may_be_written(path: str) -> bool:
    """Whether a process holds the file open or mapped for writing, or it cannot be told this way."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return True
    try:
        # A process that opens the file in these microseconds waits for us, and SIGIO would tell us: it kills, SIGURG does not.
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def writer_of(path: str, spared: frozenset[int]) -> int:
    """The PID of a process that holds the file open for writing; 0 when none is seen.

    Args:
        spared: PIDs that do not count.
    """
    try:
        about = os.stat(path)
    except OSError:
        return 0
    looked_at = 0
    for pid in _others(spared):
        for number in _numbers(pid):
            looked_at += 1
            if looked_at > DESCRIPTORS_MAX:
                return 0
            if _is_writing(pid, number, (about.st_dev, about.st_ino)):
                return pid
    return 0


def told(pid: int, owners: Mapping[int, str]) -> str:
    """The name of a process, for a sentence.

    Args:
        owners: which component a process belongs to, by pid.
    """
    try:
        name = procfs.status(pid).name
    except CheckpointError:
        name = "it has just ended"
    return f"pid {pid} ({name}){f', of component {owners[pid]}' if pid in owners else ''}"


def everybody() -> list[int]:
    """All processes."""
    return list(_others(frozenset()))


def arguments_of(pid: int) -> bytes:
    """The arguments of a process, each but the last ended by a zero byte; b"" where it has ended, or we may not look at it."""
    try:
        return procfs.read_bytes(pid, "cmdline").removesuffix(b"\0")
    except CheckpointError:
        return b""


def family(pid: int) -> frozenset[int]:
    """A process and its ancestors: the process that starts a restore may hold the files that it gives as streams."""
    found = set()
    while pid > 0 and pid not in found:
        found.add(pid)
        try:
            pid = procfs.status(pid).ppid
        except CheckpointError:
            break
    return frozenset(found)


def _others(spared: frozenset[int]) -> Iterator[int]:
    for name in os.listdir("/proc"):
        if name.isdigit() and int(name) not in spared:
            yield int(name)


def _numbers(pid: int) -> list[str]:
    try:
        return os.listdir(f"/proc/{pid}/fd")
    except OSError:
        return []  # it has ended, or is another user's


def _is_writing(pid: int, number: str, file: tuple[int, int]) -> bool:
    try:
        about = os.stat(f"/proc/{pid}/fd/{number}")
        if (about.st_dev, about.st_ino) != file:
            return False
        with open(f"/proc/{pid}/fdinfo/{number}") as lines:
            fields = procfs.parse_fields(lines.read())
    except OSError:
        return False
    return int(fields.get("flags", "0"), 8) & os.O_ACCMODE != os.O_RDONLY
