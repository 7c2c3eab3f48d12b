"""Find written pages by asynchronous write protection (userfaultfd) and one scan that finds and protects again. Very cheap.

Source: Documentation/admin-guide/mm/userfaultfd.rst, pagemap.rst.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from typing import Final

import numpy as np

from checkpoint.linux import abi
from checkpoint.linux.memory.pagemap import PageScanner, pages_joined
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import NONE, Scan, extents_of
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.runtime.identity_memo import Memo

WHOLE_WINDOW: Final = 4 << 20
"""A mapping up to this size is protected whole: its page tables (two thousandths) are cheaper than finding what is populated.

A larger one, such as a thread's stack of 8 MiB, is mostly empty, and a hole that is protected takes a scan as long as a page.
"""
WHOLE_FILE: Final = 64 << 20
"""The same for the mapping of a file: to find which of its pages are copies takes longer than to scan them all."""
WINDOW: Final = 2 << 20
"""Larger ones are protected in windows of what one page table covers."""
LONG_RUN: Final = 16 * abi.PAGE_SIZE
"""A written run longer than this is looked at for holes before it is read: reading a hole makes the kernel fill it."""

NOWHERE: Final = 1 << 20
"""An address below all that programs have. A mapping there would be registered, which it is in any case."""
SETBACK_MAX: Final = 64
"""After a scan that left something out at most so many look everywhere; one that does costs less than another freeze."""
REHEARSED_SIZE: Final = 1 << 30
"""Memory whose page tables (a five-hundredth of it) a processor still has at hand when they are looked at again."""
SMALL_GAP: Final = 64 * abi.PAGE_SIZE
"""Extents that are no farther apart are looked at together."""


def is_small(line: MapsLine) -> bool:
    """Whether a mapping is protected whole."""
    return line.size <= (WHOLE_FILE if line.has_file else WHOLE_WINDOW)


def is_closed(line: MapsLine) -> bool:
    """Whether a file's mapping has no permission at all, as the gap between two parts of a library: no page comes there.

    Protection of its holes would mark them, and a marked hole looks like a page that is swapped out. Most of these holes
    lie behind the end of their file, where they cannot be read either. A library has 16 to 31 of them on aarch64.
    """
    return line.has_file and not line.protection


def windows_of(line: MapsLine, existing: Words) -> Words:
    """The parts of a mapping that are worth protecting: all of a small one, the surroundings of what exists in a large one."""
    if is_small(line):
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

    Invariants: every page that exists in a followed mapping lies in ``_armed`` or is found by looking at the rest, but for
    mappings that are `is_closed` and in which nothing existed; a mapping without registration is fresh, also if maps shows
    it as before, and is copied whole; one that cannot be registered is fresh each time.

    Private copies of a file's pages that the program has dropped (MADV_DONTNEED) are looked for by name, for the file shows
    again: the kernel leaves such a page protected (zap_install_uffd_wp_if_needed() in mm/memory.c), so that no scan tells. To
    look for all of them (``_owned``) takes a tenth of a freeze, and next to none is ever dropped. So while the process stands
    still only those are looked for that it writes again and again (``_restless``, with what belongs to the same extents), and the
    others afterwards (`confirm`).

    Args:
        faults: a userfaultfd of the process's memory; the tracker owns it, once it is made.
    """

    name = "pagemap"
    cost = "a fault for each page that it writes, once between two captures"
    sees_every_write = True
    scans_running = True

    def __init__(self, pid: int, faults: int) -> None:
        enable_write_protection(faults)
        self._faults = faults
        self._memory = Memory(pid)
        self._scanner = PageScanner(pid)
        self._armed: Words = NONE
        self._tracked: Words = NONE
        self._spans: Words = NONE
        self._open: Words = NONE
        self._doubtful: Words = NONE
        self._files: Words = NONE
        self._owned: Words = NONE
        self._around: tuple[tuple[bytes, Words], tuple[bytes, Words]] = ((b"", NONE), (b"", NONE))
        self._parts = Memo[Words]()
        self._stubborn: set[tuple[int, int]] = set()
        self._restless: Words = NONE
        self._looked_for: tuple[Words, Words] | None = None
        self._unrest: Words = NONE
        self._wary = 0
        self._setback = 1

    @property
    def watched(self) -> Words:
        """See `Tracker.watched`."""
        return self._armed

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`. A mapping that goes or comes meanwhile is found fresh by the scan."""
        self._stubborn.clear()
        self._armed = self._doubtful = NONE
        for line in lines:
            self._register(line)
        self._protect_windows(lines, self._scanner.existing(extents_of(lines)))
        self._learn(lines)
        self._owned = page_set.intersection(self._scanner.existing(self._files), self._files)
        self._let_writers_finish()

    def scan(self, lines: Sequence[MapsLine], *, changed: bool, everywhere: bool = False) -> Scan:
        """See `Tracker.scan`."""
        everywhere = everywhere or self._wary > 0
        self._wary = max(self._wary - 1, 0)
        return self._found(lines, changed=changed, is_running=False, everywhere=everywhere)

    def rehearse(self) -> None:
        """See `Tracker.rehearse`."""
        self._scanner.unprotected(self._spans)
        if page_set.total_size(self._armed) <= REHEARSED_SIZE:
            self._scanner.rehearse(self._armed, self._restless)

    def confirm(self) -> bool:
        """See `Tracker.confirm`.

        A private copy that is there, and was not written since the scan, was there then. One that has gone may have gone before;
        one that was written may have come back.
        """
        if len(self._unrest):
            self._restless, self._unrest = page_set.union(self._restless, self._unrest), NONE
        if self._looked_for is None:
            return True
        owned = page_set.difference(page_set.intersection(self._owned, self._armed), page_set.union(*self._looked_for))
        found = self._scanner.private(surroundings_of(owned))
        written = page_set.intersection(found.written, owned)
        if page_set.covers(found.present, owned) and not len(written):
            self._setback = max(self._setback - 1, 1)
            return True
        self._restless = page_set.union(self._restless, written)
        self._wary, self._setback = self._setback, min(2 * self._setback, SETBACK_MAX)
        return False

    def catch_up(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.catch_up`.

        1. We renew the protection before we look which pages exist: one that comes or is written later is in the next scan.
        2. A mapping that goes, or is put in the place of another one, loses its registration: the next scan finds it fresh.
        3. One that does so in the middle of the scan makes the kernel break off, and pages before it may have been protected
           without being told: they are ``_doubtful``, and the next scan finds them, written or not.
        """
        scan = self._found(lines, changed=changed, is_running=True)
        self._let_writers_finish()
        return scan

    def _let_writers_finish(self) -> None:
        """Wait until what the kernel is writing for the process has landed, for it may have looked at the protection before us.

        access_remote_vm() in mm/memory.c, behind /proc/self/mem, makes a page writable and copies to it afterwards, past the page
        tables, and holds the lock of the mappings meanwhile. userfaultfd_register() takes that lock alone, also for a place where
        nothing is mapped, before it says so.
        """
        nowhere = abi.UffdRegister(NOWHERE, abi.PAGE_SIZE, abi.UFFDIO_REGISTER_MODE_WP, 0)
        abi.ioctl(self._faults, abi.UFFDIO_REGISTER, ctypes.addressof(nowhere))

    def backlog(self, lines: Sequence[MapsLine], limit: int, *, changed: bool) -> int:
        """See `Tracker.backlog`."""
        if changed:
            self._learn(lines)
        count = self._scanner.written_count(self._armed, limit)
        if count < limit and len(self._open):
            count += page_set.total_size(self._scanner.existing(self._open)) // abi.PAGE_SIZE
        return min(count, limit)

    def _found(self, lines: Sequence[MapsLine], *, changed: bool, is_running: bool, everywhere: bool = True) -> Scan:
        if changed:
            self._learn(lines)
        fresh = [line for start, end in self._scanner.unprotected(self._spans) for line in self._lost(lines, start, end)]
        cleared, copied = extents_of(fresh), NONE
        if fresh:
            self._armed = page_set.difference(self._armed, cleared)
            copied = self._fresh(fresh, is_running=is_running)
            self._learn(lines)
        doubtful, self._doubtful = self._doubtful, NONE
        written = self._written(page_set.difference(self._armed, cleared), lines, is_running=is_running)
        if len(self._open):
            appeared = self._appeared(lines, is_running=is_running)
            copied = page_set.union(copied, appeared)
        if len(doubtful):
            cleared = page_set.union(cleared, doubtful)
            copied = page_set.union(copied, self._own(doubtful))
        written, emptied = self._sift(written, copied, everywhere=everywhere)
        return Scan(written, page_set.union(cleared, emptied))

    def _written(self, ranges: Words, lines: Sequence[MapsLine], *, is_running: bool) -> Words:
        """Written pages of protected ranges; while the process runs, mapping by mapping, so that only a lost one is in doubt."""
        if not is_running:
            return self._scanner.written(ranges)
        parts = self._parts.of(ranges, lines, make=lambda: _by_mapping(ranges, lines))
        found, refused = self._scanner.written_where_protected(parts) if len(parts) else (NONE, NONE)
        self._doubtful = page_set.union(self._doubtful, refused)
        return found

    def _appeared(self, lines: Sequence[MapsLine], *, is_running: bool) -> Words:
        """Pages that have come where nothing was protected; from now on their surroundings are."""
        appeared = self._scanner.existing(self._open)
        if not len(appeared):
            return NONE
        before = self._open
        self._protect_windows(lines, appeared)
        self._learn(lines)
        return self._own(before) if is_running else appeared

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
        self._armed = page_set.intersection(self._armed, self._tracked)
        closed = extents_of([line for line in followed if is_closed(line)])
        self._open = page_set.difference(page_set.difference(self._tracked, self._armed), closed)
        self._doubtful = page_set.intersection(self._doubtful, self._tracked)
        self._files = extents_of([line for line in followed if line.has_file])
        self._owned = page_set.intersection(self._owned, self._files)
        self._restless = page_set.intersection(self._restless, self._tracked)
        self._spans = extents_of(lines)

    def _lost(self, lines: Sequence[MapsLine], start: int, end: int) -> list[MapsLine]:
        inside = (line for line in lines if start <= line.start and line.end <= end)
        return [line for line in inside if not self._scanner.is_protected(line.start, line.end)]

    def _fresh(self, lines: Sequence[MapsLine], *, is_running: bool) -> Words:
        """Register mappings and protect them; answers with the pages that exist in them.

        Args:
            is_running: a mapping that cannot be registered may be gone, so existing pages are looked for once more.
        """
        for line in lines:
            if not self._register(line) and not is_running:
                self._stubborn.add((line.start, line.end))
        everywhere = extents_of(lines)
        existing = self._scanner.existing(everywhere)
        self._protect_windows([line for line in lines if (line.start, line.end) not in self._stubborn], existing)
        return self._own(everywhere) if is_running else existing

    def _protect_windows(self, lines: Sequence[MapsLine], existing: Words) -> None:
        """Protect windows that are worth it and not protected yet: writes there since the scan began must stay known.

        Where a mapping has gone meanwhile nothing is protected, and the next scan finds out.
        """
        worth = (line for line in lines if len(_inside(existing, line)) or (is_small(line) and not is_closed(line)))
        parts = [windows_of(line, _inside(existing, line)) for line in worth]
        if parts:
            windows = page_set.difference(pages_joined(np.concatenate(parts)), self._armed)
            self._scanner.written_where_protected(windows)
            self._armed = page_set.union(self._armed, windows)

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

    def _sift(self, written: Words, copied: Words, *, everywhere: bool) -> tuple[Words, Words]:
        """Tell pages that hold something from holes and from a file's own: (to read, to clear).

        Args:
            copied: exist, and are to be read in any case.
            everywhere: look for all private copies that may have been dropped.
        """
        is_long = (written[:, 1] - written[:, 0]) > LONG_RUN
        touches = touching(written, self._files) if len(self._files) else np.zeros_like(is_long)
        doubtful, suspects = written[is_long | touches], self._owned if everywhere else self._restless
        if page_set.covers(suspects, doubtful):
            self._looked_for = None if everywhere else (written, suspects)
            if not len(copied) and self._scanner.are_present(suspects):
                return written, NONE
        else:
            self._unrest = NONE if everywhere else written[touches & ~is_long]
        doubtful = page_set.union(doubtful, suspects)
        self._looked_for = None if everywhere else (written, doubtful)
        real, copied = self._existing(doubtful, copied)
        empty = page_set.difference(doubtful, page_set.union(real, copied))
        kept = NONE if everywhere else page_set.difference(self._owned, empty)
        self._owned = page_set.union(kept, page_set.intersection(page_set.union(real, copied), self._files))
        self._restless = page_set.difference(self._restless, empty)
        return page_set.union(page_set.difference(written, empty), copied), empty

    def _existing(self, doubtful: Words, copied: Words) -> tuple[Words, Words]:
        """Which pages of a set are there, and which of those around it are in memory; and those that are to be read in any case.

        A page of a file's mapping that seems to be swapped out is looked at (read): a private copy comes back, and a protected
        hole becomes a page of the file. One that is away again by then is read with the others.
        """
        if not len(doubtful):
            return NONE, copied
        around = self._surroundings_of(doubtful)
        found = self._scanner.private(around)
        swapped = page_set.intersection(found.swapped, doubtful)  # around them it may be protected holes
        away = page_set.intersection(swapped, self._files)
        if not len(away):
            return page_set.union(found.present, swapped), copied
        readable, _ = self._memory.readable_pages(away)
        found = self._scanner.private(around)
        real = page_set.union(found.present, page_set.difference(swapped, away))
        return real, page_set.union(copied, page_set.intersection(found.swapped, readable))

    def _own(self, extents: Words) -> Words:
        """The pages that exist where holes may be protected by now: such holes look like swapped-out pages."""
        real, looked_at = self._existing(extents, NONE)
        return page_set.intersection(page_set.union(real, looked_at), extents)  # it is also told of small gaps between them

    def _surroundings_of(self, doubtful: Words) -> Words:
        """The surroundings of pages. Scans ask for the same pages as a rule: one set while the process runs, one in a freeze."""
        key = doubtful.tobytes()
        for known, around in self._around:
            if known == key:
                return around
        self._around = ((key, surroundings_of(doubtful)), self._around[0])
        return self._around[0][1]


def surroundings_of(extents: Words) -> Words:
    """The same set with its small gaps: a few pages more cost less than a call more."""
    if len(extents) < 2:
        return extents
    apart = extents[1:, 0] > extents[:-1, 1] + np.uint64(SMALL_GAP)
    return np.stack((extents[np.concatenate(([True], apart)), 0], extents[np.concatenate((apart, [True])), 1]), axis=1)


def touching(extents: Words, others: Words) -> page_set.Flags:
    """For each extent whether it shares a page with the other set."""
    first = np.searchsorted(others[:, 1], extents[:, 0], side="right")
    begin = others[np.minimum(first, len(others) - 1), 0]
    touch: page_set.Flags = (first < len(others)) & (begin < extents[:, 1])
    return touch


def _inside(existing: Words, line: MapsLine) -> Words:
    first = np.searchsorted(existing[:, 1], np.uint64(line.start), side="right")
    last = np.searchsorted(existing[:, 0], np.uint64(line.end), side="left")
    return existing[first:last]


def _by_mapping(ranges: Words, lines: Sequence[MapsLine]) -> Words:
    """A set, cut where a mapping ends."""
    return np.concatenate([_within(ranges, line) for line in lines]) if lines else NONE


def _within(ranges: Words, line: MapsLine) -> Words:
    """The parts of a set that lie in a mapping."""
    found = _inside(ranges, line)
    return np.clip(found, np.uint64(line.start), np.uint64(line.end)) if len(found) else NONE


def enable_write_protection(faults: int) -> None:
    """Agree with the kernel on asynchronous write protection, also of pages that do not exist yet.

    Raises:
        OSError: this kernel has no such mode (before 6.7).
    """
    features = abi.UFFD_FEATURE_WP_UNPOPULATED | abi.UFFD_FEATURE_WP_ASYNC
    order = abi.UffdApi(abi.UFFD_API, features, 0)
    if abi.ioctl(faults, abi.UFFDIO_API, ctypes.addressof(order)) != 0:
        abi.raise_errno("UFFDIO_API with asynchronous write protection")
