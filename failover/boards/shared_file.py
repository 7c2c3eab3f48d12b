"""A file that programs of one robot share by mapping it: opened, mapped, locked, its table changed.

Such a file is opened twice. The first opening is for the mapping (Python's mmap keeps a duplicate of its descriptor for as
long as it lives); the locks belong to the second one, which can be closed at any time, and so be given back.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Final, Self

from failover.boards import futex, locks
from failover.core.board.layout import GENERATION_AT, GONE, HOLE, TABLE_LOCK
from failover.errors import BoardError, BoardGoneError, FailoverError

REFUSED: Final = (errno.EACCES, errno.EPERM, errno.EROFS)
"""Why a file cannot be opened for writing, and perhaps for reading."""

GENERATION: Final = GENERATION_AT // 8
"""The word of every such file that is odd while its table changes."""


class SharedFile:
    """A file of this robot's shared memory, mapped. It stays mapped for as long as anything refers to it.

    `close` gives back locks and descriptor.

    Attributes:
        path: for messages.
        is_writable: this process may write it.
        area, view, words, halves: the mapping; its bytes, its words of eight bytes and of two.
        header: as it was when the file was mapped.
        descriptor: for locks; -1: closed, or the file may only be read.
    """

    WHAT: ClassVar[str] = "board"
    SIZE_MIN: ClassVar[int]
    SIZE_MAX: ClassVar[int]
    ERROR: ClassVar[type[FailoverError]] = BoardError
    GONE_ERROR: ClassVar[type[FailoverError]] = BoardGoneError

    def __init__(self, path: Path, area: mmap.mmap, is_writable: bool, descriptor: int, identity: tuple[int, int]) -> None:
        self._identity = identity
        self.path = path
        self.is_writable = is_writable
        self.descriptor = descriptor
        self._map(area)
        self.header = self.read_header()

    @property
    def identity(self) -> tuple[int, int]:
        """Device and inode of the file that is mapped."""
        return self._identity

    def _map(self, area: mmap.mmap) -> None:
        self.area = area
        self.view = memoryview(area)
        whole = self.view[: len(area) & ~7]
        self.words, self.halves = whole.cast("Q"), whole.cast("H")

    @classmethod
    def open(cls, path: Path, descriptor: int = -1, *, writable: bool | None = None) -> Self:
        """Map a file.

        Args:
            descriptor: an opening of it for its locks, which becomes the file's; -1: one is made.
            writable: None: if this user may write it.

        Raises:
            BoardError, ScheduleError: it is none, or cannot be opened.
            FileNotFoundError: there is none.
        """
        opened, is_writable = cls._first_opening(path, writable)
        try:
            file = cls(path, cls._mapped(path, opened, is_writable), is_writable, descriptor, _identity(opened))
            if is_writable and descriptor < 0:
                file.descriptor = cls._second_opening(path, opened)
            return file
        finally:
            os.close(opened)

    def close(self) -> None:
        """Give back the locks and the descriptor; what is mapped can still be read."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def _map_again(self) -> None:
        """Map the file as long as it is now: others have made it longer.

        Raises:
            BoardGoneError: another file has its name.
        """
        opened = os.open(self.path, (os.O_RDWR if self.is_writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            if _identity(opened) != self._identity:
                raise self.GONE_ERROR(f"{self.path}: it was made anew")
            self._map(self._mapped(self.path, opened, self.is_writable))
        finally:
            os.close(opened)

    @property
    def generation(self) -> int:
        """As it is now."""
        return self.words[GENERATION]

    @property
    def is_gone(self) -> bool:
        """The file was made anew or removed, or the mapping is a hole."""
        return self.generation in (GONE, HOLE)

    def read_header(self) -> Any:
        """What the file says of itself; each kind of file has its own."""
        raise NotImplementedError

    def address(self, offset: int) -> int:
        """Where a byte lies in this process; good while the mapping is."""
        return futex.address_of(self.area) + offset

    # --- Changes of the table ---

    @contextmanager
    def changing(self, patience_s: float = locks.TABLE_WAIT_S) -> Iterator[None]:
        """The generation is odd for the body, and the table lock is held; the caller keeps other threads out.

        Args:
            patience_s: for another process that holds the lock.
        """
        with locks.table(self.descriptor, f"cannot change {self.path}", self.ERROR, patience_s):
            generation = self.read_header().generation
            generation += generation % 2  # an odd one: the process that changed the table has died
            self._set_generation(generation + 1)
            try:
                yield
            finally:
                if not self.is_gone:
                    self._set_generation(generation + 2)

    def _set_generation(self, generation: int) -> None:
        self.words[GENERATION] = generation

    def mend(self) -> None:
        """Make the generation even if the process that was to do it has died."""
        if self.is_writable and self.generation % 2 and not self.is_gone and locks.take(self.descriptor, TABLE_LOCK):
            try:
                if self.generation % 2 and not self.is_gone:
                    self.words[GENERATION] += 1
            finally:
                locks.give(self.descriptor, TABLE_LOCK)

    # --- Openings ---

    @classmethod
    def _first_opening(cls, path: Path, writable: bool | None) -> tuple[int, bool]:
        """A descriptor, and whether it may write. The opening itself asks: access(2) of old kernels knows no lists of users."""
        for is_writable in (True, False) if writable is None else (writable,):
            flags = (os.O_RDWR if is_writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NOFOLLOW
            try:
                return os.open(path, flags), is_writable
            except FileNotFoundError:
                raise
            except OSError as error:
                if not is_writable or writable or error.errno not in REFUSED:
                    raise cls.ERROR(f"cannot open {path}: {error.strerror}") from error
        raise AssertionError

    @classmethod
    def _mapped(cls, path: Path, descriptor: int, writable: bool) -> mmap.mmap:
        size = os.fstat(descriptor).st_size
        if size < cls.SIZE_MIN:
            raise cls.ERROR(f"{path}: this is no {cls.WHAT}: it has {size} bytes")
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        try:
            return mmap.mmap(descriptor, min(size, cls.SIZE_MAX), mmap.MAP_SHARED, protection)
        except OSError as error:
            raise cls.ERROR(f"cannot map {path}: {error.strerror}") from error
        except ValueError as error:  # it was made shorter since it was asked how long it is
            raise cls.ERROR(f"cannot map {path}: {error}") from error

    @classmethod
    def _second_opening(cls, path: Path, first: int) -> int:
        """Another opening of the very file that is open already."""
        with contextlib.suppress(OSError):
            return os.open(f"/proc/self/fd/{first}", os.O_RDWR | os.O_CLOEXEC)
        again = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        if not os.path.sameopenfile(first, again):
            os.close(again)
            raise cls.GONE_ERROR(f"{path}: it was made anew while it was opened")
        return again


def _identity(descriptor: int) -> tuple[int, int]:
    opened = os.fstat(descriptor)
    return opened.st_dev, opened.st_ino
