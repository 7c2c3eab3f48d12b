"""This robot's items as the main loop takes them: by read(2), not from a mapping.

The files are `failover.boards.unmapped_file`'s. The order of loads is that of `failover.core.board.banks.get_carefully`.
"""

from __future__ import annotations

import contextlib
import os
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from failover.boards.unmapped_file import UnmappedFile
from failover.core.board import layout
from failover.core.board.banks import RETRIES, Found, sum_of
from failover.core.board.items import BLOCK_SIZE_MAX
from failover.core.board.layout import ADDED, NOT_SENT, URGENT, Record
from failover.core.board.owners import Owners
from failover.errors import BoardError, OvertakenError

UNREADABLE: Final = "own items that could not be read"

LOOK_NS: Final = 100_000_000
"""Between two looks at a table that changes: a program that changes it all the time costs the loop no more."""

NEAR: Final = 64 << 10
"""Items whose banks lie within so many bytes are read at once."""

_BANK: Final = struct.Struct("<QQQII")
"""Number, stamp, sum, size, error."""

_NUMBER: Final = struct.Struct("<Q")

WAITS_FOR_ANY: Final = b"\x01"
ANY_FIELD: Final = layout.WAITERS_FIELD + 1

_NEWEST: Final = struct.Struct(f"<{layout.NEWEST_FIELD}xQ{layout.RECORD_SIZE - layout.NEWEST_FIELD - 8}x")
"""Of a record the number of its newest put."""


Newest = list[tuple[Record, int]]
"""Items with the numbers of their newest puts; 0: none."""


class OwnItems:
    """The items that this robot sends, of one file.

    Attributes:
        records: by number, as the table was when it was last read.
    """

    def __init__(self, file: UnmappedFile, believes: Callable[[Record], bool] | None = None) -> None:
        """``believes``: whether an item may stand in this file; None: any may."""
        self._file, self._believes = file, believes
        self._descriptor = file.descriptor
        self.records: dict[int, Record] = {}
        self.urgent: tuple[Record, ...] = ()
        self._urgent_at: tuple[tuple[int, int], ...] = ()
        self._known: dict[int, Found] = {}
        self._generation = -1
        self._looked_ns: int | None = None
        self._table_size = 0

    def look(self, now_ns: int) -> bool:
        """Read the table if it has changed; whether there are other items now.

        Raises:
            BoardError: it cannot be believed.
        """
        generation = self._word(layout.GENERATION_AT)
        if generation == self._generation or (self._looked_ns is not None and now_ns - self._looked_ns < LOOK_NS):
            return False
        self._looked_ns = now_ns
        content = os.pread(self._descriptor, min(os.fstat(self._descriptor).st_size, BLOCK_SIZE_MAX), 0)
        header = layout.read_header(content)
        found = [record for record in layout.read_records(content, header) if not record.flags & NOT_SENT]
        if self._believes is not None:
            found = list(filter(self._believes, found))
        self._generation = generation if generation % 2 == 0 else -1
        self._table_size = header.count * layout.RECORD_SIZE
        self.records = {record.id: record for record in found}
        self._known = {}
        self.urgent = tuple(record for record in found if record.flags & URGENT)
        self._urgent_at = tuple((record.id, record.at + layout.NEWEST_FIELD) for record in self.urgent)
        return True

    def urgent_numbers(self) -> dict[int, int]:
        """Numbers of the newest puts of the urgent items, by the items' numbers; 0: none.

        Raises:
            OSError: the file cannot be read.
        """
        pread, descriptor = os.pread, self._descriptor
        return {number: int.from_bytes(pread(descriptor, 8, at), "little") for number, at in self._urgent_at}

    def ask(self) -> None:
        """Have the writers of urgent items tell of their next put.

        Raises:
            OSError: the file cannot be written.
        """
        for record in self.urgent:
            os.pwrite(self._descriptor, WAITS_FOR_ANY, record.at + ANY_FIELD)

    def newest(self, numbers: Sequence[int]) -> Newest:
        """Of the items with these numbers the newest puts as they are now.

        Raises:
            BoardError: the file was made shorter.
        """
        table = os.pread(self._descriptor, self._table_size, layout.RECORDS_AT)
        if len(table) < self._table_size:
            raise BoardError(f"{self._file.path}: the file was made shorter")
        puts = [put for (put,) in _NEWEST.iter_unpack(table)]
        return [(record, puts[record.index]) for record in map(self.records.__getitem__, numbers)]

    def read_ahead(self, newest: Newest) -> None:
        """Read the newest puts of several items with two calls, not two for each: `get` has those that were whole.

        Raises:
            OSError: the file cannot be read.
        """
        known, fresh = self._known, []
        first, end = sys.maxsize, 0
        for record, number in newest:
            before = known.get(record.id)
            if number and (before is None or before.number != number):
                at = record.offset + number % record.banks * record.stride
                fresh.append((record, number, at))
                first, end = min(first, at), max(end, at + layout.BANK_HEAD + record.size)
        if len(fresh) < 2 or end - first > NEAR:
            return
        content, again = (os.pread(self._descriptor, end - first, first) for _ in range(2))
        if len(content) < end - first or len(again) < end - first:
            return
        for record, number, at in fresh:
            begin = at - first
            came, stamp_ns, total, size, error_us = _BANK.unpack_from(content, begin)
            if came != number or size > record.size or _NUMBER.unpack_from(again, begin)[0] != number:
                continue
            value = content[begin + layout.BANK_HEAD : begin + layout.BANK_HEAD + size]
            if total in (0, sum_of(value, stamp_ns, number)):
                known[record.id] = Found(value, stamp_ns, error_us, number)

    def get(self, record: Record, number: int) -> Found | None:
        """The newest put of an item, whole; None before the first. A put that was read before is not read again.

        Args:
            number: of its newest put, a moment ago.

        Raises:
            OvertakenError, BoardError: see `failover.core.board.banks.get_carefully`.
        """
        known = self._known.get(record.id)
        if known is not None and known.number == number:
            return known
        pread, descriptor, head, limit = os.pread, self._descriptor, layout.BANK_HEAD, layout.BANK_HEAD + record.size
        for _ in range(RETRIES):
            if number == 0:
                return None
            bank = record.offset + number % record.banks * record.stride
            content = pread(descriptor, limit, bank)
            if len(content) < head:
                raise BoardError(f"{self._file.path}: item {record.name!r}: the file was made shorter")
            _, stamp_ns, total, size, error_us = _BANK.unpack_from(content)
            value = content[head : head + size]
            if int.from_bytes(pread(descriptor, 8, bank), "little") == number:
                if len(value) != size:
                    raise BoardError(f"{self._file.path}: item {record.name!r}: damaged: a value of {size} bytes")
                if total in (0, sum_of(value, stamp_ns, number)):
                    found = self._known[record.id] = Found(value, stamp_ns, error_us, number)
                    return found
            number = self._word(record.at + layout.NEWEST_FIELD)
        raise OvertakenError(f"item {record.name!r} was written {RETRIES} times while it was read")

    def _word(self, offset: int) -> int:
        return int.from_bytes(os.pread(self._descriptor, 8, offset), "little")


class OwnFiles:
    """The items that this robot sends, where there are files of one user beside `own`: as `OwnItems`, of all of them.

    What a user does to his file harms no item of another file: it is counted, and the others go.
    """

    def __init__(self, files: Sequence[OwnItems], dropped: Counter[str]) -> None:
        self._files, self._dropped = files, dropped
        self._of: dict[int, OwnItems] = {}
        self.records: dict[int, Record] = {}
        self.urgent: tuple[Record, ...] = ()

    @contextlib.contextmanager
    def _counted(self) -> Iterator[None]:
        try:
            yield
        except (BoardError, OSError):
            self._dropped[UNREADABLE] += 1

    def look(self, now_ns: int) -> bool:
        """Read the tables that have changed; whether there are other items now."""
        changed = False
        for one in self._files:
            with self._counted():
                changed = one.look(now_ns) or changed
        if changed:
            self._of = {number: one for one in reversed(self._files) for number in one.records}
            self.records = {number: one.records[number] for number, one in self._of.items()}
            self.urgent = tuple(record for record in self.records.values() if record.flags & URGENT)
        return changed

    def urgent_numbers(self) -> dict[int, int]:
        """See `OwnItems.urgent_numbers`."""
        found: dict[int, int] = {}
        for one in self._files:
            with self._counted():
                found.update(one.urgent_numbers())
        return found

    def ask(self) -> None:
        """See `OwnItems.ask`."""
        for one in self._files:
            with self._counted():
                one.ask()

    def newest(self, numbers: Sequence[int]) -> Newest:
        """See `OwnItems.newest`; without those of a file that cannot be read."""
        found: dict[int, tuple[Record, int]] = {}
        for one in self._files:
            with self._counted():
                mine = [number for number in numbers if self._of[number] is one]
                found.update(zip(mine, one.newest(mine) if mine else (), strict=True))
        return [found[number] for number in numbers if number in found]

    def read_ahead(self, newest: Newest) -> None:
        """See `OwnItems.read_ahead`."""
        for one in self._files:
            with self._counted():
                one.read_ahead([pair for pair in newest if self._of[pair[0].id] is one])

    def get(self, record: Record, number: int) -> Found | None:
        """See `OwnItems.get`."""
        return self._of[record.id].get(record, number)


def own_items(
    files: Sequence[tuple[UnmappedFile, int | None]], owners: Owners | None, dropped: Counter[str]
) -> OwnItems | OwnFiles:
    """The items of `own`, the first file, and of files of one user, each with the uid of that one."""
    if owners is None:
        return OwnItems(files[0][0])
    numbers = {owner.number for owner in owners.values()}

    def believes(uid: int | None) -> Callable[[Record], bool]:
        if uid is None:
            return lambda record: record.name not in owners and record.id not in numbers
        theirs = {(name, owner.number) for name, owner in owners.items() if owner.uid == uid}
        return lambda record: (record.name, record.id) in theirs and not record.flags & ADDED

    return OwnFiles([OwnItems(file, believes(uid)) for file, uid in files], dropped)
