"""One mapped file of a board: its records, its items' places, its users' and writers' locks."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Final

from failover.boards import locks
from failover.boards.shared_file import SharedFile
from failover.core.board import layout
from failover.core.board.banks import Place, place_of
from failover.core.board.items import BLOCK_SIZE_MAX
from failover.core.board.layout import USER_LOCKS, USERS_MAX, WRITER_LOCKS, Header, Record, Wanted
from failover.core.board.owners import Owners, is_rightful
from failover.errors import BoardError, BoardGoneError

USER_PREFIX: Final = "own+"
"""Of the name of a file that one user writes and all read."""

_U32: Final = struct.Struct("<I")


def uid_of(path: Path) -> int | None:
    """The one user who may write a file, by its name; None: it is no file of one user."""
    uid = path.name.removeprefix(USER_PREFIX)
    return int(uid) if uid != path.name and uid.isascii() and uid.isdigit() else None


class MappedFile(SharedFile):
    """A file of a board, mapped; see `SharedFile`. It may grow while it is open.

    Attributes:
        owners: tells whose the items are; what stands in the file without a right to is left out. None: all is believed.
    """

    SIZE_MIN: ClassVar[int] = layout.RECORDS_AT
    SIZE_MAX: ClassVar[int] = BLOCK_SIZE_MAX

    header: Header
    owners: Callable[[], Owners | None] | None = None

    # --- What the file says ---

    @property
    def always_wakes(self) -> bool:
        """Whether a put wakes all that sleep on its number: other users read the file, and cannot say that they wait."""
        return self.path.name.startswith(USER_PREFIX)

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
            found = list(layout.read_records(self.view, header))
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None
        owners = self.owners() if self.owners is not None else None
        if owners is None:
            return found
        uid = uid_of(self.path)
        return [record for record in found if is_rightful(owners, record.name, uid)]

    def _reach(self) -> Header:
        """The header; the mapping then reaches as far as the file, if others have added items since.

        What has a place in the old mapping keeps it: both are the same memory.
        """
        header = self.read_header()
        if header.file_size > len(self.area):
            self._map_again()
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

    def add(self, wanted: Wanted) -> Record:
        """Append an item, inside of `changing`.

        Its memory is there then. A program that touches a page for which there is none is ended by the kernel (SIGBUS).

        Raises:
            BoardError: there is no room.
        """
        header = self.read_header()
        try:
            addition = layout.addition(header, wanted)
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None
        try:
            os.posix_fallocate(self.descriptor, header.file_size, addition.size - header.file_size)
            for offset, piece in addition.pieces:
                os.pwrite(self.descriptor, piece, offset)
        except OSError as error:
            raise BoardError(f"cannot add item {wanted.name!r} to {self.path}: {error.strerror}; free /dev/shm") from error
        return addition.record

    def grow(self, size: int) -> None:
        """Make the file so long, if it is shorter: what is added later lies in the mapping already. Its use takes the memory.

        Raises:
            BoardError: it cannot be mapped.
        """
        if os.fstat(self.descriptor).st_size < size:
            os.ftruncate(self.descriptor, size)
        if len(self.area) < size:
            self._map_again()

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

    def touch(self) -> None:
        """Set the file's times: that tells an agent of an urgent put. If the kernel refuses, the put waits for the round."""
        try:  # not `suppress`: a put waits for it
            os.utime(self.descriptor)
        except OSError:
            return

    def take_writer(self, record: Record, pid: int) -> bool:
        """Become the writer of an item; False if another process is."""
        if not locks.take(self.descriptor, WRITER_LOCKS + record.index):
            return False
        self.set_word32(record.at + layout.PID_FIELD, pid)
        return True
