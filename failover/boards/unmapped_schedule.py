"""The schedule as an agent's processes use it: by reading and writing the file, never by touching a mapping of it.

Who may write the file may make it shorter at any time; see `failover.boards.unmapped_file`. A futex has an address, so the file
is mapped for that alone: where a page was lost, the kernel refuses the call, and ends nobody.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, Self

from failover.boards.schedule_file import ScheduleFile
from failover.boards.shared_file import GENERATION
from failover.core.board.layout import GONE, WORD
from failover.core.schedule import layout
from failover.core.schedule.layout import FILE_SIZE, ROW_SIZE, Piece, View
from failover.core.schedule.orders import Rows
from failover.errors import ScheduleError

HEADER_SIZE: Final = layout.HEADER.size


class UnmappedSchedule(ScheduleFile):
    """The table as it was read last: `refresh` reads rows anew. What is not there any more reads as zeros."""

    @classmethod
    def at(cls, path: Path) -> Self:
        """Open a file to read and write it.

        Raises:
            ScheduleError: it is none, or cannot be opened.
            FileNotFoundError: there is none.
        """
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise ScheduleError(f"cannot open {path}: {error.strerror}") from error
        try:
            found = os.fstat(descriptor)
            return cls(path, cls._mapped(path, descriptor, True), True, descriptor, (found.st_dev, found.st_ino))
        except BaseException:
            os.close(descriptor)
            raise

    def _map(self, area: mmap.mmap) -> None:
        self.area = area  # for addresses alone
        self.view = memoryview(bytearray(FILE_SIZE))
        self.words, self.halves = self.view.cast("Q"), self.view.cast("H")
        self.table = View(self.view)

    @contextlib.contextmanager
    def _trouble(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # a full file system: a file that was made shorter, and longer again, has holes
            raise ScheduleError(f"cannot {what} {self.path}: {error.strerror}") from error

    def refresh(self, rows: Iterable[int]) -> None:
        """Read these rows anew.

        Raises:
            ScheduleError: the file cannot be read.
        """
        for row in rows:
            self._read(layout.row_at(row), ROW_SIZE)

    def _read(self, offset: int, size: int) -> None:
        place = self.view[offset : offset + size]
        with self._trouble("read"):
            there = os.preadv(self.descriptor, [place], offset)
        if there < size:
            place[there:] = bytes(size - there)

    def read_header(self) -> layout.Header:
        """See `ScheduleFile.read_header`."""
        self._read(0, HEADER_SIZE)
        return super().read_header()

    @property
    def generation(self) -> int:
        """As it is now."""
        with self._trouble("read"):
            word = os.pread(self.descriptor, WORD.size, GENERATION * WORD.size) if self.descriptor >= 0 else b""
        return int(WORD.unpack(word)[0]) if len(word) == WORD.size else GONE

    def _set_generation(self, generation: int) -> None:
        self.write([(GENERATION * WORD.size, WORD.pack(generation))])

    def rows(self) -> Rows:
        """See `ScheduleFile.rows`."""
        self._read(0, FILE_SIZE)
        return super().rows()

    def write(self, pieces: Iterable[Piece]) -> None:
        """Write pieces in their order, into the file and into what was read.

        Raises:
            ScheduleError: the file takes none, for example because its file system is full.
        """
        for offset, octets in pieces:
            with self._trouble("write"):
                there = os.pwrite(self.descriptor, octets, offset)
            if there < len(octets):
                raise ScheduleError(f"cannot write {self.path}: there is no room in its file system; free some")
            self.view[offset : offset + len(octets)] = octets
