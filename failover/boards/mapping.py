"""One mapped file of a board: its records, its items' places, changes of its table, its users' and writers' locks.

A file is opened twice. The first opening is for the mapping (Python's mmap keeps a duplicate of its descriptor for as long as it
lives); the locks belong to the second one, which can be closed at any time, and so be given back.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from failover.boards import futex, locks
from failover.core.board import layout
from failover.core.board.banks import Place, place_of
from failover.core.board.items import BLOCK_SIZE_MAX
from failover.core.board.layout import GENERATION_AT, GONE, HOLE, USER_LOCKS, USERS_MAX, WRITER_LOCKS, Header, Record, Wanted
from failover.errors import BoardError, BoardGoneError

GENERATION: Final = GENERATION_AT // 8
_U32: Final = struct.Struct("<I")


class MappedFile:
    """A file of a board, mapped. It stays mapped for as long as anything refers to it; `close` gives back locks and descriptor.

    Attributes:
        path: for messages.
        is_writable: this process may put items here, and change the table.
        area, words, halves: the mapping as bytes, as words of eight bytes and of two.
        header: as it was when the file was mapped.
        descriptor: for locks; -1: closed, or the file may only be read.
    """

    def __init__(self, path: Path, area: mmap.mmap, is_writable: bool, descriptor: int, identity: tuple[int, int]) -> None:
        self._identity = identity
        self.path = path
        self.is_writable = is_writable
        self.descriptor = descriptor
        self._map(area)
        self.header = self.read_header()

    def _map(self, area: mmap.mmap) -> None:
        self.area = area
        self.view = memoryview(area)
        whole = self.view[: len(area) & ~7]
        self.words, self.halves = whole.cast("Q"), whole.cast("H")

    @classmethod
    def open(cls, path: Path, descriptor: int = -1, *, writable: bool | None = None) -> MappedFile:
        """Map a file.

        Args:
            descriptor: an opening of it for its locks, which becomes the file's; -1: one is made.
            writable: None: if this user may write it.

        Raises:
            BoardError: it is no board, or cannot be opened.
            FileNotFoundError: there is none.
        """
        if writable is None:
            writable = os.access(path, os.W_OK, effective_ids=True)
        flags = (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            opened = os.open(path, flags)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise BoardError(f"cannot open {path}: {error.strerror}") from error
        try:
            file = cls(path, _mapped(path, opened, writable), writable, descriptor, _identity(opened))
            if writable and descriptor < 0:
                file.descriptor = _second_opening(path, opened)
            return file
        finally:
            os.close(opened)

    def close(self) -> None:
        """Give back the locks and the descriptor; what is mapped can still be read."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    # --- What the file says ---

    @property
    def generation(self) -> int:
        """As it is now."""
        return self.words[GENERATION]

    @property
    def is_gone(self) -> bool:
        """The board was made anew or removed, or the mapping is a hole."""
        return self.generation in (GONE, HOLE)

    def read_header(self) -> Header:
        """As it is now.

        Raises:
            BoardGoneError, BoardError: see `layout.read_header`; names the file.
        """
        try:
            return layout.read_header(self.view)
        except BoardGoneError as error:
            raise BoardGoneError(f"{self.path}: {error}") from None
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None

    def records(self) -> list[Record]:
        """All items, as the file says now."""
        header = self._reach()
        try:
            return list(layout.read_records(self.view, header))
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None

    def _reach(self) -> Header:
        """The header; the mapping then reaches as far as the file, if others have added items since.

        What has a place in the old mapping keeps it: both are the same memory.
        """
        header = self.read_header()
        if header.file_size > len(self.area):
            opened = os.open(self.path, (os.O_RDWR if self.is_writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                if _identity(opened) != self._identity:
                    raise BoardGoneError(f"{self.path}: it was made anew")
                self._map(_mapped(self.path, opened, self.is_writable))
            finally:
                os.close(opened)
        return self.read_header()

    def record(self, name: str) -> Record | None:
        """An item by its name; None where there is none."""
        return next((record for record in self.records() if record.name == name), None)

    def holds(self, record: Record) -> bool:
        """Whether a record is still the item that it was."""
        header = self._reach()
        return record.index < header.count and layout.read_record(self.view, header, record.index) == record

    def place(self, record: Record) -> Place:
        """Where an item's banks and words lie."""
        return place_of(record, self.words, self.area, self.halves)

    def word32(self, offset: int) -> int:
        """Four bytes as a number."""
        return int(_U32.unpack_from(self.area, offset)[0])

    def set_word32(self, offset: int, word: int) -> None:
        """Four bytes."""
        _U32.pack_into(self.area, offset, word)

    def set_word16(self, offset: int, word: int) -> None:
        """Two bytes."""
        self.halves[offset // 2] = word

    def address(self, offset: int) -> int:
        """Where a byte lies in this process; good while the mapping is."""
        return futex.address_of(self.area) + offset

    # --- Changes of the table ---

    @contextmanager
    def changing(self) -> Iterator[None]:
        """The generation is odd for the body, and the table lock is held; the caller keeps other threads out."""
        with locks.table(self.descriptor, f"cannot change the items of {self.path}"):
            generation = self.read_header().generation
            generation += generation % 2  # an odd one: whoever changed the table has died
            self.words[GENERATION] = generation + 1
            try:
                yield
            finally:
                if not self.is_gone:
                    self.words[GENERATION] = generation + 2

    def mend(self) -> None:
        """Make the generation even if the process that was to do it has died."""
        if self.is_writable and self.generation % 2 and not self.is_gone and locks.take(self.descriptor, layout.TABLE_LOCK):
            try:
                if self.generation % 2 and not self.is_gone:
                    self.words[GENERATION] += 1
            finally:
                locks.give(self.descriptor, layout.TABLE_LOCK)

    def add(self, wanted: Wanted) -> None:
        """Append an item, inside of `changing`.

        Raises:
            BoardError: there is no room.
        """
        try:
            addition = layout.addition(self.read_header(), wanted)
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None
        os.ftruncate(self.descriptor, addition.size)
        for offset, piece in addition.pieces:
            os.pwrite(self.descriptor, piece, offset)

    def remove(self, record: Record) -> None:
        """Make a hole of an item, inside of `changing`."""
        offset, piece = layout.removal(record.index)
        self.area[offset : offset + len(piece)] = piece

    def next_id(self) -> int:
        """Number of an item that is added at run time."""
        return layout.next_id(self.view, self._reach())

    # --- Users and writers ---

    def enter(self, pid: int, uid: int, name: str) -> int:
        """Become a user: the index of the first free byte.

        Raises:
            BoardError: there are `USERS_MAX` others.
        """
        for index in range(USERS_MAX):
            if locks.take(self.descriptor, USER_LOCKS + index):
                row = layout.packed_user(pid, uid, name)
                at = layout.USERS_AT + index * len(row)
                self.area[at : at + len(row)] = row
                return index
        raise BoardError(f"cannot use {self.path}: {USERS_MAX} programs use it already; end some of them")

    def users(self, own: int | None = None) -> list[tuple[int, int, str]]:
        """Pid, uid and name of each user; ``own``: this opening's index, of which the kernel does not tell."""
        taken = (i for i in range(USERS_MAX) if i == own or locks.is_taken(self.descriptor, USER_LOCKS + i))
        return [layout.read_user(self.view, index) for index in taken]

    def take_writer(self, record: Record, pid: int) -> bool:
        """Become the writer of an item; False if another process is."""
        if not locks.take(self.descriptor, WRITER_LOCKS + record.index):
            return False
        self.set_word32(record.at + layout.PID_FIELD, pid)
        return True


def _identity(descriptor: int) -> tuple[int, int]:
    opened = os.fstat(descriptor)
    return opened.st_dev, opened.st_ino


def _mapped(path: Path, descriptor: int, writable: bool) -> mmap.mmap:
    size = os.fstat(descriptor).st_size
    if size < layout.RECORDS_AT:
        raise BoardError(f"{path}: this is no board: it has {size} bytes")
    size = min(size, BLOCK_SIZE_MAX)
    protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
    try:
        return mmap.mmap(descriptor, size, mmap.MAP_SHARED, protection)
    except OSError as error:
        raise BoardError(f"cannot map {path}: {error.strerror}") from error


def _second_opening(path: Path, first: int) -> int:
    """Another opening of the very file that is open already."""
    with contextlib.suppress(OSError):
        return os.open(f"/proc/self/fd/{first}", os.O_RDWR | os.O_CLOEXEC)
    again = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    if not os.path.sameopenfile(first, again):
        os.close(again)
        raise BoardGoneError(f"{path}: it was made anew while it was opened")
    return again
