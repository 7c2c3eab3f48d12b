"""Which pages of a process were written since the last look: one contract, three ways, probed by feature.

* `PagemapTracker`: userfaultfd write protection in asynchronous mode and PAGEMAP_SCAN. Costs next to nothing.
* `SoftDirtyTracker`: the soft-dirty bit, where the kernel has it.
* `DigestTracker`: every page is read and compared by digest. Needs nothing, costs a pass over the memory.

All speak of *private* mappings. Shared ones can be written by others behind the page tables' back: `SharedPages` compares those.

Source: Documentation/admin-guide/mm/pagemap.rst, soft-dirty.rst, userfaultfd.rst.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from checkpoint import pages
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi, procfs
from checkpoint.linux.memory import Memory
from checkpoint.linux.procfs import MapsLine
from checkpoint.pages import PageMap, Words

NONE: Final[Words] = np.empty((0, 2), dtype=np.uint64)
REGION_COUNT: Final = 1 << 15
"""Regions that one scan call may answer with; more are asked for in the next call."""
WHOLE_WINDOW: Final = 64 << 20
"""A mapping up to this size is protected whole: its page tables (two thousandths) are cheaper than finding what is populated."""
WINDOW: Final = 2 << 20
"""Larger ones are protected in windows of what one page table covers."""
LONG_RUN: Final = 16 * abi.PAGE_SIZE
"""A written run longer than this is looked at for holes before it is read: reading a hole makes the kernel fill it."""
MARKER_RUN: Final = 64 * abi.PAGE_SIZE
"""Where nothing is swapped out, what looks so is a hole that we protected, or a page that the kernel moves just now: it moves 32
at a time (COMPACT_CLUSTER_MAX), so a longer run is a hole."""
READ_CHUNK: Final = 8 << 20
NOT_CARRIED: Final = frozenset(("[vdso]", "[vvar]", "[vvar_vclock]", "[vsyscall]", "[uprobes]"))
"""Mappings of the kernel's own: made anew on restore."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What happened since the last scan.

    Attributes:
        written: pages to be read: written, or of unknown history.
        cleared: pages whose earlier content is forgotten; ``written`` comes on top.
    """

    written: Words
    cleared: Words


class MappingLostError(CaptureError):
    """A mapping is not write-protected any more."""


class Tracker(Protocol):
    """Finds written pages."""

    name: str

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """Begin to follow: whatever is written from now on is in the next scan. The process may run."""
        ...

    def scan(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """Find what was written since `arm` or the last scan, and begin anew. The process stands still.

        Args:
            lines: every private mapping that is followed, in address order.
            changed: whether the lines differ from those of the last call.
        """
        ...

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """Pages that hold something of the process's own: neither holes nor a file's unchanged pages."""
        ...

    def close(self) -> None:
        """Stop following; the process is not changed."""
        ...


def is_private(line: MapsLine) -> bool:
    """Whether a mapping is one that trackers follow."""
    return not line.shared and line.name not in NOT_CARRIED


def is_shared(line: MapsLine) -> bool:
    """Whether its pages are shared memory that the snapshot carries: not those of a file that it may only read here.

    Such a mapping (glibc's gconv-modules.cache is one in many programs) has nothing that its file does not have, and the
    one that restores could not write to it.
    """
    from_its_file = line.has_file and not line.protection & abi.PROT_WRITE and not line.name.endswith(procfs.DELETED)
    return line.shared and line.name not in NOT_CARRIED and not from_its_file


def extents_of(lines: Sequence[MapsLine]) -> Words:
    """The set of pages that mappings cover."""
    if not lines:
        return NONE
    array = np.array([(line.start, line.end) for line in lines], dtype=np.uint64)
    first = np.concatenate(([True], array[1:, 0] != array[:-1, 1]))
    last = np.concatenate((first[1:], [True]))
    return np.stack((array[first, 0], array[last, 1]), axis=1)


class PageScanner:
    """PAGEMAP_SCAN on one process's pagemap.

    Raises:
        ProcessGoneError: it ended, or it became another program (exec).
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._pagemap = os.open(f"/proc/{pid}/pagemap", os.O_RDONLY | os.O_CLOEXEC)
        self._regions = np.zeros((REGION_COUNT, 3), dtype=np.uint64)
        self._order = abi.PageScan(size=ctypes.sizeof(abi.PageScan), vec=self._regions.ctypes.data, vec_len=REGION_COUNT)

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
        """
        order = self._order
        order.flags = abi.PM_SCAN_CHECK_WPASYNC | abi.PM_SCAN_WP_MATCHING
        order.category_mask, order.category_inverted, order.category_anyof_mask = abi.PAGE_IS_WRITTEN, 0, 0
        order.return_mask = abi.PAGE_IS_WRITTEN
        return self._collect(ranges)[:, :2]

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """Pages present or swapped out.

        Args:
            own: leave out unchanged pages of files and the shared page of zeros.
        """
        order = self._order
        unwanted = abi.PAGE_IS_FILE | abi.PAGE_IS_PFNZERO if own else abi.PAGE_IS_PFNZERO
        order.flags = 0
        order.category_mask = order.category_inverted = unwanted
        order.category_anyof_mask = abi.PAGE_IS_PRESENT | abi.PAGE_IS_SWAPPED
        order.return_mask = abi.PAGE_IS_PRESENT | abi.PAGE_IS_SWAPPED
        found = self._collect(ranges)
        absent = found[:, 2] & np.uint64(abi.PAGE_IS_PRESENT) == 0
        if absent.any() and not procfs.swapped_size(self._pid):
            found = found[~(absent & (found[:, 1] - found[:, 0] >= MARKER_RUN))]
        return pages_joined(found[:, :2])

    def _collect(self, ranges: Words) -> Words:
        order, found = self._order, []
        for start, end in ranges.tolist():
            order.end = end
            while start < end:
                order.start = start
                count = abi.ioctl(self._pagemap, abi.PAGEMAP_SCAN, ctypes.addressof(order))
                if count < 0:
                    self._refused("scan")
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


# Write protection


def windows_of(line: MapsLine, existing: Words) -> Words:
    """The parts of a mapping that are worth protecting: all of a small one, the surroundings of what exists in a large one."""
    if line.size <= WHOLE_WINDOW:
        return np.array([[line.start, line.end]], dtype=np.uint64)
    step = np.uint64(WINDOW)
    low = np.maximum(existing[:, 0] // step * step, np.uint64(line.start))
    high = np.minimum((existing[:, 1] + step - np.uint64(1)) // step * step, np.uint64(line.end))
    if not len(low):
        return NONE
    apart = low[1:] > np.maximum.accumulate(high)[:-1] + np.uint64(WINDOW)
    return np.stack((low[np.concatenate(([True], apart))], high[np.concatenate((apart, [True]))]), axis=1)


class PagemapTracker:
    """Asynchronous write protection, and one scan that finds and protects again.

    Invariants: every page that exists in a followed mapping lies in ``_armed`` or is found by looking at the rest; a mapping
    without registration is fresh, whatever maps says, and is copied whole; one that cannot be registered is fresh each time.

    Args:
        faults: a userfaultfd of the process's memory; the tracker owns it.
    """

    name = "pagemap"

    def __init__(self, pid: int, faults: int) -> None:
        self._faults = faults
        self._scanner = PageScanner(pid)
        self._armed: Words = NONE
        self._tracked: Words = NONE
        self._spans: list[tuple[int, int]] = []
        self._open: Words = NONE
        self._protect: Words = NONE
        self._files: Words = NONE
        self._owned: Words = NONE
        self._stubborn: set[tuple[int, int]] = set()
        enable_write_protection(faults)

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`. A mapping that goes or comes meanwhile is found fresh by the scan."""
        self._stubborn.clear()
        for line in lines:
            self._register(line)
        existing = self._scanner.existing(extents_of(lines))
        with contextlib.suppress(MappingLostError):
            self._protect_windows(lines, existing)
        self._learn(lines)
        self._owned = pages.intersection(self._scanner.existing(self._files), self._files)

    def scan(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.scan`."""
        if changed:
            self._learn(lines)
        fresh = [
            line
            for start, end in self._spans
            if not self._scanner.is_protected(start, end)
            for line in self._lost(lines, start, end)
        ]
        cleared, copied = extents_of(fresh), NONE
        if fresh:
            self._armed = pages.difference(self._armed, cleared)
            copied = self._fresh(fresh)
            self._learn(lines)
            written = self._scanner.written(pages.difference(self._protect, cleared))
        else:
            written = self._scanner.written(self._protect)
        if len(self._open):
            appeared = self._scanner.existing(self._open)
            if len(appeared):
                copied = pages.union(copied, appeared)
                self._protect_windows(lines, appeared)
                self._learn(lines)
        written, emptied = self._sift(written)
        if len(copied):
            written = pages.union(written, copied)
        if len(given_back := self._given_back(written)):
            emptied = pages.union(emptied, given_back)
        if len(emptied):
            cleared = pages.union(cleared, emptied)
        return Scan(written, cleared)

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """See `Tracker.existing`."""
        return self._scanner.existing(extents_of(lines))

    def close(self) -> None:
        """See `Tracker.close`."""
        self._scanner.close()
        os.close(self._faults)

    def _learn(self, lines: Sequence[MapsLine]) -> None:
        """Work out what a scan has to ask for these mappings."""
        followed = [line for line in lines if (line.start, line.end) not in self._stubborn]
        self._tracked = extents_of(followed)
        self._armed = pages.intersection(self._armed, self._tracked)
        self._open = pages.difference(self._tracked, self._armed)
        self._protect = self._armed
        self._files = extents_of([line for line in followed if line.has_file])
        self._spans = [(int(start), int(end)) for start, end in extents_of(lines).tolist()]

    def _lost(self, lines: Sequence[MapsLine], start: int, end: int) -> list[MapsLine]:
        inside = (line for line in lines if start <= line.start and line.end <= end)
        return [line for line in inside if not self._scanner.is_protected(line.start, line.end)]

    def _fresh(self, lines: Sequence[MapsLine]) -> Words:
        """Register mappings and protect them: what exists in them."""
        for line in lines:
            if not self._register(line):
                self._stubborn.add((line.start, line.end))
        existing = self._scanner.existing(extents_of(lines))
        self._protect_windows([line for line in lines if (line.start, line.end) not in self._stubborn], existing)
        return existing

    def _protect_windows(self, lines: Sequence[MapsLine], existing: Words) -> None:
        parts = [
            windows_of(line, _inside(existing, line))
            for line in lines
            if line.size <= WHOLE_WINDOW or len(_inside(existing, line))
        ]
        if parts:
            windows = pages_joined(np.concatenate(parts))
            self._armed = pages.union(self._armed, windows)
            self._scanner.written(windows)

    def _register(self, line: MapsLine) -> bool:
        """Register a mapping, and forget what an earlier registration has marked; whether the kernel agreed.

        A registration that mremap(2) has ended leaves its marks in the page tables (userfaultfd_reset_ctx() in
        fs/userfaultfd.c drops the mapping's, not the pages'). A page written afterwards keeps its mark and is writable: it
        would count as unwritten for ever.
        """
        order = abi.UffdRegister(line.start, line.size, abi.UFFDIO_REGISTER_MODE_WP, 0)
        if abi.ioctl(self._faults, abi.UFFDIO_REGISTER, ctypes.addressof(order)) != 0:
            return False
        unmark = abi.UffdWriteProtect(line.start, line.size, 0)
        return int(abi.ioctl(self._faults, abi.UFFDIO_WRITEPROTECT, ctypes.addressof(unmark))) == 0

    def _given_back(self, written: Words) -> Words:
        """Private copies of a file's pages that the program has dropped (MADV_DONTNEED): the file shows again.

        The kernel leaves such a page protected (zap_install_uffd_wp_if_needed() in mm/memory.c), so that no scan tells.
        """
        if not len(self._files):
            return NONE
        now = self._scanner.existing(self._owned)
        gone = pages.difference(self._owned, now)
        came = written[touching(written, self._files)]
        if len(came) or len(gone):
            self._owned = pages.union(now, pages.intersection(came, self._files))
        return gone

    def _sift(self, written: Words) -> tuple[Words, Words]:
        """Tell pages that hold something from holes and from a file's own: (to read, to clear)."""
        if not len(written):
            return NONE, NONE
        is_doubtful = (written[:, 1] - written[:, 0]) > LONG_RUN
        if len(self._files):
            is_doubtful |= touching(written, self._files)
        doubtful = written[is_doubtful]
        if not len(doubtful):
            return written, NONE
        real = self._scanner.existing(doubtful)
        empty = pages.difference(doubtful, real)
        return pages.difference(written, empty), empty


def touching(extents: Words, others: Words) -> pages.Flags:
    """For each extent whether it shares a page with the other set."""
    first = np.searchsorted(others[:, 1], extents[:, 0], side="right")
    begin = others[np.minimum(first, len(others) - 1), 0]
    touch: pages.Flags = (first < len(others)) & (begin < extents[:, 1])
    return touch


def _inside(existing: Words, line: MapsLine) -> Words:
    first = np.searchsorted(existing[:, 1], np.uint64(line.start), side="right")
    last = np.searchsorted(existing[:, 0], np.uint64(line.end), side="left")
    return existing[first:last]


def enable_write_protection(faults: int) -> None:
    """Agree with the kernel on asynchronous write protection, also of pages that do not exist yet.

    Raises:
        OSError: this kernel has no such mode (before 6.7).
    """
    features = abi.UFFD_FEATURE_WP_UNPOPULATED | abi.UFFD_FEATURE_WP_ASYNC
    order = abi.UffdApi(abi.UFFD_API, features, 0)
    if abi.ioctl(faults, abi.UFFDIO_API, ctypes.addressof(order)) != 0:
        abi.raise_errno("UFFDIO_API with asynchronous write protection")


# Page tables without PAGEMAP_SCAN

_PRESENT: Final = np.uint64(1 << 63)
_SWAPPED: Final = np.uint64(1 << 62)
_FILE: Final = np.uint64(1 << 61)
_SOFT_DIRTY: Final = np.uint64(1 << 55)
PAGEMAP_CHUNK: Final = 1 << 16
"""Pages whose entries (8 bytes each) are read at once."""


class PagemapFile:
    """/proc/PID/pagemap read as a file: slower, but every kernel has it."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._file = os.open(f"/proc/{pid}/pagemap", os.O_RDONLY | os.O_CLOEXEC)

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._file)

    def existing(self, ranges: Words, *, own: bool = True) -> Words:
        """As `PageScanner.existing`; the shared page of zeros counts, too."""
        unwanted = _FILE if own else np.uint64(0)
        return self._select(ranges, _PRESENT | _SWAPPED, unwanted)

    def soft_dirty(self, ranges: Words) -> Words:
        """Pages whose soft-dirty bit is set."""
        return self._select(ranges, _SOFT_DIRTY, np.uint64(0))

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
        """Pages present or swapped out."""
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


# Page digests


class DigestTracker:
    """Reads everything that exists and compares digests. Needs nothing of the kernel."""

    name = "digest"

    def __init__(self, pid: int) -> None:
        self._memory = Memory(pid)
        self._existence = existence(pid)
        self._known = PageMap.empty()

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`: nothing is known, so that the first scan finds everything."""
        self._known = PageMap.empty()

    def scan(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.scan`."""
        existing = self.existing(lines)
        addresses = pages.addresses_of(existing, abi.PAGE_SIZE)
        digests = digests_of(self._memory, existing)
        before, self._known = self._known, PageMap(addresses, digests)
        return compared(before, self._known)

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """See `Tracker.existing`."""
        return self._existence.existing(extents_of(lines))

    def close(self) -> None:
        """See `Tracker.close`."""
        self._existence.close()


def compared(before: PageMap, now: PageMap) -> Scan:
    """Pages that are new or changed, and pages that went."""
    places = np.minimum(np.searchsorted(before.addresses, now.addresses), max(len(before.addresses) - 1, 0))
    if len(before.addresses):
        same = (before.addresses[places] == now.addresses) & (before.words[places] == now.words).all(axis=1)
    else:
        same = np.zeros(len(now.addresses), dtype=np.bool_)
    gone = before.addresses[~np.isin(before.addresses, now.addresses, assume_unique=True)]
    return Scan(pages.extents_of_addresses(now.addresses[~same], abi.PAGE_SIZE), pages.extents_of_addresses(gone, abi.PAGE_SIZE))


def digests_of(memory: Memory, existing: Words) -> Words:
    """The digest of each page, read in chunks."""
    found = []
    for chunk in chunks_of(existing):
        content = memory.read_pages(chunk)
        found.append(pages.digest_pages(content, pages.addresses_of(chunk, abi.PAGE_SIZE), abi.PAGE_SIZE))
    return np.concatenate(found) if found else NONE


def chunks_of(ranges: Words, size: int = READ_CHUNK) -> list[Words]:
    """The same set in parts of at most ``size`` bytes."""
    parts: list[list[tuple[int, int]]] = [[]]
    room = size
    for start, end in ranges.tolist():
        while start < end:
            step = min(room, end - start)
            parts[-1].append((start, start + step))
            start, room = start + step, room - step
            if not room:
                parts.append([])
                room = size
    return [np.array(part, dtype=np.uint64) for part in parts if part]


# The soft-dirty bit


class SoftDirtyTracker:
    """The soft-dirty bit: cleared for the whole process, set by the kernel with the first write and in every new mapping."""

    name = "soft-dirty"

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._pagemap = PagemapFile(pid)
        self._existed: Words = NONE

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`."""
        self._clear()
        self._existed = self.existing(lines)

    def scan(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.scan`."""
        existing = self.existing(lines)
        dirty = self._pagemap.soft_dirty(extents_of(lines))
        gone = pages.difference(self._existed, existing)
        fresh = pages.difference(existing, self._existed)
        self._existed = existing
        self._clear()
        return Scan(pages.union(pages.intersection(dirty, existing), fresh), gone)

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """See `Tracker.existing`."""
        return self._pagemap.existing(extents_of(lines))

    def close(self) -> None:
        """See `Tracker.close`."""
        self._pagemap.close()

    def _clear(self) -> None:
        try:
            descriptor = os.open(f"/proc/{self._pid}/clear_refs", os.O_WRONLY | os.O_CLOEXEC)
        except FileNotFoundError as error:
            raise ProcessGoneError(f"cannot reset the soft-dirty bits of pid {self._pid}: it has ended") from error
        try:
            os.write(descriptor, b"4")
        finally:
            os.close(descriptor)


def best_tracking() -> str:
    """How written pages are found on this machine: "pagemap", "soft-dirty" or "digest"."""
    found = existence(os.getpid())
    found.close()
    if isinstance(found, PageScanner):
        return PagemapTracker.name
    return SoftDirtyTracker.name if has_soft_dirty() else DigestTracker.name


def has_soft_dirty() -> bool:
    """Whether this kernel sets the bit: a page that we have just written must have it."""
    probe = bytearray(abi.PAGE_SIZE * 2)
    address = ctypes.addressof(ctypes.c_char.from_buffer(probe))
    with open("/proc/self/pagemap", "rb", buffering=0) as pagemap:
        pagemap.seek(address // abi.PAGE_SIZE * 8)
        (entry,) = struct.unpack("<Q", pagemap.read(8))
    return bool(entry & int(_SOFT_DIRTY))


# Shared mappings


class SharedPages:
    """Shared mappings, compared by page digest at every scan: others may write them behind our page tables."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._memory = Memory(pid)
        self._existence = existence(pid)
        self._known = PageMap.empty()

    def scan(self, lines: Sequence[MapsLine]) -> Scan:
        """Find what changed since the last scan; everything is new to the first."""
        if not lines and not len(self._known.addresses):
            return Scan(NONE, NONE)
        existing = self.existing(lines)
        before = self._known
        self._known = PageMap(pages.addresses_of(existing, abi.PAGE_SIZE), digests_of(self._memory, existing))
        return compared(before, self._known)

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """Populated pages of these mappings."""
        return self._existence.existing(extents_of(lines), own=False)

    def forget(self) -> None:
        """Let the next scan find everything."""
        self._known = PageMap.empty()

    def close(self) -> None:
        """Give descriptors back."""
        self._existence.close()
