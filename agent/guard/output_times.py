"""When a component wrote its output: marks in the file ``times`` beside its logs, for ``failover logs --since`` and ``--times``.

A mark is three little-endian words: the calendar in nanoseconds since 1970 (i64), and how many bytes each log had (u64, u64). It
is made before bytes are written, if the last one is older than `STEP_NS`. So bytes belong to the last mark that has no more
bytes before it, and were written at most `STEP_NS` after that. At a standby it is the instant at which the bytes came.

The file holds at most `SIZE_MAX` bytes: then every second mark goes, the newest hundred excepted, and old times become coarser.
A mark that cannot be written is left out: output matters more than its time.
"""

from __future__ import annotations

import contextlib
import os
import struct
from bisect import bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from agent.system import clock
from checkpoint.store.whole_file import write_whole

NAME: Final = "times"
STEP_NS: Final = 100_000_000
SIZE_MAX: Final = 256 << 10
"""Bytes: eighteen minutes of a program that writes all the time before the first of its times become coarser."""

NEWEST_KEPT: Final = 100

_MARK: Final = struct.Struct("<qQQ")


class OutputTimes:
    """The marks of one component, for a process that writes its logs."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / NAME
        self._marked_ns = 0

    def mark(self, sizes: Callable[[], tuple[int, int]]) -> None:
        """The logs have these sizes, and grow now; they are asked for where that is to be noted."""
        now_ns = clock.wall_ns(clock.now_ns())
        if 0 <= now_ns - self._marked_ns < STEP_NS:
            return
        self._marked_ns = now_ns
        with contextlib.suppress(OSError):
            if _appended(self._path, _MARK.pack(now_ns, *sizes())) > SIZE_MAX:
                self._thin()

    def _thin(self) -> None:
        marks = _read(self._path)
        kept = [*marks[:-NEWEST_KEPT:2], *marks[-NEWEST_KEPT:]]
        write_whole(self._path, b"".join(_MARK.pack(*mark) for mark in kept), lasts="process")


def _appended(path: Path, mark: bytes) -> int:
    """Add a mark; the size of the file then. One that a full disk or a power cut left unfinished goes."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        size = os.fstat(descriptor).st_size
        if size % _MARK.size:
            os.ftruncate(descriptor, size - size % _MARK.size)
        return size + os.write(descriptor, mark)
    finally:
        os.close(descriptor)


class Times:
    """The marks as a reader finds them; without any where none are kept."""

    def __init__(self, directory: Path) -> None:
        """Raises OSError: they are there, and cannot be read."""
        self._marks = _read(directory / NAME)

    def since(self, wall_ns: int) -> tuple[int, int] | None:
        """Offsets from which on the streams were written at or after an instant; None: nothing was. All where no mark tells."""
        if not self._marks:
            return 0, 0
        later = [mark for mark in self._marks if mark[0] + STEP_NS >= wall_ns]
        return (min(mark[1] for mark in later), min(mark[2] for mark in later)) if later else None

    def of(self, stream: int, begin: int, end: int) -> list[tuple[int, int]]:
        """The instants of a stream's bytes from ``begin`` to ``end``: (offset from which on, wall_ns), the first at ``begin``."""
        ways = _in_order(self._marks, stream)
        first = max(bisect_right(ways, begin, key=lambda way: way[0]) - 1, 0)
        return [(max(offset, begin), wall_ns) for offset, wall_ns in ways[first:] if offset < end]


def _in_order(marks: Sequence[tuple[int, int, int]], stream: int) -> list[tuple[int, int]]:
    """(offset, wall_ns) with growing offsets: what a takeover took back was written again, at a later mark."""
    found: list[tuple[int, int]] = []
    for mark in marks:
        while found and found[-1][0] >= mark[stream]:
            found.pop()
        found.append((mark[stream], mark[0]))
    return found


def _read(path: Path) -> list[tuple[int, int, int]]:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    return list(_MARK.iter_unpack(content[: len(content) // _MARK.size * _MARK.size]))
