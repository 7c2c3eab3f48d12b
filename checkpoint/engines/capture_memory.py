"""The memory of one captured process: which pages a snapshot must carry, and their bytes.

Most of them are copied while the program runs (`MemoryCapture.copy_running`): for a base everything that exists, then, as long as
much has been written meanwhile, what has. A pass *first* renews the protection and *then* reads, so that a page which is written
while it is read, or later, is named by the next pass. The last pass is `MemoryCapture.take`, while the program stands still: it
reads what was named since. A page's newest copy is its content.

What a scan has found is remembered until a snapshot that holds it is acknowledged, whoever scanned and whatever became of the
capture: its protection is renewed, so that nobody else will name it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from checkpoint import gathering, pages
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.gathering import Copy
from checkpoint.linux import abi, digests, pagetables, tracking
from checkpoint.linux.digests import SharedPages
from checkpoint.linux.guards import Guards
from checkpoint.linux.memory import Memory
from checkpoint.linux.procfs import MapsLine, MapsReader
from checkpoint.linux.remote import BorrowedPages
from checkpoint.linux.tracking import NONE, Scan, Tracker
from checkpoint.model import Position
from checkpoint.pages import Words
from checkpoint.resources import aio_rings

BUFFER_SIZE: Final = 8 << 20
"""Bytes that a freeze may copy without asking for memory first."""
LARGE_COUNT: Final = 256
"""Pages that are worth a pass while the program runs: they take 0.4 ms to copy, as long as everything else about them."""
PASS_LIMIT: Final = 3
"""Passes after the first: a program that writes faster than we copy is not caught up with by more of them."""
VDSO: Final = "[vdso]"
UNACKNOWLEDGED_LIMIT: Final = 64
"""Scans that are remembered one by one. Beyond, the oldest two become one, and the older position can be acknowledged no more: a
standby whose disk is full for a week must not make every freeze longer."""


SharedPlaces = frozenset[tuple[int, int, int, int]]
"""Parts of shared memory: device and inode number of the object, first and last offset of the part."""


def _place_of(line: MapsLine) -> tuple[int, int, int, int]:
    return line.device, line.inode, line.offset, line.offset + line.size


def _is_within(line: MapsLine, places: SharedPlaces) -> bool:
    device, inode, first, last = _place_of(line)
    return any(place[:2] == (device, inode) and place[2] <= first and last <= place[3] for place in places)


@dataclass(frozen=True, slots=True)
class Unacknowledged:
    """What one scan found, kept until a position that holds it is acknowledged."""

    position: Position | None
    written: Words
    cleared: Words


@dataclass(slots=True)
class RunningCopy:
    """What was copied while the program ran.

    Attributes:
        copies: oldest first; of a page that several have, the newest counts.
        valid: the pages of ``copies`` that no later scan has named.
    """

    copies: list[Copy] = field(default_factory=list)
    valid: Words = field(default_factory=lambda: NONE)

    def add(self, copy: Copy) -> None:
        """Take in what was read since the last scan."""
        self.copies.append(copy)
        self.valid = pages.union(self.valid, copy.pages)

    def spoil(self, scan: Scan) -> None:
        """Forget what a scan has named."""
        self.valid = pages.difference(pages.difference(self.valid, scan.written), scan.cleared)


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """The memory of one capture, when the program stood still.

    Attributes:
        lines: the mappings.
        carried: pages that the snapshot must tell of; each is in one of ``copies`` at least.
        cleared: pages whose earlier content is forgotten, relative to the acknowledged position; ``carried`` comes on top.
        guards: see ``checkpoint.model.Vma.guards``.
        copies: oldest first; the last one was made while the program stood still, in a buffer that the next one uses again.
        untouched: see `checkpoint.resources.untouched`.
    """

    lines: tuple[MapsLine, ...]
    carried: Words
    cleared: Words
    guards: Words
    copies: tuple[Copy, ...]
    untouched: Words = field(default_factory=lambda: NONE)

    @property
    def frozen_size(self) -> int:
        """Bytes that were copied while the program stood still."""
        return pages.total_size(self.copies[-1].pages)

    def contents(self) -> tuple[Words, memoryview, Words]:
        """The carried pages that are to be sent, in order, their bytes, and those of anonymous memory that are all zero."""
        sources, _ = gathering.newest(self.copies, abi.PAGE_SIZE).without(self.carried, NONE)
        of_files = tracking.extents_of([line for line in self.lines if line.has_file])
        zero = gathering.are_zero(self.copies, sources, abi.PAGE_SIZE) & ~pages.covered(of_files, sources.addresses)
        dropped = pages.extents_of_addresses(sources.addresses[zero], abi.PAGE_SIZE)
        sent, _ = sources.without(self.carried, dropped)
        return sent.addresses, gathering.gathered([copy.content for copy in self.copies], sent, abi.PAGE_SIZE), dropped


class MemoryCapture:
    """Follows the memory of one process.

    Invariants: ``_unacknowledged`` holds every page that was named since the newest acknowledged position; its last entry alone
    may be without position, of a capture that is not finished or was refused.

    Attributes:
        lines: the mappings when they were last read, without our own.
        acknowledged: the newest acknowledged position; None if only a base can be captured.
        borrowed: our own pages in the process, which belong to no snapshot.
        has_rings: some of them are rings of asynchronous I/O.

    Args:
        tracker: owned from now on.
    """

    def __init__(self, memory: Memory, tracker: Tracker, borrowed: BorrowedPages) -> None:
        self._memory = memory
        self._tracker = tracker
        self.borrowed = borrowed
        self._shared = SharedPages(memory.pid)
        try:
            self._page_tables = pagetables.existence(memory.pid)
        except BaseException:
            self._shared.close()
            raise
        self._guards = Guards(self._page_tables.guards)
        self._maps = MapsReader(memory.pid)
        self._has_moved = False
        self._private: list[MapsLine] = []
        self._shared_lines: list[MapsLine] = []
        self._told_elsewhere: SharedPlaces = frozenset()
        self._had_shared = False
        self._mapped: Words = NONE
        self._vdso: Words = NONE
        self._followed: Words = NONE
        self._buffer = bytearray(BUFFER_SIZE)
        self._is_armed = False
        self._unacknowledged: list[Unacknowledged] = []
        self.acknowledged: Position | None = None
        self.lines: tuple[MapsLine, ...] = ()
        self.has_rings = False

    def close(self) -> None:
        """Stop following; the process is not changed."""
        self._tracker.close()
        self._shared.close()
        self._page_tables.close()

    def acknowledge(self, position: Position) -> bool:
        """Forget what a position holds, for deltas are relative to it from now on; whether it was known."""
        places = [index for index, held in enumerate(self._unacknowledged) if held.position == position]
        if places:
            del self._unacknowledged[: places[-1] + 1]
            self.acknowledged = position
        return bool(places)

    def settle(self, position: Position) -> None:
        """The last look has become the snapshot with this position."""
        last = self._unacknowledged[-1]
        self._unacknowledged[-1] = Unacknowledged(position, last.written, last.cleared)

    def positions(self) -> set[Position | None]:
        """Those that are, or can still be, acknowledged."""
        return {self.acknowledged, *(held.position for held in self._unacknowledged)}

    def start_over(self) -> None:
        """Follow from the beginning with the next base: what was written is not known any more."""
        self._is_armed, self.acknowledged = False, None
        self._guards.forget()
        self._unacknowledged.clear()

    # While the program runs

    def copy_running(self, *, base: bool) -> RunningCopy:
        """Copy beforehand what is worth it, so that little is left for the freeze."""
        self.refresh()
        copied = RunningCopy()
        if base:
            self._copy_everything(copied)
        for _ in range(PASS_LIMIT):
            if not self._is_behind(copied, base=base):
                break
            self._catch_up(copied)
            self._read_into(copied, self._missing(copied, base=base))
            self.refresh()
        return copied

    def _copy_everything(self, copied: RunningCopy) -> None:
        """Copy all that exists. A page that cannot be read now has gone or is coming, and the next scan names it."""
        if not self._is_armed or not self._tracker.sees_every_write:
            self._tracker.arm(self._private)
            self._is_armed = True
        elif self._tracker.scans_running:
            self._catch_up(copied)
        self._shared.forget()
        if self._tracker.sees_every_write:
            self._read_into(copied, self._tracker.existing(self._private))

    def _is_behind(self, copied: RunningCopy, *, base: bool) -> bool:
        """Whether the freeze would have much to copy, and a pass can change that."""
        if not self._is_armed or not self._tracker.scans_running:
            return False
        if self._backlog() >= LARGE_COUNT:
            return True
        return bool(self._unacknowledged) and pages.total_size(self._missing(copied, base=base)) >= LARGE_COUNT * abi.PAGE_SIZE

    def _missing(self, copied: RunningCopy, *, base: bool) -> Words:
        """Private pages that the snapshot would carry, and that are not copied. Shared ones are told by their digests: they may
        be changed, copied, and changed back."""
        return pages.intersection(pages.difference(self._since_acknowledged(base=base)[0], copied.valid), self._followed)

    def _backlog(self) -> int:
        count = self._tracker.backlog(self._private, LARGE_COUNT, changed=self._has_moved)
        self._has_moved = False
        return count

    def _catch_up(self, copied: RunningCopy) -> None:
        try:
            scan = self._tracker.catch_up(self._private, changed=self._has_moved)
        except CaptureError:
            self.start_over()
            raise
        self._has_moved = False
        self._remember(scan)
        copied.spoil(scan)

    def _read_into(self, copied: RunningCopy, wanted: Words) -> None:
        """Read a set as far as it is there."""
        buffer = np.empty(pages.total_size(wanted), dtype=np.uint8).data
        found, filled = [], 0
        for chunk in digests.chunks_of(wanted):
            readable = self._memory.readable_pages_into(chunk, buffer[filled:])
            found.append(readable)
            filled += pages.total_size(readable)
        if found:
            copied.add(Copy(pagetables.pages_joined(np.concatenate(found)), buffer[:filled]))

    # While it stands still

    def take(self, copied: RunningCopy, *, base: bool) -> Taken:
        """Copy what is not copied yet, or not any more. The program stands still."""
        self.refresh()
        scan = self._scan()
        self._remember(scan)
        copied.spoil(scan)
        try:
            return self._taken(copied, self._guards.found(self._mapped, self._tracker.watched), base=base)
        except ProcessGoneError:
            raise
        except CaptureError:  # a page that has become a guard cannot be read
            return self._taken(copied, self._guards.found_everywhere(self._mapped, self._tracker.watched), base=base)

    def _taken(self, copied: RunningCopy, guards: Words, *, base: bool) -> Taken:
        self._leave_out(guards)
        written, cleared = self._since_acknowledged(base=base)
        if copied.copies:
            copied.valid = pages.intersection(copied.valid, self._mapped if base else written)
        missing = pages.difference(written, copied.valid)
        if base:
            missing = pages.union(missing, self._vdso)  # for a machine whose kernel has another one
        content = memoryview(self._memory.read_pages(missing, self._buffer))[: pages.total_size(missing)]
        return Taken(
            lines=self.lines,
            carried=pages.union(missing, copied.valid),
            cleared=cleared,
            guards=guards,
            copies=(*copied.copies, Copy(missing, content)),
            untouched=self._untouched(),
        )

    def _untouched(self) -> Words:
        """Pages of files without a name that the process has mapped for itself, and has no copy of."""
        if not len(self._orphans):
            return NONE
        return pages.difference(self._orphans, self._page_tables.existing(self._orphans))

    def leave_out(self, places: SharedPlaces) -> None:
        """Do not tell of shared memory that another process of the component tells of."""
        if places != self._told_elsewhere:
            self._told_elsewhere = places
            self._sort_shared()

    def shared_places(self) -> SharedPlaces:
        """The shared memory that this process tells all of, as `leave_out` takes it."""
        may_look = digests.may_look_into_mappings()  # of a file with a name each tells what it has in its page tables
        told = (one for one in self.lines if tracking.is_shared_object(one) or (may_look and tracking.is_shared_anonymous(one)))
        return frozenset(map(_place_of, told))

    def _sort_shared(self) -> None:
        self._shared_lines = [
            line
            for line in self.lines
            if (tracking.is_shared(line) and not _is_within(line, self._told_elsewhere)) or tracking.is_orphan(line)
        ]

    def refresh(self) -> None:
        """Read and sort the mappings; that they have changed is kept until the tracker has been told."""
        if not self._maps.refresh():
            return
        self._has_moved = True
        self.lines = tuple(line for line in self._maps.lines if not self.borrowed.holds(line.start))
        self._private = [line for line in self.lines if tracking.is_private(line)]
        self._sort_shared()
        self.has_rings = any(map(aio_rings.is_ring, self._shared_lines))
        self._followed = tracking.extents_of(self._private)
        self._orphans = tracking.extents_of([line for line in self.lines if tracking.is_orphan(line)])
        self._mapped = tracking.extents_of([line for line in self.lines if line.name not in tracking.NOT_CARRIED])
        self._vdso = tracking.extents_of([line for line in self.lines if line.name == VDSO])

    def _scan(self) -> Scan:
        """What was written since the last scan. One that fails half-way has protected pages that it tells nobody of."""
        try:
            scan = self._tracker.scan(self._private, changed=self._has_moved)
        except CaptureError:
            self.start_over()
            raise
        self._has_moved = False
        if not self._shared_lines and not self._had_shared:
            return scan
        self._had_shared = bool(self._shared_lines)
        shared = self._shared.scan(self._shared_lines)
        orphans = tracking.extents_of([line for line in self._shared_lines if tracking.is_orphan(line)])
        # What the tracker says of orphans dates from before their file was deleted.
        cleared = pages.difference(scan.cleared, orphans)
        return Scan(pages.union(scan.written, shared.written), pages.union(cleared, shared.cleared))

    def _remember(self, scan: Scan) -> None:
        """Keep what a scan found until it is acknowledged; one that has become no snapshot is joined with the next."""
        self._guards.named(scan)
        written, cleared = scan.written, scan.cleared
        if self._unacknowledged and self._unacknowledged[-1].position is None:
            last = self._unacknowledged.pop()
            still = pages.intersection(pages.difference(last.written, cleared), self._mapped)
            written, cleared = pages.union(still, written), pages.union(last.cleared, cleared)
        self._unacknowledged.append(Unacknowledged(None, written, cleared))
        if len(self._unacknowledged) > UNACKNOWLEDGED_LIMIT:
            oldest, next_one, *rest = self._unacknowledged
            self._unacknowledged = [_joined(oldest, next_one), *rest]

    def _leave_out(self, guards: Words) -> None:
        """A page that has become a guard counts as written, and there is nothing to read."""
        last = self._unacknowledged[-1]
        installed = pages.intersection(last.written, guards)
        if len(installed):
            written, cleared = pages.difference(last.written, installed), pages.union(last.cleared, installed)
            self._unacknowledged[-1] = Unacknowledged(None, written, cleared)

    def _since_acknowledged(self, *, base: bool) -> tuple[Words, Words]:
        """What a delta must carry: the union of all scans since. A base needs what has become no snapshot yet."""
        scans = self._unacknowledged[-1:] if base else self._unacknowledged
        if len(scans) == 1:
            return scans[0].written, scans[0].cleared
        union = functools.reduce(_joined, scans)
        return pages.intersection(union.written, self._mapped), union.cleared


def _joined(earlier: Unacknowledged, later: Unacknowledged) -> Unacknowledged:
    """Two scans as one, known by the later one's position."""
    written = pages.union(pages.difference(earlier.written, later.cleared), later.written)
    return Unacknowledged(later.position, written, pages.union(earlier.cleared, later.cleared))
