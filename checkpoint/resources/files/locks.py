"""Restore file locks: flock(2), the two kinds of fcntl(2), and leases, taken again when everything else is open.

If another process has taken a lock meanwhile, the restore stops: otherwise the program would believe that it has the lock.

A lease that is being broken at the capture is broken again, without the signal, which the program has had: the program gets
another term to give it up.

Fact, added to a file's own: ``locks``: a list of [kind, 1 if exclusive, first byte, number of bytes (0: to the end)]; for a lease
["LEASE", its type, the type that it is to become, 0], in the numbers of fcntl(2), twice the same where it is not being broken.

Source: show_fd_locks() in fs/locks.c; proc_locks(5); F_SETLEASE in fcntl(2).
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import struct
from collections.abc import Collection, Iterator
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.events import fd_signals
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of

CAPABILITIES: Final = (
    preserved(
        Area.FILES, "file locks (flock, fcntl, open file description locks) and leases", "taken again before the program runs"
    ),
    refused(
        Area.FILES,
        "mandatory locks, delegations, a lease of a deleted file",
        "protect the program while it holds none",
        "with a lock of the kind",
    ),
)

F_OFD_SETLK: Final = 37
F_SETLEASE: Final = 1024
KINDS: Final = ("FLOCK", "POSIX", "OFDLCK")
LEASE: Final = "LEASE"
OF_PROCESSES: Final = ("POSIX",)
"""Those that a process has for itself; the others belong to an open file, for all processes that share it."""
_TYPES: Final = {"READ": fcntl.F_RDLCK, "WRITE": fcntl.F_WRLCK, "UNLCK": fcntl.F_UNLCK}

_LOCK: Final = re.compile(r"^lock:\s*\d+: (\w+)\s+(\w+)\s+(\w+)\s+-?\d+ \S+ (\d+) (\d+|EOF)$", re.MULTILINE)
_FLOCK: Final = struct.Struct("<hh4xqqi4x")
"""struct flock of fcntl(2)."""


def describe(held: OpenFile, kinds: Collection[str] = (*KINDS, LEASE)) -> dict[str, Fact]:
    """The fact of one open file; none where it has no lock."""
    locks: list[Fact] = [
        [kind, int(mode == "WRITE"), int(first), 0 if last == "EOF" else int(last) - int(first) + 1]
        for kind, _, mode, first, last in _locks(held)
        if kind in kinds and kind != LEASE
    ]
    if LEASE in kinds:
        locks += ([LEASE, *_lease(held, advice, mode), 0] for kind, advice, mode, *_ in _locks(held) if kind == LEASE)
    return {"locks": locks} if locks else {}


def _lease(held: OpenFile, state: str, mode: str) -> tuple[int, int]:
    """The kind of a lease now, and the one that it is to become. The kernel tells the latter; only a file that is open for
    reading has a shared one."""
    target = _TYPES[mode]
    if state != "BREAKING":
        return target, target
    is_shared = target == fcntl.F_UNLCK and held.first.flags & os.O_ACCMODE == os.O_RDONLY
    return fcntl.F_RDLCK if is_shared else fcntl.F_WRLCK, target


def has_lease(held: OpenFile) -> bool:
    """Whether another process that opens the file may have to wait for the program. A signal tells the program so."""
    return LEASE.encode() in held.first.told


def refuse(held: OpenFile) -> str | None:
    """Why a lock cannot be kept."""
    for kind, state, *_ in _locks(held):
        is_kept = kind in KINDS and state == "ADVISORY"
        is_kept_lease = kind == LEASE and state in ("ACTIVE", "BREAKING") and not held.first.target.endswith(procfs.DELETED)
        if not (is_kept or is_kept_lease):
            return (
                f"{held.name} is {held.first.target} with a lock of the kind {kind} ({state.lower()}), which is not kept: "
                "protect the program while it holds none"
            )
    return None


def _locks(held: OpenFile) -> Iterator[tuple[str, str, str, str, str]]:
    if b"\nlock:" in held.first.told:
        yield from _LOCK.findall(held.first.text)


def settle(table: CallTable, held: Resource, descriptor: int, inner_pid: int) -> None:
    """Take its locks again. Later nothing of that file may be closed: that gives the locks of one kind back."""
    locks = held.facts.get("locks", [])
    assert isinstance(locks, list)
    for one in locks:
        assert isinstance(one, list)
        kind, exclusive, first, size = one[0], bool(one[1]), number_of(one[2]), number_of(one[3])
        what = f"take the lock of {held.name} on {held.facts['path']!s}"
        if kind == LEASE:
            _lease_again(table, held, descriptor, inner_pid, (number_of(one[1]), number_of(one[2])))
            continue
        if kind == "FLOCK":
            table.call(what, "flock", descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
            continue
        packed = _FLOCK.pack(fcntl.F_WRLCK if exclusive else fcntl.F_RDLCK, 0, first, size, 0)
        command = fcntl.F_SETLK if kind == "POSIX" else F_OFD_SETLK
        table.call(what, "fcntl", descriptor, command, table.place(packed))


def _lease_again(table: CallTable, held: Resource, descriptor: int, inner_pid: int, wanted: tuple[int, int]) -> None:
    """Take a lease, and break it if that was under way: its signals have no owner just then, so none is sent."""
    lease, target = wanted
    what = f"take the lease of {held.name} on {held.facts['path']!s}"
    table.call(what, "fcntl", descriptor, F_SETLEASE, lease)
    if lease == target:
        return
    fd_signals.disown(table, descriptor)
    breaking = (os.O_WRONLY if target == fcntl.F_UNLCK else os.O_RDONLY) | os.O_NONBLOCK | os.O_CLOEXEC
    path, refused_now = table.place_path(f"/proc/self/fd/{descriptor}"), -errno.EAGAIN
    table.call(f"break {what[5:]}", "openat", AT_FDCWD, path, breaking, 0, least=refused_now, most=refused_now)
    fd_signals.rebuild(table, descriptor, held, inner_pid)
