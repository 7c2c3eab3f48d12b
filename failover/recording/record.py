"""A board recorded into MCAP files, one behind the other."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from msgspec import Struct

from failover.boards.board import Board
from failover.recording.follower import Follower
from failover.recording.mcap_file import NewFile
from failover.recording.stream import Decisions, Stream

SIZE_MAX: Final = 256_000_000
"""Bytes of a file if nothing else is wanted."""


class Plan(Struct, frozen=True):
    """How to record.

    Attributes:
        rate: looks a second.
        span_s: for how long; None: until it is ended.
        size_max: bytes from which a file is closed and another one begun, as it is when its index is full.
        keep: files that are kept, the newest; 0: all.
        library: who writes, for people.
    """

    path: Path
    rate: float
    span_s: float | None = None
    size_max: int = SIZE_MAX
    keep: int = 0
    library: str = "failover"


class Recorder:
    """One recording.

    Attributes:
        stream: its ``is_ended`` ends the recording.
        files: written so far and kept.
        took_s: how long it has recorded.
    """

    def __init__(self, board: Board, follower: Follower, plan: Plan, decisions: Decisions | None = None) -> None:
        """Raises: RecordingError: the file cannot be made."""
        self._plan = plan
        self._number = 1
        self._file = NewFile(plan.path, plan.library)
        self.stream = Stream(board, follower, self._file, decisions)
        self.files = [plan.path]
        self.took_s = 0.0

    def run(self) -> None:
        """Record until the end.

        Raises:
            RecordingError: a file cannot be written; what was recorded before is kept.
        """
        begin_s = time.monotonic()
        try:
            self.stream.run(self._plan.rate, self._plan.span_s, self._each_second)
        finally:
            self._file.close()
            self.took_s = time.monotonic() - begin_s

    def _each_second(self) -> None:
        """Bring all into the file; begin another one if it is full."""
        self._file.flush()
        if self._file.size >= self._plan.size_max or self._file.is_full:
            self._rotate()

    def _rotate(self) -> None:
        """Begin another file with the newest value of each item: each file can be read without the others."""
        self._file.close()
        path = first = self._plan.path
        while path == first or path.exists():
            self._number += 1
            path = first.with_name(f"{first.stem}-{self._number}{first.suffix}")
        self._file = NewFile(path, self._plan.library)
        self.files.append(path)
        self.stream.begin_anew(self._file)
        while 0 < self._plan.keep < len(self.files):
            self.files.pop(0).unlink(missing_ok=True)
