"""Whether another process has the same open file, too: then it is not the program's alone, and cannot move with it.

Others get hold of one only by a fork, by a message of a unix socket or by being born with it, so an open file that nobody
else had once is not looked for again under its number.

Source: kcmp(2).
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.linux import abi
from checkpoint.resources import OpenFile

CAPABILITIES: Final = (
    refused(
        Area.PIPES,
        "an event, timer, signal, epoll or inotify descriptor, memory file or socket that another process holds too",
        "protect the program when that has ended",
        "holds too: protect the program when that has ended",
    ),
)

PRIVATE_KNOWN: Final = 8192
"""Open files remembered as held by nobody else."""


class _HeldElsewhereError(Exception):
    """Another process has it, too: what must be asked again next time."""

    def __init__(self, pid: int) -> None:
        super().__init__(pid)
        self.pid = pid


def holder_of(held: OpenFile) -> int | None:
    """Another process that has the same open file; None where there is none, or none that we may look at."""
    try:
        _require_private(held.pid, held.first.number, held.first.target)
    except _HeldElsewhereError as error:
        return error.pid
    return None


def opener_of(held: OpenFile) -> int | None:
    """Another process that has a file of the same name open; what was opened in the last second may be missed."""
    return next((other for other, _ in _holders(held.pid, _second()).get(held.first.target, ())), None)


def opener_at(held: OpenFile, name: str, place: tuple[int, int]) -> int | None:
    """Another process that has a certain file open, by a name that others may have, too; as `opener_of`.

    Args:
        place: its device and inode number.
    """
    for other, number in _holders(held.pid, _second()).get(name, ()):
        with contextlib.suppress(OSError):  # closed meanwhile
            about = os.stat(f"/proc/{other}/fd/{number}")
            if (about.st_dev, about.st_ino) == place:
                return other
    return None


def refuse(held: OpenFile, what: str) -> str | None:
    """Why something that is ``what`` cannot be kept: somebody else has it, too."""
    if (other := holder_of(held)) is None:
        return None
    return f"{held.name} is {what} that pid {other} holds too: protect the program when that has ended"


@lru_cache(maxsize=PRIVATE_KNOWN)
def _require_private(pid: int, number: int, target: str) -> None:
    for other, its_number in _holders(pid, _second()).get(target, ()):
        if abi.kcmp(pid, other, abi.KCMP_FILE, number, its_number) == 0:
            raise _HeldElsewhereError(other)


def _second() -> int:
    return time.monotonic_ns() // 1_000_000_000


@lru_cache(maxsize=1)
def _holders(pid: int, second: int) -> Mapping[str, list[tuple[int, int]]]:
    """What all other processes have open: (process, number) by the kernel's name for it.

    Args:
        second: of our clock; all that is asked within one second looks once.
    """
    found: dict[str, list[tuple[int, int]]] = {}
    for other in os.listdir("/proc"):
        if other.isdigit() and int(other) not in (pid, os.getpid()):
            for number, target in _descriptors(other):
                found.setdefault(target, []).append((int(other), number))
    return found


def _descriptors(pid: str) -> Iterator[tuple[int, str]]:
    try:
        with os.scandir(f"/proc/{pid}/fd") as entries:
            for entry in entries:
                try:
                    yield int(entry.name), os.readlink(entry.path)
                except OSError:  # closed meanwhile
                    continue
    except OSError:  # ended meanwhile, or another user's
        return
