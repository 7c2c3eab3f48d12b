"""Output of a component as two log files in one directory: on its primary and, rebuilt from snapshots, on each standby.

A byte's place in a log file is its place in the stream, counted from the component's first byte. No restart or takeover renumbers
it. Four numbers bound a stream: ``start <= committed <= size``, and ``safe <= committed``.

* Bytes before ``start`` were given back to the disk (a log keeps `KEEP_LIMIT` bytes). They read as zeros and are never served.
* Bytes before ``committed`` belong to a checkpoint: every robot that has them has the same ones, and no takeover takes them back.
* Bytes before ``safe`` belong to a checkpoint that another robot holds. A component whose output is held (``--output=committed``)
  shows only these: even a robot that was alone and is then lost for good takes back no output that a reader has seen.
* Bytes up to ``size`` were written by a program whose newest state is not acknowledged yet. A restore cuts them off.

The file ``offsets`` holds them (eight little-endian u64: start 1, committed 1, start 2, committed 2, safe 1, safe 2, held,
owner). The owner is the user id, plus one, of the user whose component wrote the output. Users use a name again: the output of
one user's component is never shown to the next user. None of the numbers needs to survive a power cut by itself: a restore gets
its totals from the snapshot, and output that is not known to be safe waits.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from msgspec import Struct

from agent.guard import output_times
from agent.guard.output_times import OutputTimes
from agent.system import syscalls
from checkpoint.model import OutputPiece

STREAMS: Final = (1, 2)
"""Standard output and standard error, by the descriptor that the program knows them as."""

LOG_NAMES: Final = {1: "stdout.log", 2: "stderr.log"}
OFFSETS_NAME: Final = "offsets"

KEEP_LIMIT: Final = 256 << 20
"""Bytes of one stream that stay readable; older ones are given back to the disk, so that a flood cannot fill it."""

TRIM_STEP: Final = 16 << 20
"""Bytes given back at a time: one system call a step, and a multiple of every filesystem's block."""

READ_LIMIT: Final = 1 << 20
"""Most bytes that one `OutputLogs.read` returns."""

CLOSED: Final = -1
"""In place of the descriptor of a log that was closed: its number may be another file's by then."""

START: Final = 0
COMMITTED: Final = 1
SAFE: Final = 4
"""Places in the file ``offsets``, for the first stream."""
HELD: Final = 6
OWNER: Final = 7
_OFFSET: Final = struct.Struct("<Q")
FAR_AWAY: Final = 1 << 40
"""An offset, a multiple of `TRIM_STEP`, to try out whether holes can be made."""


class Bounds(Struct, frozen=True):
    """Where one stream begins, how far it is committed, and where it ends; all in bytes from the component's first."""

    start: int
    committed: int
    size: int
    safe: int


class OutputLogs:
    """The two logs of one component on this robot, open for reading and writing.

    Any number of processes may have them open: the guard appends, the agent commits and reads. On a standby the agent writes.

    Raises (all methods): OSError, from the filesystem.
    """

    def __init__(self, directory: Path) -> None:
        """Open the logs, making the directory (0700) and the files (0600) if they are not there."""
        self.directory = directory
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._offsets = _open(directory / OFFSETS_NAME)
        self._logs = {stream: _open(directory / LOG_NAMES[stream]) for stream in STREAMS}
        self._times = OutputTimes(directory)
        self.trims = _can_trim(self._logs[1])
        """Whether old bytes can be given back here; otherwise the logs grow until the disk is full."""

    def close(self) -> None:
        """Close the files; their bytes stay. Closing twice is closing once; other calls fail with EBADF from then on."""
        opened = (self._offsets, *self._logs.values())
        self._offsets, self._logs = CLOSED, dict.fromkeys(self._logs, CLOSED)
        for descriptor in opened:
            if descriptor != CLOSED:
                os.close(descriptor)

    def mark(self) -> None:
        """Bytes are about to be written: note when."""
        self._times.mark(self.totals)

    def descriptor(self, stream: int) -> int:
        """The log's file descriptor; it stays this object's."""
        return self._logs[stream]

    def bounds(self, stream: int) -> Bounds:
        """Where the stream stands now."""
        size = os.fstat(self._logs[stream]).st_size
        start, committed, safe = (min(self._offset(stream, which), size) for which in (START, COMMITTED, SAFE))
        return Bounds(start, committed, size, min(safe, committed))

    def totals(self) -> tuple[int, int]:
        """Bytes in each log, committed or not."""
        return self.bounds(1).size, self.bounds(2).size

    @property
    def is_held(self) -> bool:
        """Whether nothing is shown before another robot holds it."""
        return bool(self._word(HELD))

    def hold(self, held: bool) -> None:
        """Note, on this robot, whether the component's record has its output held."""
        if held != self.is_held:
            self._set_word(HELD, int(held))

    @property
    def owner(self) -> int | None:
        """User id of whose component wrote it; None: an earlier version of the agent began these logs, and did not note it."""
        return self._word(OWNER) - 1 if self._word(OWNER) else None

    def belong(self, owner: int) -> None:
        """Note whose component writes it."""
        if owner != self.owner:
            self._set_word(OWNER, owner + 1)

    def waiting(self) -> int:
        """Bytes of both streams that wait for another robot to hold them."""
        return sum(bounds.size - bounds.safe for bounds in map(self.bounds, STREAMS))

    def read(self, stream: int, offset: int, size: int = READ_LIMIT, *, committed: bool = True) -> OutputPiece:
        """The stream's bytes from ``offset`` on, at most ``size``; fewer, or none, where the stream ends.

        The piece says where it begins: later than asked where the beginning is no longer kept. An offset below zero counts from
        the present end.

        Args:
            committed: only bytes that no takeover can take back, of held output only safe ones; otherwise all that was written.
        """
        while True:
            bounds = self.bounds(stream)
            shown = (bounds.safe if self.is_held else bounds.committed) if committed else bounds.size
            begin = max(offset if offset >= 0 else shown + offset, bounds.start)
            end = min(shown, begin + min(size, READ_LIMIT))
            content = os.pread(self._logs[stream], end - begin, begin) if end > begin else b""
            if self._offset(stream, START) <= begin:  # otherwise it was given back while we read, and we may have read zeros
                return OutputPiece(stream, begin, content)

    def write(self, stream: int, offset: int, content: bytes | memoryview) -> int:
        """Write at ``offset``; returns the bytes written, which may be fewer than given (write(2))."""
        return os.pwrite(self._logs[stream], content, offset)

    def apply(self, pieces: Iterable[OutputPiece], *, is_safe: bool = False) -> None:
        """Make the committed stream end as a snapshot says it does. Applying the same snapshot again changes nothing.

        Pieces come from the snapshots of one chain, in its order. Bytes beyond a piece's end were written by a history that did
        not survive; they go. Where the log ends before a piece begins, the stream's kept part starts with the piece.

        Args:
            is_safe: they come from another robot, so that two hold them.
        """
        for piece in pieces:
            if piece.content:
                self.mark()
            bounds = self.bounds(piece.stream)
            gap = piece.offset > bounds.size
            start = piece.offset if gap else min(bounds.start, piece.offset)
            end = piece.offset + len(piece.content)
            _write_whole(self._logs[piece.stream], piece.content, piece.offset)
            self._end_at(piece.stream, end, start)
            if is_safe:
                self._set_offset(piece.stream, SAFE, end)
            self.trim(piece.stream, end - KEEP_LIMIT)

    def commit(self, totals: tuple[int, int], *, is_safe: bool = False) -> None:
        """Say that a checkpoint holds the streams up to ``totals``. Never goes back: an older acknowledgement changes nothing.

        Args:
            is_safe: it is one that another robot holds.
        """
        for stream, total in zip(STREAMS, totals, strict=True):
            for which in (COMMITTED, SAFE) if is_safe else (COMMITTED,):
                if total > self._offset(stream, which):
                    self._set_offset(stream, which, total)

    def truncate(self, totals: tuple[int, int]) -> None:
        """Make the streams end at ``totals``, all of it committed: a program restored from there has written so much."""
        for stream, total in zip(STREAMS, totals, strict=True):
            bounds = self.bounds(stream)
            self._end_at(stream, total, total if total > bounds.size else bounds.start)

    def trim(self, stream: int, start: int) -> bool:
        """Give the bytes before ``start`` back to the disk, in whole steps; returns whether any were."""
        old = self._offset(stream, START)
        new = start - start % TRIM_STEP
        if not self.trims or new <= old:
            return False
        self._set_offset(stream, START, new)  # first: no reader may get the zeros
        begin = old - old % TRIM_STEP
        syscalls.punch_hole(self._logs[stream], begin, new - begin)
        return True

    def _end_at(self, stream: int, total: int, start: int) -> None:
        """The stream ends at ``total``, committed, and its kept part begins at ``start``, or where it ends."""
        os.ftruncate(self._logs[stream], total)
        self._set_offset(stream, START, min(start, total))
        self._set_offset(stream, COMMITTED, total)
        self._set_offset(stream, SAFE, min(self._offset(stream, SAFE), total))

    def _offset(self, stream: int, which: int) -> int:
        return self._word(_place(stream, which))

    def _set_offset(self, stream: int, which: int, value: int) -> None:
        self._set_word(_place(stream, which), value)

    def _word(self, place: int) -> int:
        content = os.pread(self._offsets, _OFFSET.size, place * _OFFSET.size)
        return int(_OFFSET.unpack(content)[0]) if len(content) == _OFFSET.size else 0

    def _set_word(self, place: int, value: int) -> None:
        os.pwrite(self._offsets, _OFFSET.pack(value), place * _OFFSET.size)


def discard(directory: Path) -> None:
    """Begin anew: the next `OutputLogs` of this directory opens empty files; a process that has the old ones open keeps them.

    Raises:
        OSError: the directory cannot be written.
    """
    for name in (OFFSETS_NAME, output_times.NAME, *LOG_NAMES.values()):
        (directory / name).unlink(missing_ok=True)


def logs_of(directory: Path, owner: int) -> OutputLogs:
    """The logs of a component of this owner's; another owner's, of the same name, are given up first.

    Raises:
        OSError: the directory cannot be written.
    """
    logs = OutputLogs(directory)
    if logs.owner not in (None, owner):
        logs.close()
        discard(directory)
        logs = OutputLogs(directory)
    logs.belong(owner)
    return logs


def total_of(pieces: Iterable[OutputPiece]) -> tuple[int, int]:
    """Where the streams end after ``pieces``: the totals that a restore from their snapshot continues at."""
    totals = {1: 0, 2: 0}
    for piece in pieces:
        totals[piece.stream] = max(totals[piece.stream], piece.offset + len(piece.content))
    return totals[1], totals[2]


def _place(stream: int, which: int) -> int:
    """Of a stream's number among the words of the file ``offsets``."""
    return which + (stream - 1) * (1 if which == SAFE else 2)


def _open(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)


def _can_trim(descriptor: int) -> bool:
    """Ask for a hole where no file ends."""
    try:
        syscalls.punch_hole(descriptor, FAR_AWAY, TRIM_STEP)
    except OSError as error:
        if error.errno in (errno.EOPNOTSUPP, errno.ENOSYS):
            return False
        raise
    return True


def _write_whole(descriptor: int, content: bytes, offset: int) -> None:
    """Write all of it, however many calls it takes."""
    rest = memoryview(content)
    while rest:
        written = os.pwrite(descriptor, rest, offset)
        rest, offset = rest[written:], offset + written
