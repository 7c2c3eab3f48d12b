"""Find which pages of a process exist and which were written: /proc/PID/pagemap, by PAGEMAP_SCAN or read as a file.

Source: Documentation/admin-guide/mm/pagemap.rst.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import mmap
import os
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple, Protocol

import numpy as np

from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import ROW_SIZE, Loop, OwnCalls, row
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs import procfs
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.runtime.lazy_numpy import NDArray

BATCH: Final = 64
"""Ranges that are asked about in one go."""
REGION_COUNT: Final = 1 << 7
"""Regions that one scan call may answer with; more are asked for in the next call."""
MARKER_RUN: Final = 64 * abi.PAGE_SIZE
"""Where nothing is swapped out, what looks so is a hole that we protected, or a page that the kernel moves just now: it moves 32
at a time (COMPACT_CLUSTER_MAX), so a longer run is a hole."""


class MappingLostError(CaptureError):
    """A mapping is not write-protected any more."""


class Question(NamedTuple):
    """Which pages are wanted, and the categories to tell of them: see struct pm_scan_arg."""

    inverted: int
    mask: int
    anyof: int
    told: int


UNREGISTERED: Final = Question(abi.PAGE_IS_WPALLOWED, abi.PAGE_IS_WPALLOWED, 0, abi.PAGE_IS_WPALLOWED)
WRITTEN: Final = Question(0, abi.PAGE_IS_WRITTEN, 0, abi.PAGE_IS_WRITTEN)


class _Orders:
    """One question about several ranges in one go. Unchanged parts are not filled in anew the next time.

    Attributes:
        starts, ends: of the ranges.
        reached: how far each scan came.
        counts: of the regions that each found; an error is a negative number.
        regions: start, end and categories of each, by range.
    """

    def __init__(self, pagemap: int, question: Question, loop: Loop | None) -> None:
        self.counts = np.zeros(BATCH, dtype=np.int64)
        self.regions = np.zeros((BATCH, REGION_COUNT, 3), dtype=np.uint64)
        size = ctypes.sizeof(abi.PageScan)
        self._words = np.zeros((BATCH, size // 8), dtype=np.uint64)
        fields = [name for name, _ in abi.PageScan._fields_]
        self._words[:, fields.index("size")] = size
        self._words[:, fields.index("vec")] = self.regions.ctypes.data + np.arange(BATCH) * self.regions[0].nbytes
        self._words[:, fields.index("vec_len")] = REGION_COUNT
        self._words[:, fields.index("category_inverted") :] = question
        self.starts, self.ends, self.reached = (self._words[:, fields.index(name)] for name in ("start", "end", "walk_end"))
        self._flags, self._limits = (self._words[:, fields.index(name)] for name in ("flags", "max_pages"))
        self._asked: tuple[int, int] = (0, 0)
        self._ranges: Words | None = None
        place, answer = self._words.ctypes.data, self.counts.ctypes.data
        self._calls = OwnCalls(
            [row("ioctl", pagemap, abi.PAGEMAP_SCAN, place + index * size, to=answer + 8 * index) for index in range(BATCH)]
        )
        self._loop = loop

    def ask(self, ranges: Words, flags: int, limit: int) -> None:
        """Make the scans of these ranges, `BATCH` at most. The caller does not change them afterwards.

        Args:
            limit: no more than so many pages in each; 0: all.
        """
        if self._asked != (flags, limit):
            self._flags[:], self._limits[:] = flags, limit
            self._asked = flags, limit
        if ranges is not self._ranges:
            self.starts[: len(ranges)], self.ends[: len(ranges)] = ranges[:, 0], ranges[:, 1]
            self._ranges = ranges
        self._make(0, len(ranges))

    def ask_further(self, place: int) -> None:
        """Make the scan of the rest of one range."""
        self._ranges = None
        self.starts[place] = self.reached[place]
        self._make(place, place + 1)

    def _make(self, first: int, last: int) -> None:
        if self._loop is None:
            self._calls.run(first, last)
        else:
            self._loop(self._calls.address + first * ROW_SIZE, self._calls.address + last * ROW_SIZE)


class Private(NamedTuple):
    """A process's own pages: neither holes nor unchanged ones of a file.

    Attributes:
        present: in memory.
        swapped: they have an entry and are not in memory: swapped out, on the move, or (a few at a time) no pages, only protected
            holes.
        written: those of both that were written since they were last protected, or never were.
    """

    present: Words
    swapped: Words
    written: Words


class PageScanner:
    """PAGEMAP_SCAN on one process's pagemap.

    Args:
        loop: makes the calls, see `checkpoint.linux.batch_syscalls`; None: as fast as may be.

    Raises:
        ProcessGoneError: it ended, or it became another program (exec).
        ProbeError: not permitted: it ended just now, or became another user's.
    """

    def __init__(self, pid: int, loop: Loop | None = None) -> None:
        self._pid = pid
        self._pagemap = procfs.opened(pid, "pagemap")
        self._loop = loop
        self._orders: dict[Question, _Orders] = {}
        self._guard = abi.PAGE_IS_GUARD if self._understands(abi.PAGE_IS_GUARD) else 0

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._pagemap)

    def is_protected(self, start: int, end: int) -> bool:
        """Whether every mapping in a range is registered for asynchronous write protection."""
        return not self.unprotected(np.array([[start, end]], dtype=np.uint64))

    def unprotected(self, ranges: Words) -> list[tuple[int, int]]:
        """The ranges in which a mapping is not registered for asynchronous write protection."""
        found = []
        for batch in _batches(ranges):
            counts = self._asked(UNREGISTERED, batch, abi.PM_SCAN_CHECK_WPASYNC).counts[: len(batch)].tolist()
            for count, (start, end) in zip(counts, batch.tolist(), strict=True):
                if count < 0:
                    self._refused("check", -count)
                    found.append((start, end))
        return found

    def _asked(self, question: Question, batch: Words, flags: int = 0, limit: int = 0) -> _Orders:
        """Ask about one batch of ranges; see `_Orders.ask`."""
        orders = self._orders.get(question)
        if orders is None:
            orders = self._orders[question] = _Orders(self._pagemap, question, self._loop)
        orders.ask(batch, flags, limit)
        return orders

    def written(self, ranges: Words) -> Words:
        """Pages written since they were last protected, and holes that never were; all are protected again.

        With exactly this mask the kernel takes its fast path.

        Raises:
            MappingLostError: a mapping is not protected (any more); the pages found until then are lost.
        """
        return pages_joined(self._collect(WRITTEN, ranges, abi.PM_SCAN_CHECK_WPASYNC | abi.PM_SCAN_WP_MATCHING)[:, :2])

    def rehearse(self, ranges: Words, looked_for: Words) -> None:
        """Go through the page tables as `written`, without protecting anything, and as `are_present`; forget what was found."""
        self._collect(WRITTEN, ranges, abi.PM_SCAN_CHECK_WPASYNC, [])
        self.are_present(looked_for)

    def written_where_protected(self, ranges: Words) -> tuple[Words, Words]:
        """As `written`, of a process that runs and may unmap anything under our hands.

        Returns:
            The written pages, and the ranges in which a mapping was not protected (any more): a part of such a range may have
            been protected again without being told.
        """
        refused: list[list[int]] = []
        found = pages_joined(self._collect(WRITTEN, ranges, abi.PM_SCAN_CHECK_WPASYNC | abi.PM_SCAN_WP_MATCHING, refused)[:, :2])
        return found, pages_joined(np.array(refused, dtype=np.uint64).reshape(-1, 2))

    def written_count(self, ranges: Words, limit: int) -> int:
        """How many pages `written` would find, counted no further than ``limit``; nothing is protected."""
        count = 0
        for batch in _batches(ranges):
            if count < limit:
                count += self._counted(batch, limit)
        return min(count, limit)

    def _counted(self, batch: Words, limit: int) -> int:
        """Of these ranges, counted in each no further than ``limit``."""
        orders, size = self._asked(WRITTEN, batch, limit=limit), 0
        for place, regions in enumerate(orders.counts[: len(batch)].tolist()):
            if regions > 0:
                size += page_set.total_size(orders.regions[place, :regions, :2])
            elif regions < 0:
                self._refused("count written", -regions)
        return size // abi.PAGE_SIZE

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """Pages present or swapped out, but guards, which look as if they were swapped out.

        Args:
            own: leave out unchanged pages of files and the shared page of zeros.
        """
        unwanted = (abi.PAGE_IS_FILE | abi.PAGE_IS_PFNZERO if own else abi.PAGE_IS_PFNZERO) | self._guard
        return pages_joined(self._there(ranges, unwanted)[:, :2])

    def private(self, ranges: Words) -> Private:
        """The process's own pages. Of those that are swapped out some may be nothing but what marks a hole as protected."""
        found = self._there(ranges, abi.PAGE_IS_FILE | abi.PAGE_IS_PFNZERO | self._guard, abi.PAGE_IS_WRITTEN)
        present, written = (found[:, 2] & np.uint64(one) != 0 for one in (abi.PAGE_IS_PRESENT, abi.PAGE_IS_WRITTEN))
        extents = found[:, :2]
        swapped = NONE if present.all() else pages_joined(extents[~present])
        return Private(pages_joined(extents[present]), swapped, pages_joined(extents[written]))

    def are_present(self, ranges: Words) -> bool:
        """Whether every page of a set is in memory and the process's own; cheaper than `private`, which tells which are."""
        others = abi.PAGE_IS_FILE | abi.PAGE_IS_PFNZERO | self._guard
        question = Question(abi.PAGE_IS_PRESENT, 0, abi.PAGE_IS_PRESENT | others, abi.PAGE_IS_PRESENT)
        return not any(any(self._asked(question, batch, limit=1).counts[: len(batch)].tolist()) for batch in _batches(ranges))

    def _there(self, ranges: Words, unwanted: int, told: int = 0) -> Words:
        """Regions of pages that are present or swapped out, with the other categories that are asked for."""
        wanted = abi.PAGE_IS_PRESENT | abi.PAGE_IS_SWAPPED
        found = self._collect(Question(unwanted, unwanted, wanted, wanted | told), ranges)
        absent = found[:, 2] & np.uint64(abi.PAGE_IS_PRESENT) == 0
        if not absent.any():
            return found
        marker = absent & (found[:, 1] - found[:, 0] >= MARKER_RUN)
        if marker.any() and not procfs.swapped_size(self._pid):
            found = found[~marker]
        return found

    def guards(self, ranges: Words) -> Words:
        """Pages that MADV_GUARD_INSTALL has made guards; none on a kernel that cannot tell (before Linux 6.15).

        Costs 0.3 ms for 500 MB of 4 KiB pages.
        """
        if not self._guard:
            return NONE
        return pages_joined(self._collect(Question(0, self._guard, 0, self._guard), ranges)[:, :2])

    def _understands(self, category: int) -> bool:
        orders = self._asked(Question(0, category, 0, category), np.zeros((1, 2), dtype=np.uint64))
        return int(orders.counts[0]) >= 0

    def _collect(self, question: Question, ranges: Words, flags: int = 0, refused: list[list[int]] | None = None) -> Words:
        """Every region that the kernel tells of.

        Args:
            refused: takes the ranges that are not protected, instead of an error.
        """
        found: list[Words] = []
        for batch in _batches(ranges):
            orders, size = self._asked(question, batch, flags), len(batch)
            counts = orders.counts[:size].tolist()
            if min(counts) >= 0 and (orders.reached[:size] >= batch[:, 1]).all():
                told = [orders.regions[place, :count] for place, count in enumerate(counts) if count]
                if told:
                    found.append(np.concatenate(told))
            else:
                for place in range(size):
                    self._collect_one(orders, place, found, refused)
        if not found:
            return np.empty((0, 3), dtype=np.uint64)
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _collect_one(self, orders: _Orders, place: int, found: list[Words], refused: list[list[int]] | None) -> None:
        """Collect the pages found in one range of the batch, and ask for the rest of it."""
        while True:
            count, end = int(orders.counts[place]), int(orders.ends[place])
            if count < 0:
                self._refused("scan", -count)
                if refused is None:
                    raise MappingLostError(
                        f"cannot find written pages of pid {self._pid}: a mapping lost its protection; capture it again"
                    )
                refused.append([int(orders.starts[place]), end])
                return
            if count:
                found.append(orders.regions[place, :count].copy())
            if orders.reached[place] >= end:
                return
            orders.ask_further(place)

    def _refused(self, what: str, number: int) -> int:
        if number == errno.ESRCH:
            raise ProcessGoneError(f"cannot {what} pages of pid {self._pid}: it has ended, or has become another program")
        if number != errno.EPERM:
            raise CaptureError(f"cannot {what} pages of pid {self._pid}: {os.strerror(number)}; capture it again")
        return number


def _batches(ranges: Words) -> Iterable[Words]:
    """As many as are asked about in one go; a few ranges as they are, so that they are known again."""
    if len(ranges) <= BATCH:
        return (ranges,) if len(ranges) else ()
    return (ranges[first : first + BATCH] for first in range(0, len(ranges), BATCH))


def pages_joined(found: Words) -> Words:
    """Extents that touch or overlap, as one.

    They touch where categories differ, and overlap where the program changed its pages under a scan (seen with xz, Linux 6.18).

    Args:
        found: in order of their starts.
    """
    if len(found) < 2:
        return found
    ends = np.maximum.accumulate(found[:, 1])
    apart = found[1:, 0] > ends[:-1]
    if apart.all():
        return found
    return np.stack((found[np.concatenate(([True], apart)), 0], ends[np.concatenate((apart, [True]))]), axis=1)


# Without PAGEMAP_SCAN

_PRESENT: Final = np.uint64(1 << 63)
_SWAPPED: Final = np.uint64(1 << 62)
_FILE: Final = np.uint64(1 << 61)
_EXCLUSIVE: Final = np.uint64(1 << 56)
_FRAME: Final = np.uint64((1 << 55) - 1)
SOFT_DIRTY: Final = np.uint64(1 << 55)
PAGEMAP_CHUNK: Final = 1 << 16
"""Pages whose entries (8 bytes each) are read at once."""


@functools.cache
def zero_frame() -> int:
    """The frame of the page of zeros that is shared by all; 0 where the kernel does not tell us frames (CAP_SYS_ADMIN)."""
    with mmap.mmap(-1, abi.PAGE_SIZE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as page:
        assert page[0] == 0  # now it is there
        place = ctypes.c_char.from_buffer(page)
        address = ctypes.addressof(place)
        del place
        with open("/proc/self/pagemap", "rb", buffering=0) as file:
            return int.from_bytes(os.pread(file.fileno(), 8, address // abi.PAGE_SIZE * 8), "little") & int(_FRAME)


class PagemapFile:
    """/proc/PID/pagemap read as a file: slower, but every kernel has it."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._file = procfs.opened(pid, "pagemap")

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._file)

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """As `PageScanner.existing`; the shared page of zeros counts, too, where the kernel does not tell us which that is."""
        unwanted, zeros = _FILE if own else np.uint64(0), zero_frame()
        return self._select(
            ranges,
            lambda entries: (
                (entries & (_PRESENT | _SWAPPED) != 0)
                & (entries & unwanted == 0)
                & ((entries & _FRAME != zeros) | (entries & _PRESENT == 0) | (zeros == 0))
            ),
        )

    def guards(self, ranges: Words) -> Words:
        """None: a kernel that knows guards has PAGEMAP_SCAN, too."""
        return NONE

    def soft_dirty(self, ranges: Words) -> Words:
        """Pages whose soft-dirty bit is set, and those that may be the shared page of zeros.

        That comes without the bit to where the program has forgotten a page (MADV_DONTNEED) and read what is there now. A page
        that processes have in common since a fork looks the same to an ordinary user.
        """
        if zero_frame():
            return self._select(ranges, lambda entries: entries & SOFT_DIRTY != 0)
        told = _PRESENT | _FILE | _EXCLUSIVE
        return self._select(ranges, lambda entries: (entries & SOFT_DIRTY != 0) | (entries & told == _PRESENT))

    def _select(self, ranges: Words, is_chosen: Callable[[Words], NDArray[np.bool_]]) -> Words:
        found = []
        for start, end in ranges.tolist():
            for first in range(start // abi.PAGE_SIZE, end // abi.PAGE_SIZE, PAGEMAP_CHUNK):
                count = min(PAGEMAP_CHUNK, end // abi.PAGE_SIZE - first)
                entries = np.frombuffer(os.pread(self._file, count * 8, first * 8), dtype=np.uint64)
                if len(entries) != count:
                    raise ProcessGoneError(
                        f"cannot read the page tables of pid {self._pid}: it has ended, or became another program"
                    )
                chosen = np.flatnonzero(is_chosen(entries))
                found.append((chosen.astype(np.uint64) + np.uint64(first)) * np.uint64(abi.PAGE_SIZE))
        return page_set.extents_of_addresses(np.concatenate(found), abi.PAGE_SIZE) if found else NONE


class Existence(Protocol):
    """Tells which pages exist: `PageScanner` or `PagemapFile`."""

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """Pages present or swapped out, but guards."""
        ...

    def guards(self, ranges: Words) -> Words:
        """Pages that MADV_GUARD_INSTALL has made guards."""
        ...

    def close(self) -> None:
        """Give descriptors back."""
        ...


def existence(pid: int) -> Existence:
    """The best way that this kernel has."""
    scanner = PageScanner(pid)
    try:
        scanner.existing(NONE + np.uint64(0))
        scanner.is_protected(0, abi.PAGE_SIZE)
    except CaptureError:
        scanner.close()
        return PagemapFile(pid)
    return scanner
