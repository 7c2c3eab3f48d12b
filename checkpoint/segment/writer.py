"""Write a program's commits to a segment: one thread at a time, and no call waits for another process.

A commit that is interrupted anywhere leaves the bank that it wrote with the number 0. The newest state is then in another, whole
bank.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
import sys
import time
from collections.abc import Sequence
from typing import Final, TypeAlias

from msgspec import Struct

from checkpoint.errors import SegmentError
from checkpoint.runtime.lazy_numpy import NDArray, np
from checkpoint.segment.layout import (
    BANK_BITS,
    MAX_NUMBER,
    NEWEST_OFFSET,
    NOT_TOLD,
    PAGE,
    RECORD_SIZE,
    RECORDS_OFFSET,
    SUPERSEDED_OFFSET,
    TABLE_OFFSET,
    TOLD,
    WORD,
    Layout,
    Outputs,
    lock_of,
    stretches,
)

Bytes: TypeAlias = "NDArray[np.uint8]"

NAME: Final = "failover-segment"
"""Its name in /proc/PID/fd and /proc/PID/maps."""

HANDED_NAME: Final = "failover-handed"
"""…and one that is handed to a program to go on from: it must not be taken for the one that its commits go to."""

COMPARE_SIZE: Final = 1 << 18
"""Bytes compared at a time where the written pages are not known."""

_NEWEST: Final = NEWEST_OFFSET // WORD

RUNS_MAX: Final = 1024
"""Stretches of pages that are copied one by one; more are copied by numpy."""

# These calls keep the interpreter: a commit that lets it go in the middle, be it for a microsecond, may get it back from
# the thread that writes the file only after sys.getswitchinterval(), 5 ms.
_libc = ctypes.PyDLL(None, use_errno=True)
_memcmp = _libc.memcmp
_memcmp.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_memcmp.restype = ctypes.c_int
_memcpy = _libc.memcpy
_memcpy.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_memcpy.restype = ctypes.c_void_p
_fcntl = _libc.fcntl
_fcntl.restype = ctypes.c_int


class Source(Struct, frozen=True, eq=False):
    """The content of one region now.

    Attributes:
        content: its bytes from the beginning; it may be shorter than the region, whose rest is zeros then. Few bytes are
            written fastest as ``bytes``: numpy's calls take longer than their work.
        written: numbers of its pages that may have changed since the last commit; None where unknown: they are compared.
    """

    content: Bytes | bytes
    written: NDArray[np.uint64] | None = None


class SegmentWriter:
    """A segment that this process writes.

    Attributes:
        descriptor: is handed to a reader. A child that inherits it by fork must close it, or it keeps this process's locks alive.
        number: of the newest commit.

    Raises:
        SegmentError: there is no memory for it, or a limit forbids it.
    """

    def __init__(self, layout: Layout, *, number: int = 0, name: str = NAME) -> None:
        if sys.byteorder != "little":
            raise SegmentError("segment: this machine stores the high byte first, which segments do not")
        layout.check()
        self.layout = layout
        self.number = number
        self.descriptor = -1
        try:
            self.descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.ftruncate(self.descriptor, layout.file_size)
            fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
            self._memory = _mapped(self.descriptor, layout.file_size)
        except OSError as error:
            if self.descriptor >= 0:
                os.close(self.descriptor)
            raise SegmentError(f"segment: cannot get {layout.file_size >> 10} KiB of shared memory: {error.strerror}") from error
        self._memory[: len(layout.packed())] = layout.packed()
        self._words = memoryview(self._memory)[:TABLE_OFFSET].cast("Q")
        whole = np.frombuffer(self._memory, dtype=np.uint8)
        self._banks = [whole[layout.bank_offset(bank) :][: layout.page_count * PAGE] for bank in range(layout.banks)]
        self._rows = [bank.reshape(-1, PAGE) for bank in self._banks]
        self._stamps = [
            whole[layout.versions_offset(bank) :][: layout.page_count * WORD].view(np.uint64) for bank in range(layout.banks)
        ]
        self._firsts = layout.first_pages()
        self._counts = [region.page_count for region in layout.regions]
        self._versions = np.zeros(layout.page_count, dtype=np.uint64)
        """For every page the commit that changed it last."""
        self._version_words = self._versions.data
        self._stamp_words = [
            memoryview(self._memory)[layout.versions_offset(bank) :][: layout.page_count * WORD].cast("Q")
            for bank in range(layout.banks)
        ]
        self._starts = [layout.bank_offset(bank) for bank in range(layout.banks)]
        self._sizes = [0] * len(layout.regions)
        """Bytes that each region's source had at the last commit."""
        self._held = [0] * layout.banks
        """Which commit each bank holds, 0 none or a part."""
        self._newest = -1
        self._locks = [lock_of(fcntl.F_WRLCK, bank) for bank in range(layout.banks)]
        self._unlocks = [lock_of(fcntl.F_UNLCK, bank) for bank in range(layout.banks)]

    def commit(self, sources: Sequence[Source], outputs: Outputs = None) -> bool:
        """Make what the sources hold the newest commit, as one.

        Args:
            sources: one for every region, in their order.
            outputs: written until now.

        Returns:
            False when every bank but the newest is held by readers; nothing was forgotten, the next call makes up for it.
        """
        assert len(sources) == len(self.layout.regions), "one source for every region"
        number = self.number + 1
        assert number <= MAX_NUMBER, "commits do not run out in a lifetime"
        for index, source in enumerate(sources):
            self._mark(index, source, number)
        bank = self._free_bank()
        if bank is None:
            return False
        try:
            self._write(bank, number, sources, outputs)
        finally:
            _fcntl(self.descriptor, fcntl.F_OFD_SETLK, self._unlocks[bank])
        self._words[_NEWEST] = number << BANK_BITS | bank
        self.number, self._newest = number, bank
        return True

    def _write(self, bank: int, number: int, sources: Sequence[Source], outputs: Outputs) -> None:
        """Bring a bank that we hold up to date.

        1. Its record says that it holds nothing, before the first byte of it changes.
        2. Pages and versions; then the times and the bytes of output; then the commit's number: the bank is whole.
        3. The lock ends, and only then the newest word names the bank: no reader that follows it meets the lock, and
           the next holder of the lock sees all of this.
        """
        record = (RECORDS_OFFSET + bank * RECORD_SIZE) // WORD
        since, self._held[bank] = self._held[bank], 0
        self._words[record] = 0
        for index, source in enumerate(sources):
            self._copy(bank, index, source, since)
        self._words[record + 1] = time.clock_gettime_ns(time.CLOCK_REALTIME)
        self._words[record + 2] = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        self._words[record + 3] = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        told, counts = (TOLD, outputs) if isinstance(outputs, tuple) else (outputs.value if outputs else NOT_TOLD, (0, 0))
        self._words[record + 4], self._words[record + 5], self._words[record + 6] = told, *counts
        self._words[record] = number
        self._held[bank] = number

    def _mark(self, index: int, source: Source, number: int) -> None:
        """Note which pages of a region this commit changes."""
        first, size = self._firsts[index], len(source.content)
        if isinstance(source.content, bytes):
            self._mark_few(source.content, first, number)
        elif source.written is not None:
            if len(source.written):
                self._versions[source.written + np.uint64(first)] = number
        elif self._newest < 0:
            self._versions[first : first + pages_of(size)] = number
        else:
            self._mark_different(source.content, first, number)
        if size < self._sizes[index]:
            self._versions[first + size // PAGE : first + pages_of(self._sizes[index])] = number
        self._sizes[index] = size

    def _mark_few(self, content: bytes, first: int, number: int) -> None:
        """As `_mark_different`, for few bytes."""
        start = self._starts[self._newest] + first * PAGE
        for offset in range(0, len(content), PAGE):
            piece = content[offset : offset + PAGE]
            if self._newest < 0 or self._memory[start + offset : start + offset + len(piece)] != piece:
                self._version_words[first + offset // PAGE] = number

    def _mark_different(self, content: Bytes, first: int, number: int) -> None:
        """Compare with the newest commit, and with what was noted for one that found no bank."""
        start, size = first * PAGE, len(content)
        newest = self._banks[self._newest]
        here, there = content.ctypes.data, newest.ctypes.data + start
        step = PAGE if size <= COMPARE_SIZE else COMPARE_SIZE
        for offset in range(0, size, step):
            length = min(step, size - offset)
            if _memcmp(here + offset, there + offset, length) == 0:
                continue
            for inner in range(offset, offset + length, PAGE):
                if step == PAGE or _memcmp(here + inner, there + inner, min(PAGE, size - inner)) != 0:
                    self._versions[first + inner // PAGE] = number

    def _copy(self, bank: int, index: int, source: Source, since: int) -> None:
        """Copy the pages of a region that this bank has missed, and their versions."""
        first, content = self._firsts[index], source.content
        if isinstance(content, bytes):
            self._copy_few(bank, index, content, since)
            return
        versions = self._versions[first : first + self._counts[index]]
        missed = np.flatnonzero(versions > since)
        if not len(missed):
            return
        self._stamps[bank][first : first + len(versions)][missed] = versions[missed]
        rows = self._rows[bank][first : first + len(versions)]
        whole = len(content) // PAGE
        if missed[-1] >= whole:
            rest = missed[missed >= whole]
            missed = missed[: -len(rest)]
            rows[rest] = 0
            if rest[0] == whole:
                rows[whole, : len(content) - whole * PAGE] = content[whole * PAGE :]
        if len(missed):
            _copy_pages(rows, content, missed)

    def _copy_few(self, bank: int, index: int, content: bytes, since: int) -> None:
        """As `_copy`, for few bytes."""
        versions, stamps = self._version_words, self._stamp_words[bank]
        first = self._firsts[index]
        for page in range(first, first + self._counts[index]):
            if (version := versions[page]) > since:
                stamps[page] = version
                offset = (page - first) * PAGE
                place = self._starts[bank] + page * PAGE
                self._memory[place : place + PAGE] = content[offset : offset + PAGE].ljust(PAGE, b"\0")

    def _free_bank(self) -> int | None:
        """Lock a bank that is neither the newest nor held; in turn, so that none has ever missed much."""
        for bank in sorted(range(len(self._held)), key=self._held.__getitem__):
            if bank != self._newest:
                if _fcntl(self.descriptor, fcntl.F_OFD_SETLK, self._locks[bank]) == 0:
                    return bank
                if ctypes.get_errno() not in (errno.EAGAIN, errno.EACCES):
                    raise OSError(ctypes.get_errno(), "cannot lock a bank of a segment")
        return None

    def grown(self, layout: Layout) -> SegmentWriter:
        """Another segment of the same lineage that begins with the newest commit; regions are the same by name.

        Commits go on in the new one; `supersede` this one when the new one was handed over.
        """
        assert layout.lineage == self.layout.lineage, "numbers go on"
        new = SegmentWriter(layout, number=self.number)
        if self._newest < 0:
            return new
        places = {region.name: index for index, region in enumerate(self.layout.regions)}
        for index, region in enumerate(layout.regions):
            old = places.get(region.name)
            if old is not None and self.layout.regions[old].address == region.address:
                new._sizes[index] = self._sizes[old]
                count = min(region.page_count, self.layout.regions[old].page_count)
                new._take(index, self, self._firsts[old], count)
        record = RECORDS_OFFSET // WORD
        mine = (RECORDS_OFFSET + self._newest * RECORD_SIZE) // WORD
        new._words[record : record + 7] = self._words[mine : mine + 7]
        new._held[0], new._newest = self.number, 0
        new._stamps[0][:] = new._versions
        new._words[_NEWEST] = self.number << BANK_BITS
        return new

    def _take(self, index: int, other: SegmentWriter, first: int, count: int) -> None:
        """Begin a region with what another segment's newest bank holds of it."""
        here = self._firsts[index]
        versions = other._stamps[other._newest][first : first + count]
        held = np.flatnonzero(versions)
        self._versions[here : here + count] = versions
        self._rows[0][here : here + count][held] = other._rows[other._newest][first : first + count][held]

    def supersede(self) -> None:
        """Tell readers that later commits go to another segment."""
        self._words[SUPERSEDED_OFFSET // WORD] = 1

    def close(self) -> None:
        """Give the descriptor back; the memory goes with the last view of it."""
        os.close(self.descriptor)


def _copy_pages(rows: Bytes, content: Bytes, numbers: NDArray[np.intp]) -> None:
    """Copy whole pages, by their numbers, in order."""
    runs = stretches(numbers.view(np.uint64))
    if len(runs) > RUNS_MAX:
        rows[numbers] = content[: len(content) // PAGE * PAGE].reshape(-1, PAGE)[numbers]
        return
    target, origin = rows.ctypes.data, content.ctypes.data
    for first, count in runs:
        _memcpy(target + first * PAGE, origin + first * PAGE, count * PAGE)


def pages_of(size: int) -> int:
    """How many pages so many bytes take."""
    return -(-size // PAGE)


def _mapped(descriptor: int, size: int) -> mmap.mmap:
    """Map a file by an opening of its own.

    A mapping keeps its opening alive, also in a child that was forked; it must not be the one that has the locks.
    """
    again = os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_CLOEXEC)
    try:
        return mmap.mmap(again, size)
    finally:
        os.close(again)
