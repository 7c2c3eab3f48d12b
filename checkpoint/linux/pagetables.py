"""Which pages of a process exist, and which were written: /proc/PID/pagemap, by PAGEMAP_SCAN or read as a file.

Source: Documentation/admin-guide/mm/pagemap.rst.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Callable
from typing import Final, Protocol

import numpy as np

from checkpoint import pages
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi, procfs
from checkpoint.linux.tracking import NONE
from checkpoint.pages import Words

REGION_COUNT: Final = 1 << 15
"""Regions that one scan call may answer with; more are asked for in the next call."""
MARKER_RUN: Final = 64 * abi.PAGE_SIZE
"""Where nothing is swapped out, what looks so is a hole that we protected, or a page that the kernel moves just now: it moves 32
at a time (COMPACT_CLUSTER_MAX), so a longer run is a hole."""


class MappingLostError(CaptureError):
    """A mapping is not write-protected any more."""


class PageScanner:
    """PAGEMAP_SCAN on one process's pagemap.

    Args:
        ioctl: makes the call; ``abi.ioctl_held`` keeps the interpreter meanwhile.

    Raises:
        ProcessGoneError: it ended, or it became another program (exec).
        ProbeError: not permitted: it ended just now, or became another user's.
    """

    def __init__(self, pid: int, ioctl: Callable[[int, int, int], int] = abi.ioctl) -> None:
        self._pid = pid
        self._ioctl = ioctl
        self._pagemap = procfs.opened(pid, "pagemap")
        self._regions = np.zeros((REGION_COUNT, 3), dtype=np.uint64)
        self._order = abi.PageScan(size=ctypes.sizeof(abi.PageScan), vec=self._regions.ctypes.data, vec_len=REGION_COUNT)
        self._guard = abi.PAGE_IS_GUARD if self._understands(abi.PAGE_IS_GUARD) else 0

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._pagemap)

    def is_protected(self, start: int, end: int) -> bool:
        """Whether every mapping in a range is registered for asynchronous write protection."""
        order = self._order
        order.flags, order.start, order.end = abi.PM_SCAN_CHECK_WPASYNC, start, end
        order.category_mask = order.category_inverted = abi.PAGE_IS_WPALLOWED
        order.category_anyof_mask, order.return_mask = 0, abi.PAGE_IS_WPALLOWED
        if abi.ioctl(self._pagemap, abi.PAGEMAP_SCAN, ctypes.addressof(order)) >= 0:
            return True
        return self._refused("check") != errno.EPERM

    def written(self, ranges: Words) -> Words:
        """Pages written since they were last protected, and holes that never were; all are protected again.

        With exactly this mask the kernel takes its fast path.

        Raises:
            MappingLostError: a mapping is not protected (any more); what was found until then is lost.
        """
        self._ask_for_written(abi.PM_SCAN_CHECK_WPASYNC | abi.PM_SCAN_WP_MATCHING)
        return pages_joined(self._collect(ranges)[:, :2])

    def written_where_protected(self, ranges: Words) -> tuple[Words, Words]:
        """As `written`, of a process that runs and may unmap anything under our hands.

        Returns:
            What was written, and the ranges in which a mapping was not protected (any more): a part of such a range may have been
            protected again without being told.
        """
        self._ask_for_written(abi.PM_SCAN_CHECK_WPASYNC | abi.PM_SCAN_WP_MATCHING)
        refused: list[list[int]] = []
        found = pages_joined(self._collect(ranges, refused)[:, :2])
        return found, pages_joined(np.array(refused, dtype=np.uint64).reshape(-1, 2))

    def written_count(self, ranges: Words, limit: int) -> int:
        """How many pages `written` would find, counted no further than ``limit``; nothing is protected."""
        self._ask_for_written(0)
        count = 0
        try:
            for start, end in ranges.tolist():
                count += self._counted(start, end, limit - count)
                if count >= limit:
                    break
        finally:
            self._order.max_pages = 0
        return count

    def _counted(self, start: int, end: int, limit: int) -> int:
        order = self._order
        order.start, order.end, order.max_pages = start, end, limit
        regions = abi.ioctl(self._pagemap, abi.PAGEMAP_SCAN, ctypes.addressof(order))
        if regions < 0:
            self._refused("count written")
        return pages.total_size(self._regions[: max(regions, 0), :2]) // abi.PAGE_SIZE

    def _ask_for_written(self, flags: int) -> None:
        order = self._order
        order.flags, order.return_mask = flags, abi.PAGE_IS_WRITTEN
        order.category_mask, order.category_inverted, order.category_anyof_mask = abi.PAGE_IS_WRITTEN, 0, 0

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """Pages present or swapped out, but guards, which look as if they were swapped out.

        Args:
            own: leave out unchanged pages of files and the shared page of zeros.
        """
        order = self._order
        unwanted = (abi.PAGE_IS_FILE | abi.PAGE_IS_PFNZERO if own else abi.PAGE_IS_PFNZERO) | self._guard
        order.flags = 0
        order.category_mask = order.category_inverted = unwanted
        order.category_anyof_mask = abi.PAGE_IS_PRESENT | abi.PAGE_IS_SWAPPED
        order.return_mask = abi.PAGE_IS_PRESENT | abi.PAGE_IS_SWAPPED
        found = self._collect(ranges)
        absent = found[:, 2] & np.uint64(abi.PAGE_IS_PRESENT) == 0
        if absent.any() and not procfs.swapped_size(self._pid):
            found = found[~(absent & (found[:, 1] - found[:, 0] >= MARKER_RUN))]
        return pages_joined(found[:, :2])

    def guards(self, ranges: Words) -> Words:
        """Pages that MADV_GUARD_INSTALL has made guards; none on a kernel that cannot tell (before Linux 6.15).

        Costs 0.3 ms for 500 MB of 4 KiB pages.
        """
        if not self._guard:
            return NONE
        order = self._order
        order.flags, order.category_mask, order.category_inverted, order.category_anyof_mask = 0, self._guard, 0, 0
        order.return_mask = self._guard
        return pages_joined(self._collect(ranges)[:, :2])

    def _understands(self, category: int) -> bool:
        order = self._order
        order.flags = order.start = order.end = order.category_inverted = order.category_anyof_mask = 0
        order.category_mask = order.return_mask = category
        return int(abi.ioctl(self._pagemap, abi.PAGEMAP_SCAN, ctypes.addressof(order))) >= 0

    def _collect(self, ranges: Words, refused: list[list[int]] | None = None) -> Words:
        """Every region that the kernel tells of.

        Args:
            refused: takes the ranges that are not protected, instead of an error.
        """
        order, found = self._order, []
        place = ctypes.addressof(order)
        for start, end in ranges.tolist():
            order.end = end
            while start < end:
                order.start = start
                count = self._ioctl(self._pagemap, abi.PAGEMAP_SCAN, place)
                if count < 0:
                    self._refused("scan")
                    if refused is not None:
                        refused.append([start, end])
                        break
                    raise MappingLostError(
                        f"cannot find written pages of pid {self._pid}: a mapping lost its protection; capture it again"
                    )
                if count:
                    found.append(self._regions[:count].copy())
                start = int(order.walk_end)
        if not found:
            return np.empty((0, 3), dtype=np.uint64)
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _refused(self, what: str) -> int:
        number = ctypes.get_errno()
        if number == errno.ESRCH:
            raise ProcessGoneError(f"cannot {what} pages of pid {self._pid}: it has ended, or has become another program")
        if number != errno.EPERM:
            raise CaptureError(f"cannot {what} pages of pid {self._pid}: {os.strerror(number)}; capture it again")
        return number


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
    return np.stack((found[np.concatenate(([True], apart)), 0], ends[np.concatenate((apart, [True]))]), axis=1)


# Without PAGEMAP_SCAN

_PRESENT: Final = np.uint64(1 << 63)
_SWAPPED: Final = np.uint64(1 << 62)
_FILE: Final = np.uint64(1 << 61)
SOFT_DIRTY: Final = np.uint64(1 << 55)
PAGEMAP_CHUNK: Final = 1 << 16
"""Pages whose entries (8 bytes each) are read at once."""


class PagemapFile:
    """/proc/PID/pagemap read as a file: slower, but every kernel has it."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._file = procfs.opened(pid, "pagemap")

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._file)

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """As `PageScanner.existing`; the shared page of zeros counts, too."""
        unwanted = _FILE if own else np.uint64(0)
        return self._select(ranges, _PRESENT | _SWAPPED, unwanted)

    def guards(self, ranges: Words) -> Words:
        """None: a kernel that knows guards has PAGEMAP_SCAN, too."""
        return NONE

    def soft_dirty(self, ranges: Words) -> Words:
        """Pages whose soft-dirty bit is set."""
        return self._select(ranges, SOFT_DIRTY, np.uint64(0))

    def _select(self, ranges: Words, anyof: np.uint64, unwanted: np.uint64) -> Words:
        found = []
        for start, end in ranges.tolist():
            for first in range(start // abi.PAGE_SIZE, end // abi.PAGE_SIZE, PAGEMAP_CHUNK):
                count = min(PAGEMAP_CHUNK, end // abi.PAGE_SIZE - first)
                entries = np.frombuffer(os.pread(self._file, count * 8, first * 8), dtype=np.uint64)
                if len(entries) != count:
                    raise ProcessGoneError(
                        f"cannot read the page tables of pid {self._pid}: it has ended, or became another program"
                    )
                chosen = np.flatnonzero((entries & anyof != 0) & (entries & unwanted == 0))
                found.append((chosen.astype(np.uint64) + np.uint64(first)) * np.uint64(abi.PAGE_SIZE))
        return pages.extents_of_addresses(np.concatenate(found), abi.PAGE_SIZE) if found else NONE


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
