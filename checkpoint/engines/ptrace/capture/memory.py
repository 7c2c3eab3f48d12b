"""Capture the memory of one process: find the pages that a snapshot must carry, and copy their bytes.

The capture copies most pages while the program runs (`MemoryCapture.copy_running`): for a base every page that exists, then, as
long as the program has written much meanwhile, the written pages. A pass *first* renews the protection and *then* reads, so that
the next pass names every page that is written during the read or later. The last pass is `MemoryCapture.take`, while the program
is frozen: it reads the pages that were named since. The newest copy of a page is its content.

The capture remembers the result of a scan until a snapshot that holds it is acknowledged, whichever pass scanned, and even if the
capture failed. The scan has renewed the protection, so no later scan names these pages again.

While the program is frozen, the capture computes with sets of pages as little as possible: each step takes tens of µs. The pages
still to be copied are known before the freeze (`RunningCopy.owed`), and the content of the snapshot is worked out after it
(`checkpoint.engines.ptrace.capture.memory_result`).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Collection
from typing import Final

import numpy as np
from msgspec import Struct, field

from checkpoint.engines.ptrace.capture.at_rest import REST_PAGES, LastLook
from checkpoint.engines.ptrace.capture.freeze_budget import FreezeBudget, OverBudgetError
from checkpoint.engines.ptrace.capture.memory_result import Taken, Unacknowledged, joined, since, with_one_tail
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory import digest_tracker, pagemap
from checkpoint.linux.memory import tracker as memory_tracker
from checkpoint.linux.memory.digest_tracker import SharedPages
from checkpoint.linux.memory.guard_pages import Guards
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import NONE, Scan, Tracker
from checkpoint.linux.procfs.maps_reader import MapsReader
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.trace.remote_syscalls import BorrowedPages
from checkpoint.model import Position
from checkpoint.pages import page_set
from checkpoint.pages.merge import Copy
from checkpoint.pages.page_set import Words
from checkpoint.resources.events import aio
from checkpoint.resources.ipc import boards, system_v_memory
from checkpoint.resources.ipc.shared_memory import Object, seen_detached
from checkpoint.runtime import parallel

READ_CHUNK: Final = 8 << 20
"""Bytes that are read at a time while the program runs."""
FREEZE_CHUNK: Final = 2 << 20
"""Bytes that are read at a time in a freeze that must end in time."""
BUFFER_SIZE: Final = 8 << 20
"""Bytes that a freeze may copy without asking for memory first, where earlier ones copied as much."""
BUFFER_SIZE_MIN: Final = 1 << 20
ROOM_SIZE: Final = 64 << 10
"""Bytes that a copy has room for behind its pages: of the vdso, and of what came since."""
WORTH_COUNT: Final = 16
"""Pages that are worth the first pass of a delta while the program runs."""
LARGE_COUNT: Final = 256
"""Pages that are worth another pass: they take 0.4 ms to copy, as long as everything else about them."""
PASS_LIMIT: Final = 3
"""Passes after the first: a program that writes faster than we copy is not caught up with by more of them."""
BUDGET_PASS_LIMIT: Final = 12
"""The same where the rest shall fit a budget."""
CATCHING_UP: Final = 0.8
"""The share of the earlier pass: a pass that copies more than this share does not catch up."""
SHED_SHARE: Final = 2
"""A copy of which less than one part in so many still counts is replaced by that part."""
VDSO: Final = "[vdso]"
UNACKNOWLEDGED_LIMIT: Final = 64
"""Scans that are remembered one by one. Beyond, the oldest two become one, and the older position can be acknowledged no more: a
standby whose disk is full for a week must not make every freeze longer."""


SharedPlaces = frozenset[tuple[int, int, int, int]]
"""Parts of shared memory: device and inode number of the object, first and last offset of the part."""


def _part_of(copy: Copy, wanted: Words) -> Copy:
    """Some of its pages, in memory of their own."""
    chosen = page_set.covered(wanted, page_set.addresses_of(copy.pages, abi.PAGE_SIZE))
    rows = np.frombuffer(copy.content, dtype=np.uint8, count=len(chosen) * abi.PAGE_SIZE).reshape(-1, abi.PAGE_SIZE)
    return Copy(wanted, rows[chosen].reshape(-1).data)


def _place_of(line: MapsLine) -> tuple[int, int, int, int]:
    return line.device, line.inode, line.offset, line.offset + line.size


def _is_within(line: MapsLine, places: SharedPlaces) -> bool:
    device, inode, first, last = _place_of(line)
    return any(place[:2] == (device, inode) and place[2] <= first and last <= place[3] for place in places)


class RunningCopy(Struct):
    """The pages that were copied while the program ran.

    Attributes:
        copies: oldest first; of a page that several have, the newest counts.
        valid: the pages of ``copies`` that no later scan has named.
        owed: pages that the snapshot would carry besides, as far as known at the end of the last pass.
        late: the scans of a failed freeze since then.
        start: see `MemoryCapture.start_over`.
    """

    start: int = 0
    copies: list[Copy] = field(default_factory=list)
    valid: Words = field(default_factory=lambda: NONE)
    owed: Words = field(default_factory=lambda: NONE)
    late: list[Scan] = field(default_factory=list)

    def add(self, copy: Copy) -> None:
        """Add pages that were read since the last scan."""
        self.copies.append(copy)
        self.valid = page_set.union(self.valid, copy.pages)

    def spoil(self, scan: Scan) -> None:
        """Forget the pages that a scan has named."""
        self.valid = page_set.difference(page_set.difference(self.valid, scan.written), scan.cleared)

    def shed(self) -> None:
        """Let go of what newer copies and scans have made useless: else memory grows with each pass, and there may be many."""
        kept, left = [], self.valid
        for copy in reversed(self.copies):
            useful = page_set.intersection(copy.pages, left)
            left = page_set.difference(left, copy.pages)
            if SHED_SHARE * page_set.total_size(useful) > page_set.total_size(copy.pages):
                kept.append(copy)
            elif len(useful):
                kept.append(_part_of(copy, useful))
        self.copies = kept[::-1]


class FreezeBuffer:
    """Memory for pages that are copied while the program stands still, of all processes of a component; used again each time."""

    def __init__(self) -> None:
        self._content = bytearray()
        self._wanted = 0

    @property
    def size(self) -> int:
        """Bytes that it holds."""
        return len(self._content)

    def begin(self) -> None:
        """Before a freeze: nothing of the last one is needed any more."""
        wanted = min(max(self._wanted, BUFFER_SIZE_MIN), BUFFER_SIZE)
        if wanted > len(self._content):
            self._content = bytearray(min(-(-wanted // BUFFER_SIZE_MIN) * BUFFER_SIZE_MIN, BUFFER_SIZE))
        self._wanted = 0

    def piece(self, size: int) -> memoryview:
        """A piece of this size; of new memory where the rest does not suffice."""
        begin = self._wanted
        self._wanted += size
        if self._wanted <= len(self._content):
            return memoryview(self._content)[begin : self._wanted]
        return np.empty(size, dtype=np.uint8).data


class MemoryCapture:
    """Follows the memory of one process.

    Invariants: ``_unacknowledged`` holds every page that was named since the newest acknowledged position; its last entries alone
    may be without position, of a capture that is not finished or was refused; they are made one when the program runs.

    Attributes:
        lines: the mappings when they were last read, without our own.
        acknowledged: the newest acknowledged position; None if only a base can be captured.
        borrowed: our own pages in the process, which belong to no snapshot.
        has_rings: some of them are rings of asynchronous I/O.
        has_segments: some of them are System V shared memory.
        readers: threads that copy while the program runs; more than one takes processors from it.
        buffer, budget: the component's; where nothing else is said, this process is all of it.

    Args:
        tracker: owned from now on.
    """

    def __init__(self, memory: Memory, tracker: Tracker, borrowed: BorrowedPages) -> None:
        self._memory = memory
        self._tracker = tracker
        self.borrowed = borrowed
        self._shared = SharedPages(memory.pid)
        try:
            self._page_tables = pagemap.existence(memory.pid)
        except BaseException:
            self._shared.close()
            raise
        self._guards = Guards(self._page_tables.guards)
        self._maps = MapsReader(memory.pid)
        self._has_moved = False
        self._private: list[MapsLine] = []
        self._shared_lines: list[MapsLine] = []
        self._told_elsewhere: SharedPlaces = frozenset()
        self._detached: Collection[Object] = frozenset()
        self._had_shared = False
        self._boards: Words = NONE
        self._boards_named: Words = NONE
        self._mapped: Words = NONE
        self._of_files: Words = NONE
        self._vdso: Words = NONE
        self._followed: Words = NONE
        self.buffer = FreezeBuffer()
        self.budget = FreezeBudget(0)
        self._is_armed = False
        self._start = 0
        self._begun: RunningCopy | None = None
        self._unacknowledged: list[Unacknowledged] = []
        self._left_out: Words = NONE
        self.acknowledged: Position | None = None
        self.lines: tuple[MapsLine, ...] = ()
        self.has_rings = self.has_segments = False
        self.readers = 1

    def close(self) -> None:
        """Stop following; the process is not changed."""
        self._maps.close()
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
        self._join()
        last = self._unacknowledged[-1]
        self._unacknowledged[-1] = Unacknowledged(position, last.written, last.cleared)

    def positions(self) -> set[Position | None]:
        """The positions that are, or can still be, acknowledged."""
        return {self.acknowledged, *(held.position for held in self._unacknowledged)}

    def start_over(self) -> None:
        """Follow from the beginning with the next base: the written pages are not known any more."""
        self._is_armed, self.acknowledged = False, None
        self._start += 1
        self._guards.forget()
        self._unacknowledged.clear()
        self._left_out = NONE

    # While the program runs

    def has_rested(self, last: LastLook) -> bool:
        """Whether its pages are as they were at the last look, whose snapshot is acknowledged.

        If they are not, the next `copy_running` begins with those that were read to find that out.
        """
        self._begun = None
        if self.acknowledged is None or not self._is_armed or not self._tracker.scans_running or self._shared_lines:
            return False
        if any(held.position is not None for held in self._unacknowledged):
            return False
        if count := self._backlog(REST_PAGES):
            if count >= REST_PAGES:
                return False
            self._catch_up(RunningCopy())
        if not self._unacknowledged:
            return True
        (tail,) = self._unacknowledged
        if len(tail.cleared) or page_set.total_size(tail.written) > REST_PAGES * abi.PAGE_SIZE:
            return False
        content = memoryview(bytearray(page_set.total_size(tail.written)))
        self._memory.read_pages_into(tail.written, content)
        if last.are_equal(tail.written, content):
            return True
        self._begun = RunningCopy(self._start)
        self._begun.add(Copy(tail.written, content))
        return False

    def copy_running(self, *, base: bool, enough: int = 0, copied: RunningCopy | None = None) -> RunningCopy:
        """Copy beforehand what is worth it, so that little is left for the freeze.

        Args:
            copied: the copy of this capture before a failed freeze: this call goes on with it.
            enough: the number of pages that may be left. Passes go on until no more are left, as long as they catch up with the
                program; 0: until another pass is not worth it.
        """
        self.refresh()
        begun, self._begun = self._begun, None
        is_again = copied is not None and copied.start == self._start
        if copied is None or not is_again:
            copied = begun if begun and not base and begun.start == self._start else RunningCopy(self._start)
            if base:
                self._copy_everything(copied)
        for scan in copied.late:
            copied.spoil(scan)
        copied.late.clear()
        last = page_set.total_size(copied.valid)
        for turn in range(BUDGET_PASS_LIMIT if enough or is_again else PASS_LIMIT):
            if not self._is_behind(copied, enough or (LARGE_COUNT if turn or base else WORTH_COUNT), base=base):
                break
            self._catch_up(copied)
            copied.shed()
            missing = self._missing(copied, base=base)
            self._read_into(copied, missing)
            self._refresh_if_moved()
            self._maps.prepare()
            last, before = page_set.total_size(missing), last
            if (turn >= PASS_LIMIT or (before and self.budget.is_long)) and last >= CATCHING_UP * before:
                break
            if not enough and not is_again and last < LARGE_COUNT * abi.PAGE_SIZE:
                break  # while so few were read, hardly as many were written
        copied.owed = page_set.difference(self._since_acknowledged(base=base)[0], copied.valid)
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

    def _is_behind(self, copied: RunningCopy, count: int, *, base: bool) -> bool:
        """Whether the freeze would have so many pages to copy, and a pass can change that."""
        if not self._is_armed or not self._tracker.scans_running:
            return False
        if self._backlog(count) >= count:
            return True
        return bool(self._unacknowledged) and page_set.total_size(self._missing(copied, base=base)) >= count * abi.PAGE_SIZE

    def _missing(self, copied: RunningCopy, *, base: bool) -> Words:
        """Private pages that the snapshot would carry, and that are not copied. Shared ones are told by their digests: they may
        be changed, copied, and changed back."""
        return page_set.intersection(page_set.difference(self._since_acknowledged(base=base)[0], copied.valid), self._followed)

    def _backlog(self, limit: int) -> int:
        count = self._tracker.backlog(self._private, limit, changed=self._has_moved)
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
        wanted_size = page_set.total_size(wanted)
        buffer = np.empty(wanted_size + ROOM_SIZE, dtype=np.uint8).data
        if wanted_size <= READ_CHUNK:
            found = self._memory.readable_pages_into(wanted, buffer[:wanted_size])
            filled = page_set.total_size(found)
        else:
            found, filled = self._read_in_chunks(wanted, buffer)
        if filled:
            copied.add(Copy(found, buffer[: filled + ROOM_SIZE]))

    def _read_in_chunks(self, wanted: Words, buffer: memoryview) -> tuple[Words, int]:
        """The pages of a set that are there, and how many bytes of the buffer they fill."""
        found, filled = [], 0
        chunks = page_set.cut(wanted, READ_CHUNK)
        bounds = itertools.pairwise(itertools.accumulate(map(page_set.total_size, chunks), initial=0))
        places = [(chunk, begin, end) for chunk, (begin, end) in zip(chunks, bounds, strict=True)]

        def read(place: tuple[Words, int, int]) -> Words:
            chunk, begin, end = place
            return Memory(self._memory.pid).readable_pages_into(chunk, buffer[begin:end])

        answers = parallel.in_order(read, places, self.readers)
        for (_, begin, _), readable in zip(places, answers, strict=True):
            size = page_set.total_size(readable)
            if begin != filled:  # of one before it there was less than was wanted
                buffer[filled : filled + size] = buffer[begin : begin + size]
            found.append(readable)
            filled += size
        return pagemap.pages_joined(np.concatenate(found)), filled

    def rehearse(self) -> None:
        """See ``checkpoint.engines.ptrace.capture.process``."""
        self._maps.rehearse()
        self._guards.rehearse()
        self._tracker.rehearse()

    # While it stands still

    def take(self, copied: RunningCopy, *, base: bool) -> Taken:
        """Copy what is not copied yet, or not any more. The program stands still."""
        self._refresh_if_moved()
        scan = self._scan(everywhere=base)
        self._guards.named(scan)
        self._unacknowledged.append(Unacknowledged(None, scan.written, scan.cleared))
        copied.late.append(scan)
        try:
            return self._taken(copied, scan, self._guards.found(self._mapped, self._tracker.watched), base=base)
        except (ProcessGoneError, OverBudgetError):
            raise
        except CaptureError:  # a page that has become a guard cannot be read
            guards = self._guards.found_everywhere(self._mapped, self._tracker.watched)
            return self._taken(copied, scan, guards, base=base)

    def take_unread(self) -> Taken:
        """All existing pages, still to be read in place. The tracking of writes stays as it is."""
        self._refresh_if_moved()
        existing = page_set.union(self._tracker.existing(self._private), self._shared.existing(self._shared_lines))
        guards = self._guards.found_everywhere(self._mapped, self._tracker.watched)
        unread = page_set.union(page_set.difference(page_set.intersection(existing, self._mapped), guards), self._vdso)
        return Taken(
            lines=self.lines,
            mapped=self._mapped,
            is_base=True,
            guards=guards,
            scans=(),
            valid=NONE,
            copies=(),
            unread=unread,
            untouched=self._untouched(),
            of_files=self._of_files,
        )

    def confirm(self) -> bool:
        """Whether the last look took everything; see `Tracker.confirm`."""
        return self._tracker.confirm()

    def _taken(self, copied: RunningCopy, scan: Scan, guards: Words, *, base: bool) -> Taken:
        owed = page_set.intersection(page_set.difference(copied.owed, scan.cleared), self._mapped)
        missing = page_set.difference(page_set.union(owed, scan.written), guards)
        if base:
            missing = page_set.union(missing, self._vdso)  # for a machine whose kernel has another one
        size = page_set.total_size(missing)
        self.budget.require(size)
        began = time.perf_counter_ns()
        content = self.buffer.piece(size)
        if self.budget.is_strict and size > FREEZE_CHUNK:
            self._read_within_budget(missing, content)
        else:
            self._memory.read_pages_into(missing, content)
        copy_ns = time.perf_counter_ns() - began
        self.budget.copied()
        self._left_out = guards
        return Taken(
            lines=self.lines,
            mapped=self._mapped,
            is_base=base,
            guards=guards,
            scans=tuple(self._unacknowledged),
            valid=copied.valid,
            copies=(*copied.copies, Copy(missing, content)),
            copy_ns=copy_ns,
            untouched=self._untouched(),
            of_files=self._of_files,
        )

    def _read_within_budget(self, missing: Words, content: memoryview) -> None:
        """Read in pieces, and look at the clock in between: on a busy machine copying takes longer than it used to."""
        filled = 0
        for piece in page_set.cut(missing, FREEZE_CHUNK):
            self.budget.require(len(content) - filled)
            size = page_set.total_size(piece)
            self._memory.read_pages_into(piece, content[filled : filled + size])
            filled += size

    def _untouched(self) -> Words:
        """Pages of files without a name that the process has mapped for itself, and has no copy of."""
        if not len(self._orphans):
            return NONE
        return page_set.difference(self._orphans, self._page_tables.existing(self._orphans))

    def leave_out(self, places: SharedPlaces) -> None:
        """Do not tell of shared memory that another process of the component tells of."""
        if places != self._told_elsewhere:
            self._told_elsewhere = places
            self._sort_shared()

    def detach(self, objects: Collection[Object]) -> None:
        """Tell of these shared objects as of ones without a name: all that they hold, also what is mapped to be read alone."""
        if objects != self._detached:
            self._detached = objects
            self._sort()

    def shared_places(self) -> SharedPlaces:
        """The shared memory that this process tells all of, as `leave_out` takes it."""
        may_look = digest_tracker.may_look_into_mappings()  # of a file with a name each tells what it has in its page tables
        told = (
            one
            for one in self.lines
            if memory_tracker.is_shared_object(one) or (may_look and memory_tracker.is_shared_anonymous(one))
        )
        return frozenset(map(_place_of, told))

    def _sort_shared(self) -> None:
        self._shared_lines = [
            line
            for line in self.lines
            if (memory_tracker.is_shared(line) and not _is_within(line, self._told_elsewhere)) or memory_tracker.is_orphan(line)
        ]

    def refresh(self) -> None:
        """Read and sort the mappings; that they have changed is kept until the tracker has been told."""
        if self._maps.refresh():
            self._sort()
        self._maps.prepare()

    def _refresh_if_moved(self) -> None:
        """As `refresh`, where only names may have changed since."""
        if self._maps.refresh_if_moved():
            self._sort()

    def _sort(self) -> None:
        self._has_moved = True
        theirs = (line for line in self._maps.lines if not self.borrowed.holds(line.start))
        told = (boards.as_told(self._memory.pid, line) for line in theirs)
        self.lines = tuple(seen_detached(line, self._detached) for line in told)
        self._private = [line for line in self.lines if memory_tracker.is_private(line)]
        self._sort_shared()
        self.has_rings = any(map(aio.is_ring, self._shared_lines))
        self.has_segments = any(map(system_v_memory.is_segment, self.lines))
        self._followed = memory_tracker.extents_of(self._private)
        self._orphans = memory_tracker.extents_of([line for line in self.lines if memory_tracker.is_orphan(line)])
        self._mapped = memory_tracker.extents_of([line for line in self.lines if line.name not in memory_tracker.NOT_CARRIED])
        self._of_files = memory_tracker.extents_of([line for line in self.lines if line.has_file])
        self._vdso = memory_tracker.extents_of([line for line in self.lines if line.name == VDSO])
        self._boards = memory_tracker.extents_of([line for line in self.lines if line.name == memory_tracker.BOARD])

    def _scan(self, *, everywhere: bool) -> Scan:
        """The pages written since the last scan. A scan that fails half-way has protected pages without telling which."""
        try:
            scan = self._tracker.scan(self._private, changed=self._has_moved, everywhere=everywhere)
        except CaptureError:
            self.start_over()
            raise
        self._has_moved = False
        board = page_set.difference(self._boards, self._boards_named) if len(self._boards) else NONE
        self._boards_named = self._boards
        if len(board):  # earlier content there is to come back as zeros
            scan = Scan(scan.written, page_set.union(scan.cleared, board))
        if not self._shared_lines and not self._had_shared:
            return scan
        self._had_shared = bool(self._shared_lines)
        shared = self._shared.scan(self._shared_lines)
        orphans = memory_tracker.extents_of([line for line in self._shared_lines if memory_tracker.is_orphan(line)])
        # The tracker's answers about orphans date from before their file was deleted.
        cleared = page_set.difference(scan.cleared, orphans)
        return Scan(page_set.union(scan.written, shared.written), page_set.union(cleared, shared.cleared))

    def _remember(self, scan: Scan) -> None:
        """Keep what a scan found until it is acknowledged; one that has become no snapshot is joined with the next."""
        self._guards.named(scan)
        self._join()
        self._unacknowledged.append(Unacknowledged(None, scan.written, scan.cleared))
        self._join()

    def _join(self) -> None:
        """Join the scans that have no position yet."""
        left_out, self._left_out = self._left_out, NONE
        self._unacknowledged = with_one_tail(self._unacknowledged, self._mapped, left_out)
        if len(self._unacknowledged) > UNACKNOWLEDGED_LIMIT:
            oldest, next_one, *rest = self._unacknowledged
            self._unacknowledged = [joined(oldest, next_one), *rest]

    def _since_acknowledged(self, *, base: bool) -> tuple[Words, Words]:
        """The pages that a delta must carry: the union of all scans since. A base needs those that are in no snapshot yet."""
        self._join()
        return since(self._unacknowledged, self._mapped, is_base=base)
