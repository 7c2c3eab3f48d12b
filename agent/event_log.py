"""Event log of this robot's decisions on disk, for ``failover why``: an append-only file of lines, in two halves.

A line is eight hexadecimal digits of CRC-32, a space, JSON (`failover.core.event_log.decisions.Line`), a newline. The reader
skips a line whose sum does not fit: a last line that a power cut left unfinished, or any other. A full newer half replaces the
older one, so the two together stay below twice `HALF_SIZE_MAX`.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_all
from failover.core.event_log.decisions import Line

DIRECTORY: Final = "story"
NEWER: Final = "newer.log"
OLDER: Final = "older.log"

HALF_SIZE_MAX: Final = 2 << 20
"""Bytes: some thousand decisions of a small team, a few hundred where sixty-three peers are noted with each."""

SUM_SIZE: Final = 9
"""Bytes of a line before its JSON."""

_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(Line)


class Kept(Struct, frozen=True):
    """The event log as found on the disk: lines, oldest first, and how many could not be read."""

    lines: tuple[Line, ...]
    damaged: int = 0


def packed(line: Line) -> bytes:
    """A line's bytes."""
    body = _encoder.encode(line)
    return b"%08x %b\n" % (zlib.crc32(body), body)


def unpacked(content: bytes) -> Line | None:
    """The line inside, None if it is damaged."""
    body = content[SUM_SIZE:]
    try:
        if int(content[: SUM_SIZE - 1], 16) != zlib.crc32(body):
            return None
        return _decoder.decode(body)
    except UNDECODABLE:
        return None


def read(state_directory: Path) -> Kept:
    """Everything that is kept; a file that is not there holds nothing.

    Raises:
        OSError: one is there and cannot be read.
    """
    lines, damaged = [], 0
    for content in _contents(state_directory / DIRECTORY):
        line = unpacked(content)
        if line is None:
            damaged += 1
        else:
            lines.append(line)
    return Kept(tuple(lines), damaged)


def _contents(directory: Path) -> Iterator[bytes]:
    for name in (OLDER, NEWER):
        try:
            content = (directory / name).read_bytes()
        except FileNotFoundError:
            continue
        yield from (line for line in content.split(b"\n") if line)


class EventLogFile:
    """The two halves, open for appending. One thread at a time.

    Raises (all methods): OSError, from the file system; lines written before stay readable.
    """

    def __init__(self, state_directory: Path) -> None:
        self._directory = state_directory / DIRECTORY
        self._descriptor = -1
        self._is_torn = False

    def append(self, lines: Iterable[Line]) -> None:
        """Add lines; returns when a power cut would leave them."""
        self._open()
        content = b"".join(packed(line) for line in lines)
        if self._is_torn:
            content = b"\n" + content
        self._is_torn = True  # until all of it is there
        write_all(self._descriptor, content)
        os.fdatasync(self._descriptor)
        self._is_torn = False
        if os.fstat(self._descriptor).st_size >= HALF_SIZE_MAX:
            self._turn_over()

    def close(self) -> None:
        """Let the file go."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def _open(self) -> None:
        if self._descriptor >= 0:
            return
        self._directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        self._descriptor = os.open(self._directory / NEWER, flags, 0o600)
        size = os.fstat(self._descriptor).st_size
        self._is_torn = size > 0 and os.pread(self._descriptor, 1, size - 1) != b"\n"

    def _turn_over(self) -> None:
        self.close()
        (self._directory / NEWER).replace(self._directory / OLDER)
