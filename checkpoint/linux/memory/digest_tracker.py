"""Find changed pages by digest: for private mappings where the kernel tracks no writes, and always for shared mappings.

It needs no kernel feature, and costs a pass over the memory.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from checkpoint.linux import abi
from checkpoint.linux.memory.pagemap import existence
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import NONE, Scan, extents_of, is_orphan, is_shared_anonymous, is_shared_object
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.pages import page_set
from checkpoint.pages.page_set import PageMap, Words
from checkpoint.runtime import parallel

DIGESTED: Final = 1 << 20
"""Bytes that are read, and then digested, at a time."""
PIECES_FOR_THREADS: Final = 8
"""Fewer are read by the time that threads are born."""


class DigestTracker:
    """Reads everything that exists and compares digests. Needs nothing of the kernel."""

    name = "digest"
    cost = "it stands still while failover reads all of its memory; longer periods keep that to a tenth of its time"
    sees_every_write = False
    scans_running = False

    def __init__(self, pid: int) -> None:
        self._memory = Memory(pid)
        self._existence = existence(pid)
        self._known = PageMap.empty()

    @property
    def watched(self) -> Words:
        """See `Tracker.watched`."""
        return NONE

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`: nothing is known, so that the first scan finds everything."""
        self._known = PageMap.empty()

    def scan(self, lines: Sequence[MapsLine], *, changed: bool, everywhere: bool = False) -> Scan:
        """See `Tracker.scan`."""
        existing = self.existing(lines)
        addresses = page_set.addresses_of(existing, abi.PAGE_SIZE)
        digests = digests_of(self._memory, existing)
        before, self._known = self._known, PageMap(addresses, digests)
        return compared(before, self._known)

    def rehearse(self) -> None:
        """See `Tracker.rehearse`: it would take as long as the scan."""

    def confirm(self) -> bool:
        """See `Tracker.confirm`."""
        return True

    def backlog(self, lines: Sequence[MapsLine], limit: int, *, changed: bool) -> int:
        """See `Tracker.backlog`."""
        raise NotImplementedError("a look costs a pass over the memory")

    def catch_up(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.catch_up`."""
        raise NotImplementedError("a look costs a pass over the memory")

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
    return Scan(
        page_set.extents_of_addresses(now.addresses[~same], abi.PAGE_SIZE), page_set.extents_of_addresses(gone, abi.PAGE_SIZE)
    )


def digests_of(memory: Memory, existing: Words) -> Words:
    """The digest of each page. Much is read by several threads, each into a buffer that stays in its processor's cache."""
    buffers = parallel.OwnBuffers(DIGESTED)

    def digested(piece: Words) -> Words:
        addresses = page_set.addresses_of(piece, abi.PAGE_SIZE)
        memory.read_pages_into(piece, buffers.own)
        return page_set.digest_pages(buffers.own[: len(addresses) * abi.PAGE_SIZE], addresses, abi.PAGE_SIZE)

    pieces = page_set.cut(existing, DIGESTED)
    threads = parallel.thread_count() if len(pieces) >= PIECES_FOR_THREADS else 1
    found = list(parallel.in_order(digested, pieces, threads))
    return np.concatenate(found) if found else NONE


def filled_extents(file: int, begin: int = 0) -> Iterator[tuple[int, int]]:
    """Parts of a file that hold something, whole pages, from an offset on. Source: SEEK_DATA of lseek(2)."""
    place = begin
    while True:
        try:
            first = os.lseek(file, place, os.SEEK_DATA)
        except OSError:  # nothing more
            return
        place = os.lseek(file, first, os.SEEK_HOLE)
        yield first & -abi.PAGE_SIZE, -(-place // abi.PAGE_SIZE) * abi.PAGE_SIZE


@functools.cache
def may_look_into_mappings() -> bool:
    """Whether mapped files can be opened: root's right (CAP_CHECKPOINT_RESTORE), as proc_pid_map_files(5) says."""
    try:
        names = os.listdir("/proc/self/map_files")
        os.close(os.open(f"/proc/self/map_files/{names[0]}", os.O_RDONLY | os.O_CLOEXEC))
    except (OSError, IndexError):
        return False
    return True


class SharedPages:
    """Mappings that are compared by page digest at every scan: shared ones, which others may write behind our page tables, and
    those of deleted files, of which every page is carried."""

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
        self._known = PageMap(page_set.addresses_of(existing, abi.PAGE_SIZE), digests_of(self._memory, existing))
        return compared(before, self._known)

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """Populated pages of shared mappings, what else their objects hold, and all that can be read of deleted files."""
        shared = extents_of([line for line in lines if not is_orphan(line)])
        orphans = extents_of([line for line in lines if is_orphan(line)])
        populated = self._existence.existing(shared, own=False) if len(shared) else NONE
        for line in lines:
            if is_shared_object(line) or (is_shared_anonymous(line) and may_look_into_mappings()):
                populated = page_set.union(populated, self._held_by_object(line))
        return page_set.union(populated, self._memory.readable_pages(orphans)[0]) if len(orphans) else populated

    def _held_by_object(self, line: MapsLine) -> Words:
        """The mapped pages of an object that hold something, from any writer.

        Where we may not look into the object itself (it has no name, and we are not root) all that can be read counts: reading
        makes pages where none are, but nothing is lost that was written by other means than through this mapping.
        """
        file = self._open_object(line)
        if file is None:
            return self._memory.readable_pages(extents_of([line]))[0]
        try:
            found = [
                (line.start + max(first - line.offset, 0), line.start + min(last - line.offset, line.size))
                for first, last in filled_extents(file, line.offset)
                if first < line.offset + line.size
            ]
        finally:
            os.close(file)
        return np.array(found, dtype=np.uint64).reshape(-1, 2)

    def _open_object(self, line: MapsLine) -> int | None:
        """A descriptor of the mapped object; None where we may not have one."""
        with contextlib.suppress(OSError):  # root alone may look there
            return os.open(f"/proc/{self._pid}/map_files/{line.start:x}-{line.end:x}", os.O_RDONLY | os.O_CLOEXEC)
        with contextlib.suppress(OSError):  # it has no name any more
            file = os.open(f"{procfs.outlook(self._pid)}{line.name}", os.O_RDONLY | os.O_CLOEXEC)
            about = os.fstat(file)
            if (about.st_dev, about.st_ino) == (line.device, line.inode):
                return file
            os.close(file)
        return None

    def forget(self) -> None:
        """Let the next scan find everything."""
        self._known = PageMap.empty()

    def close(self) -> None:
        """Give descriptors back."""
        self._existence.close()
