"""Check whether another program holds the same open file: then it is not the program's alone, and cannot move with it.

Other processes get an open file only by a fork, by a message of a unix socket or by inheriting it when they are created. So an
open file that was once the program's alone is not checked again under its number.

Source: kcmp(2).
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.linux import abi
from checkpoint.resources.open_file import OpenFile

CAPABILITIES: Final = (
    refused(
        Area.PIPES,
        "an event, timer, signal, epoll or inotify descriptor, memory file or socket that another process holds, too",
        "protect the program after the other process has ended",
        "holds too: protect the program when that has ended",
    ),
)

AGE_NS: Final = 1_000_000_000
"""How old a census may be: it costs some ten milliseconds."""
KIN_AGE_NS: Final = 5_000_000_000
"""The same while several processes stand still: `look_around` came before."""
PRIVATE_KNOWN: Final = 8192
"""Open files remembered as held by no other process."""


class _HeldElsewhereError(Exception):
    """Another process has it, too: this must be asked again next time."""

    def __init__(self, pid: int) -> None:
        super().__init__(pid)
        self.pid = pid


def holder_of(held: OpenFile) -> int | None:
    """Another process, not of the same component, that has the same open file; None where there is none that we may look at."""
    if held.kin.pids:
        return _holder_besides(held)
    try:
        _require_private(held.pid, held.first.number, held.first.target)
    except _HeldElsewhereError as error:
        return error.pid
    return None


def _holder_besides(held: OpenFile) -> int | None:
    for other, number in _others(held):
        if abi.kcmp(held.pid, other, abi.KCMP_FILE, held.first.number, number) == 0:
            return other
    return None


def _others(held: OpenFile, name: str = "") -> Iterator[tuple[int, int]]:
    """Processes that had something of the same name, or of another, open when we last looked, and still have."""
    name = name or held.first.target
    age_ns, asker = (KIN_AGE_NS, 0) if held.kin.pids else (AGE_NS, held.pid)
    for other, number in CENSUS.holders(name, age_ns, asker):
        if other != held.pid and other not in held.kin.pids and _target(other, number) == name:
            yield other, number


def _target(pid: int, number: int) -> str:
    try:
        return os.readlink(f"/proc/{pid}/fd/{number}")
    except OSError:
        return ""


def has_end(held: OpenFile) -> bool:
    """Whether a process of no component of ours holds an end of a pipe; one born within the last second may be missed."""
    return next(_others(held), None) is not None


def reader_of(held: OpenFile) -> int | None:
    """Another process that reads what is written to a pipe, or has the other end of a unix socket; as `opener_of`."""
    peer = held.observed.get("peer")
    name = f"socket:[{peer}]" if isinstance(peer, int) else ""
    for other, number in _others(held, name):
        with contextlib.suppress(OSError):  # closed meanwhile
            if name or os.lstat(f"/proc/{other}/fd/{number}").st_mode & stat.S_IRUSR:
                return other
    return None


def opener_of(held: OpenFile) -> int | None:
    """Another process that has a file of the same name open; an open of the last second may be missed."""
    return next((other for other, _ in _others(held)), None)


def opener_at(held: OpenFile, name: str, place: tuple[int, int]) -> int | None:
    """Another process that has a certain file open, by a name that others may have, too; as `opener_of`.

    Args:
        place: its device and inode number.
    """
    for other, number in _others(held, name):
        with contextlib.suppress(OSError):  # closed meanwhile
            about = os.stat(f"/proc/{other}/fd/{number}")
            if (about.st_dev, about.st_ino) == place:
                return other
    return None


def refuse(held: OpenFile, what: str) -> str | None:
    """Why something that is ``what`` cannot be kept: another process has it, too."""
    if (other := holder_of(held)) is None:
        return None
    return f"{held.name} is {what} that pid {other} holds too: protect the program when that has ended"


@lru_cache(maxsize=PRIVATE_KNOWN)
def _require_private(pid: int, number: int, target: str) -> None:
    for other, its_number in CENSUS.holders(target, asker=pid):
        if other != pid and abi.kcmp(pid, other, abi.KCMP_FILE, number, its_number) == 0:
            raise _HeldElsewhereError(other)


class _Census:
    """The open files of all processes but ours: (process, number) by the kernel's name for each."""

    def __init__(self) -> None:
        self._taken_ns = 0
        self._asker = 0
        self._found: dict[str, list[tuple[int, int]]] = {}

    def holders(self, target: str, age_ns: int = AGE_NS, asker: int = 0) -> list[tuple[int, int]]:
        """The processes that had it, as far back as is allowed.

        Args:
            asker: the process that the question is about: another one than last time takes a census of its own; 0: several.
        """
        now_ns = time.monotonic_ns()
        if not self._taken_ns or now_ns - self._taken_ns > age_ns or (asker and asker != self._asker):
            self._asker = asker
            self._found = {}
            for other in os.listdir("/proc"):
                if other.isdigit() and int(other) != os.getpid():
                    for number, name in _descriptors(other):
                        self._found.setdefault(name, []).append((int(other), number))
            self._taken_ns = now_ns
        return self._found.get(target, [])


CENSUS: Final = _Census()


def look_around() -> None:
    """Take the census now if it is old, so that no capture has to while a program stands still."""
    CENSUS.holders("")


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
