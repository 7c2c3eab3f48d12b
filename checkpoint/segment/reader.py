"""Read a segment, whose content may come from a hostile program.

Therefore every read uses pread(2), so that a file that shrinks is an error and not a signal, and every number is checked.
"""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from checkpoint.errors import SegmentBusyError, SegmentError
from checkpoint.model import Clocks
from checkpoint.pages.page_set import Words
from checkpoint.runtime.lazy_numpy import np
from checkpoint.segment.layout import (
    BANK_BITS,
    ENTRY,
    HEAD,
    MAGIC,
    MAX_NUMBER,
    MAX_REGIONS,
    NEWEST_OFFSET,
    PAGE,
    PENDING,
    RECORD,
    RECORD_SIZE,
    RECORDS_OFFSET,
    SUPERSEDED_OFFSET,
    TABLE_OFFSET,
    TOLD,
    VERSION,
    WORD,
    Committed,
    Layout,
    Region,
    lock_of,
    stretches,
)

ATTEMPTS: Final = 200
"""How often a reader looks again when the writer overtakes it between its look and its lock."""


class SegmentReader:
    """Reads what a program has committed; never makes it wait, and needs nothing of it, not even that it lives.

    Args:
        descriptor: of the segment; it stays the caller's. It is opened again here, since locks belong to an opening.

    Raises:
        SegmentError: not a segment that we read; says what is wrong.
    """

    def __init__(self, descriptor: int) -> None:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise SegmentError("segment: not a file, nor memory that behaves like one")
        try:
            self._file = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise SegmentError(
                f"cannot open a segment for reading: {error.strerror}; its owner must be the user of the reader"
            ) from error
        try:
            self.layout = self._read_layout()
        except BaseException:
            os.close(self._file)
            raise

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._file)

    @property
    def is_superseded(self) -> bool:
        """Whether the program goes on in another segment, which it has handed over."""
        return self._word(SUPERSEDED_OFFSET) != 0

    def newest(self) -> int:
        """The number of the newest commit; 0 while there is none."""
        return self._word(NEWEST_OFFSET) >> BANK_BITS

    def read(self, since: int = 0) -> Committed | None:
        """The newest commit: what changed after commit ``since``; None if there is nothing newer.

        1. The newest word names a bank that is whole and not locked. The writer may name another one at any time, and then
           write this one again.
        2. The bank is locked for reading: from here on it is not written. Where the lock is taken, the word names another
           bank by now: look again.
        3. Its record says which commit it holds: that one, or a later one, since the word was read before the lock. 0 is a
           bank whose writer was killed while it wrote; the word names another one by then. A later one counts once the word
           names it: should its writer be killed before that, an older one would be read next.

        Raises:
            SegmentBusyError: the bank was locked at every look.
            SegmentError: the program does not keep the rules.
        """
        for _ in range(ATTEMPTS):
            number, bank = divmod(self._word(NEWEST_OFFSET), 1 << BANK_BITS)
            if bank >= self.layout.banks or number > MAX_NUMBER:
                raise SegmentError(f"segment: commit {number} is said to be in bank {bank}, which there is not")
            if number <= since:
                return None
            with self._held(bank) as is_held:
                if is_held and (found := self._read_bank(bank, number, since)) is not None:
                    return found
            os.sched_yield()
        raise SegmentBusyError(f"segment: the bank said to be newest was being written at {ATTEMPTS} looks; look again later")

    def _read_bank(self, bank: int, at_least: int, since: int) -> Committed | None:
        before = self._exactly(RECORD_SIZE, RECORDS_OFFSET + bank * RECORD_SIZE)
        number, realtime, monotonic, boottime, counted, first, second = RECORD.unpack_from(before)
        if number < at_least or number > max(at_least, self.newest()):
            return None
        pages = self._changed(bank, number, since)
        contents = self._contents(bank, pages)
        if self._exactly(RECORD_SIZE, RECORDS_OFFSET + bank * RECORD_SIZE) != before:
            raise SegmentError(f"segment: bank {bank} was written while it was held; the program does not keep the rules")
        outputs = PENDING if counted == PENDING.value else (first, second) if counted == TOLD else None
        return Committed(self.layout, number, Clocks(realtime, monotonic, boottime), pages, contents, outputs)

    def _changed(self, bank: int, number: int, since: int) -> Words:
        """The numbers of the pages whose version is later than ``since``."""
        packed = self._exactly(self.layout.page_count * WORD, self.layout.versions_offset(bank))
        versions = np.frombuffer(packed, dtype="<u8")
        if int(versions.max()) > number:
            raise SegmentError(f"segment: a page of commit {number} says that it is of commit {int(versions.max())}")
        return np.flatnonzero(versions > np.uint64(since)).astype(np.uint64)

    def _contents(self, bank: int, pages: Words) -> memoryview:
        found = memoryview(bytearray(len(pages) * PAGE))
        offset, start = 0, self.layout.bank_offset(bank)
        for first, count in stretches(pages):
            self._fill(found[offset : offset + count * PAGE], start + first * PAGE)
            offset += count * PAGE
        return found.toreadonly()

    @contextmanager
    def _held(self, bank: int) -> Iterator[bool]:
        """Hold a bank so that the program does not write it; False if it is being written."""
        try:
            fcntl.fcntl(self._file, fcntl.F_OFD_SETLK, lock_of(fcntl.F_RDLCK, bank))
        except BlockingIOError:
            yield False
            return
        try:
            yield True
        finally:
            fcntl.fcntl(self._file, fcntl.F_OFD_SETLK, lock_of(fcntl.F_UNLCK, bank))

    def _read_layout(self) -> Layout:
        head = self._exactly(HEAD.size, 0)
        magic, version, page, region_count, banks, _, _, lineage = HEAD.unpack(head)
        if magic != MAGIC:
            raise SegmentError(f"segment: it begins with {magic!r}, not with {MAGIC!r}")
        if (version, page) != (VERSION, PAGE):
            raise SegmentError(
                f"segment: version {version} with pages of {page} bytes; this release reads version {VERSION} with {PAGE}"
            )
        if not 1 <= region_count <= MAX_REGIONS:
            raise SegmentError(f"segment: {region_count} regions where 1 to {MAX_REGIONS} are possible")
        packed = self._exactly(region_count * ENTRY.size, TABLE_OFFSET)
        layout = Layout(tuple(_region(entry) for entry in ENTRY.iter_unpack(packed)), lineage, banks)
        layout.check()
        if layout.packed() != head.ljust(TABLE_OFFSET, b"\0") + packed:
            raise SegmentError("segment: its header and its table of regions contradict one another")
        if os.fstat(self._file).st_size < layout.file_size:
            raise SegmentError(f"segment: {os.fstat(self._file).st_size} bytes where {layout.file_size} belong")
        return layout

    def _word(self, offset: int) -> int:
        return int.from_bytes(self._exactly(WORD, offset), "little")

    def _exactly(self, size: int, offset: int) -> bytearray:
        found = bytearray(size)
        self._fill(memoryview(found), offset)
        return found

    def _fill(self, target: memoryview, offset: int) -> None:
        while target:
            count = os.preadv(self._file, [target], offset)
            if count == 0:
                raise SegmentError(f"segment: it ends at byte {offset}, in the middle of its content")
            target, offset = target[count:], offset + count


def _region(entry: tuple[int, int, int, int, int, bytes]) -> Region:
    kind, name_size, address, size, _, padded = entry
    try:
        return Region(padded[:name_size].decode(), kind, address, size)
    except UnicodeDecodeError as error:
        raise SegmentError(f"segment: the name of a region is not UTF-8: {padded[:name_size]!r}") from error
