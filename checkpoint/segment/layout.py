"""The layout of the shared segment, in which a cooperating program commits its state and readers read it without stopping it.

SEGMENT.md beside this file is normative, to the byte. In short: a table of *regions*, and several *banks*, each a whole copy of
all regions with a version for every page. A commit writes a bank that is neither the newest nor held by a reader. A reader holds
the newest bank by a lock that ends with the reader. So no process waits, and a process that dies at any instant leaves one whole
bank.

This file defines what the bytes mean; `checkpoint.segment.writer` writes them, `checkpoint.segment.reader` reads them.
"""

from __future__ import annotations

import enum
import os
import struct
from itertools import accumulate, pairwise
from typing import Final

from msgspec import Struct

from checkpoint.errors import SegmentError
from checkpoint.model import Clocks
from checkpoint.pages.page_set import Words
from checkpoint.runtime.lazy_numpy import NDArray, np

MAGIC: Final = b"\x89FOSEG\r\n"
VERSION: Final = 1
PAGE: Final = 4096
"""Bytes of a segment's page, also on machines with other pages: so a state moves between machines."""

BANKS: Final = 3
"""One is newest, one may be held by a reader, one is free."""
MAX_BANKS: Final = 8
MAX_REGIONS: Final = 1024
MAX_PAGES: Final = (64 << 30) // PAGE
"""Pages of one bank: as much as a snapshot may carry (FORMAT.md)."""
MAX_NUMBER: Final = 1 << 56
"""Commits are numbered below this."""

STATE: Final = 1
ARRAY: Final = 2
KINDS: Final = (STATE, ARRAY)
"""The encoded state of a program, with its size in front; raw bytes whose meaning the state tells, or the program knows."""

HEAD: Final = struct.Struct("<8sIIIIQQ16s")
ENTRY: Final = struct.Struct("<IIQQQ224s")
MAX_NAME_SIZE: Final = 224
TABLE_OFFSET: Final = PAGE
NEWEST_OFFSET: Final = 256
SUPERSEDED_OFFSET: Final = 320
RECORDS_OFFSET: Final = 512
RECORD_SIZE: Final = 64
RECORD: Final = struct.Struct("<7Q")
WORD: Final = 8

BANK_BITS: Final = 8
"""The newest word is a commit's number, shifted by this, and its bank."""

STRIDE: Final = 1 << 37
"""Between the addresses of two regions: more than a bank may hold, so that a region that grows keeps its address."""
MAX_PLACES: Final = 1 << 20
"""Addresses for regions in one lineage. None is given twice: a delta could not tell a new region's zeros from old pages."""


class Region(Struct, frozen=True):
    """One piece of memory that survives.

    Attributes:
        kind: `STATE` or `ARRAY`.
        address: what its first byte is called in snapshots; nothing is mapped there.
        size: bytes; its last page is filled with zeros.
    """

    name: str
    kind: int
    address: int
    size: int

    @property
    def page_count(self) -> int:
        """Pages that it takes."""
        return -(-self.size // PAGE)

    @property
    def end(self) -> int:
        """The address after its last page."""
        return self.address + self.page_count * PAGE


class Layout(Struct, frozen=True):
    """The places in a segment; everything else follows from these.

    Attributes:
        lineage: 16 bytes; the numbers of commits and versions can be compared between segments of one lineage.
    """

    regions: tuple[Region, ...]
    lineage: bytes
    banks: int = BANKS

    @property
    def page_count(self) -> int:
        """Pages of one bank."""
        return sum(region.page_count for region in self.regions)

    @property
    def _versions_offset(self) -> int:
        return TABLE_OFFSET + _whole(len(self.regions) * ENTRY.size)

    def versions_offset(self, bank: int) -> int:
        """Where the versions of a bank's pages lie."""
        return self._versions_offset + bank * _whole(self.page_count * WORD)

    def bank_offset(self, bank: int) -> int:
        """Where the first page of a bank lies."""
        return self.versions_offset(self.banks) + bank * self.page_count * PAGE

    @property
    def file_size(self) -> int:
        """Bytes of the whole segment."""
        return self.bank_offset(self.banks)

    def first_pages(self) -> list[int]:
        """The number, in a bank, of each region's first page."""
        return list(accumulate((region.page_count for region in self.regions[:-1]), initial=0))

    def addresses(self) -> Words:
        """The address of every page of a bank."""
        parts = [np.arange(region.address, region.end, PAGE, dtype=np.uint64) for region in self.regions]
        return np.concatenate(parts)

    def check(self) -> None:
        """Refuse a layout that cannot be.

        Raises:
            SegmentError: names the first thing that is wrong.
        """
        if not 3 <= self.banks <= MAX_BANKS:
            raise SegmentError(f"segment: {self.banks} banks where 3 to {MAX_BANKS} are possible")
        if not 1 <= len(self.regions) <= MAX_REGIONS:
            raise SegmentError(f"segment: {len(self.regions)} regions where 1 to {MAX_REGIONS} are possible; keep fewer arrays")
        for region in self.regions:
            _check_region(region)
        for earlier, later in pairwise(self.regions):
            if later.address < earlier.end:
                raise SegmentError(f"segment: region {later.name!r} begins before {earlier.name!r} ends")
        if len({region.name for region in self.regions}) != len(self.regions):
            raise SegmentError("segment: two regions have the same name")
        if self.page_count > MAX_PAGES:
            raise SegmentError(f"segment: {self.page_count} pages where {MAX_PAGES} are possible; keep less")

    def packed(self) -> bytes:
        """The header page's fixed part and the table, as they stand in the file from its beginning."""
        head = HEAD.pack(
            MAGIC, VERSION, PAGE, len(self.regions), self.banks, self.page_count, self.file_size, self.lineage
        )  # fmt: skip
        entries = [_entry(region, first) for region, first in zip(self.regions, self.first_pages(), strict=True)]
        return head.ljust(TABLE_OFFSET, b"\0") + b"".join(entries)


def _entry(region: Region, first_page: int) -> bytes:
    name = region.name.encode()
    return ENTRY.pack(region.kind, len(name), region.address, region.size, first_page, name)


def _whole(size: int) -> int:
    """Bytes of the pages that so many bytes take."""
    return -(-size // PAGE) * PAGE


def _check_region(region: Region) -> None:
    if region.kind not in KINDS:
        raise SegmentError(f"segment: region {region.name!r} is of kind {region.kind}, which is none of {KINDS}")
    if not 1 <= len(region.name.encode()) <= MAX_NAME_SIZE:
        raise SegmentError(f"segment: a region's name has 1 to {MAX_NAME_SIZE} bytes, {region.name!r} has not")
    if not 1 <= region.size <= MAX_PAGES * PAGE:
        raise SegmentError(f"segment: region {region.name!r} has {region.size} bytes; 1 to {MAX_PAGES * PAGE} are possible")
    if region.address % PAGE or not PAGE <= region.address < (MAX_PLACES + 1) * STRIDE:
        raise SegmentError(f"segment: region {region.name!r} begins at {region.address:#x}, which is no address of a page")


def address_of(place: int) -> int:
    """The address of the region that came as number ``place``, from 0."""
    return (place + 1) * STRIDE


class Pending(enum.Enum):
    """The mark of a commit whose output had no room in its pipes: part of it lies in the program's buffers still.

    The size of that part is not known. A reader that carries output passes such a commit over; a later one tells it all.
    """

    PENDING = 2


PENDING: Final = Pending.PENDING
NOT_TOLD: Final = 0
TOLD: Final = 1
"""The other things that a record says of its program's output."""

Outputs = tuple[int, int] | Pending | None
"""Bytes that a program had written to its standard output and error at a commit; None where they are not counted."""


class Committed(Struct, frozen=True, eq=False):
    """The state that a program committed, whole or since an earlier commit.

    Attributes:
        number: of the commit; the first is 1.
        clocks: the machine's, at the commit.
        pages: numbers of the pages that changed since, in order; of the whole state, those that were ever written.
        contents: their bytes, in the same order.
        outputs: what the program had written by then.
    """

    layout: Layout
    number: int
    clocks: Clocks
    pages: Words
    contents: memoryview
    outputs: Outputs = None

    def region(self, index: int) -> bytearray:
        """The bytes of one region, where the whole state was read; pages never written are zeros."""
        wanted = self.layout.regions[index]
        first = self.layout.first_pages()[index]
        low, high = np.searchsorted(self.pages, [first, first + wanted.page_count])
        found = bytearray(wanted.page_count * PAGE)
        rows = np.frombuffer(found, dtype=np.uint8).reshape(-1, PAGE)
        read = np.frombuffer(self.contents, dtype=np.uint8).reshape(-1, PAGE)
        rows[(self.pages[low:high] - np.uint64(first)).astype(np.int64)] = read[low:high]
        del rows
        del found[wanted.size :]
        return found


def stretches(pages: NDArray[np.uint64]) -> list[tuple[int, int]]:
    """Numbers in order as (first, count) of those that follow one another."""
    if not len(pages):
        return []
    breaks = np.flatnonzero(pages[1:] - pages[:-1] != 1) + 1
    firsts = np.concatenate(([0], breaks))
    counts = np.diff(np.append(firsts, len(pages)))
    return list(zip(pages[firsts].tolist(), counts.tolist(), strict=True))


def lock_of(kind: int, bank: int) -> bytes:
    """A struct flock of fcntl(2) about the byte that stands for a bank.

    Source: fcntl(2), F_OFD_SETLK; asm-generic/fcntl.h.
    """
    return struct.pack("hhqqi4x", kind, os.SEEK_SET, bank, 1, 0)
