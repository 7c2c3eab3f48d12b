"""File locks: flock(2), and the two kinds of fcntl(2), taken again through the same open file when everything else is open.

A lock that somebody else has taken meanwhile stops the restore: the program would believe that it has it.

Fact, added to a file's own: ``locks``: a list of [kind, 1 if exclusive, first byte, number of bytes (0: to the end)].

Source: show_fd_locks() in fs/locks.c; proc_locks(5).
"""

from __future__ import annotations

import fcntl
import re
import struct
from collections.abc import Iterator
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import OpenFile
from checkpoint.resources.rebuilding import number_of

CAPABILITIES: Final = (
    preserved(Area.FILES, "file locks (flock, fcntl, open file description locks)", "taken again before the program runs"),
    refused(Area.FILES, "leases of files", "protect the program while it holds none", "with a lock of the kind"),
)

F_OFD_SETLK: Final = 37
KINDS: Final = ("FLOCK", "POSIX", "OFDLCK")

_LOCK: Final = re.compile(r"^lock:\s*\d+: (\w+)\s+(\w+)\s+(\w+)\s+-?\d+ \S+ (\d+) (\d+|EOF)$", re.MULTILINE)
_FLOCK: Final = struct.Struct("<hh4xqqi4x")
"""struct flock of fcntl(2)."""


def describe(held: OpenFile) -> dict[str, Fact]:
    """The fact of one open file; none where it has no lock."""
    locks: list[Fact] = [
        [kind, int(mode == "WRITE"), int(first), 0 if last == "EOF" else int(last) - int(first) + 1]
        for kind, _, mode, first, last in _locks(held)
    ]
    return {"locks": locks} if locks else {}


def refuse(held: OpenFile) -> str | None:
    """Why a lock cannot be kept."""
    for kind, advice, *_ in _locks(held):
        if kind not in KINDS or advice != "ADVISORY":
            return (
                f"{held.name} is {held.first.target} with a lock of the kind {kind} (a lease, for one), which is not kept: "
                "protect the program while it holds none"
            )
    return None


def _locks(held: OpenFile) -> Iterator[tuple[str, str, str, str, str]]:
    if b"\nlock:" in held.first.told:
        yield from _LOCK.findall(held.first.text)


def settle(table: CallTable, held: Resource, descriptor: int) -> None:
    """Take its locks again. Later nothing of that file may be closed: that gives the locks of one kind back."""
    locks = held.facts.get("locks", [])
    assert isinstance(locks, list)
    for one in locks:
        assert isinstance(one, list)
        kind, exclusive, first, size = one[0], bool(one[1]), number_of(one[2]), number_of(one[3])
        what = f"take the lock of {held.name} on {held.facts['path']!s}"
        if kind == "FLOCK":
            table.call(what, "flock", descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
            continue
        packed = _FLOCK.pack(fcntl.F_WRLCK if exclusive else fcntl.F_RDLCK, 0, first, size, 0)
        command = fcntl.F_SETLK if kind == "POSIX" else F_OFD_SETLK
        table.call(what, "fcntl", descriptor, command, table.place(packed))
