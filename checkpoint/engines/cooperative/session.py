"""A session of the cooperative engine: makes snapshots of a program's committed state. It freezes and traces no process.

A cooperative snapshot has the ordinary format: its mappings are the segment's regions at made-up addresses, its runs are the
pages that changed. It has no threads. Its facts about the process are those that ``/proc`` shows to every user. A resource of
kind "task" says what the pages mean:

    arguments   of the program, as it was started
    directory   its working directory
    age         nanoseconds between the commit and the snapshot
    commit      number of the commit, in its lineage
    regions     [kind, size] of each region, in the order of the mappings

The output in a snapshot ends at the position that the record of the commit names, which is where the program was at its commit.
After a restore the program prints later output again, and does not print earlier output again. If a commit names no position, the
output ends where the stream was before the engine read the commit.

A delta is made against the acknowledged snapshot, as in other engines: it holds the pages whose version is later than the
acknowledged commit.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engine import COOPERATIVE, CaptureOrder
from checkpoint.errors import CaptureError, NothingCommittedError, RestoreError, SegmentError, UnsupportedError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import spokesman_of, told_by_spokesman
from checkpoint.model import (
    Clocks,
    Credentials,
    Fact,
    FileIdentity,
    Machine,
    MemoryLayout,
    Position,
    ProcessState,
    Resource,
    Snapshot,
    Vma,
    VmaKind,
)
from checkpoint.pages import page_set
from checkpoint.pages.page_set import PageTable, Words
from checkpoint.runtime.lazy_numpy import NDArray, np
from checkpoint.segment.layout import PAGE, PENDING, Committed, Layout, Pending, Region
from checkpoint.segment.output_counters import Totals
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.writer import HANDED_NAME, SegmentWriter, Source
from checkpoint.segment.writer import NAME as SEGMENT_NAME
from checkpoint.snapshot import carried_files
from checkpoint.store.chain import position_of

if TYPE_CHECKING:
    from checkpoint.engines.stream_output import Outputs
    from checkpoint.resources.carried.capture import CarriedTrees, Parcel, Seen

KIND: Final = "task"
MAX_WAITING: Final = 64
"""Captures that wait for their acknowledgement; of older ones none is expected any more."""


class _Mark(Struct, frozen=True, eq=False):
    """A commit that was captured.

    Attributes:
        commit: its number.
        lineage: in which that number counts.
        clocks: the machine's, at that commit.
        totals: bytes of output at that commit.
    """

    position: Position
    commit: int
    lineage: bytes
    clocks: Clocks
    table: PageTable
    totals: Totals


class CooperativeSession:
    """One segment that is followed. See `checkpoint.engine.Session`; every call comes from one thread."""

    notes: tuple[str, ...] = ()

    def __init__(
        self,
        reader: SegmentReader,
        pid: int,
        component: str,
        outputs: Outputs | None = None,
        trees: CarriedTrees | None = None,
    ) -> None:
        self._pid = pid
        self._trees = trees
        self.totals: Totals = (0, 0)
        self._outputs = outputs
        self._reader = reader
        self._component = component
        self._process = told_by_spokesman(pid, describe_process)
        self._directory = self._process.working_directory
        self.program: tuple[Resource, ...] = ()
        """The files from which it is started again, as `checkpoint.engines.cooperative.program_files` tells them."""
        self._waiting: deque[_Mark] = deque(maxlen=MAX_WAITING)
        self._acknowledged: _Mark | None = None

    @property
    def process(self) -> ProcessState:
        """The process that keeps the state, as it was when it was first looked at."""
        return self._process

    @property
    def reader(self) -> SegmentReader:
        """The segment that is read now."""
        return self._reader

    def go_on_in(self, reader: SegmentReader) -> None:
        """The program has handed over another segment, which takes the place of this one."""
        self._reader.close()
        self._reader = reader

    def capture(self, order: CaptureOrder) -> Snapshot:
        """Make a snapshot of the newest commit.

        Raises:
            NothingCommittedError: there is none.
            SegmentError: the program does not keep the rules of its segment, or the bank was busy.
        """
        layout = self._reader.layout
        parent = None if order.base else self._acknowledged
        if parent is not None and parent.lineage != layout.lineage:
            parent = None
        until_now = self._outputs.totals() if self._outputs else (0, 0)
        with _admitted(order, self._pid, stands_still=self._trees is not None and not order.hold):
            committed, seen = self._look(parent, is_held=order.hold)
        if committed is None and parent is None:
            raise NothingCommittedError(f"cannot capture {self._component}: it has committed nothing yet")
        if committed is None or (parent is not None and self._outputs and committed.outputs is PENDING):
            committed = _nothing_since(parent, layout)
        totals = self._totals_of(committed, until_now) if self._outputs else (0, 0)
        parcel = self._trees.parcel(seen, parent.position if parent else None) if self._trees and seen else None
        snapshot, table = self._snapshot(committed, parent, order, totals, parcel)
        if self._trees:
            self._trees.settle(snapshot.position)
        self._waiting.append(_Mark(snapshot.position, committed.number, layout.lineage, committed.clocks, table, totals))
        self.totals = totals
        return snapshot

    def _look(self, parent: _Mark | None, *, is_held: bool) -> tuple[Committed | None, Seen | None]:
        """The newest commit, and the carried files of an instant at which it was the newest: the program stands still meanwhile.

        Args:
            is_held: it stands still already.

        Raises:
            UnsupportedError: a file cannot be carried.
            CaptureError: it could not be made to stand still, or the files change all the same.
        """
        since = parent.commit if parent else 0
        if self._trees is None:
            return self._reader.read(since), None
        from checkpoint.resources.carried.capture import mapped_shared

        self._trees.prepare(told_by_spokesman(self._pid, mapped_shared))
        with contextlib.nullcontext() if is_held else _standing_still(self._pid):
            seen = self._trees.look(told_by_spokesman(self._pid, mapped_shared))
            committed = self._reader.read(since)
        if reasons := self._trees.reasons(seen):
            raise UnsupportedError(f"cannot capture {self._component}: {'; '.join(reasons)}", reasons)
        return committed, seen

    def _totals_of(self, committed: Committed, until_now: Totals) -> Totals:
        """Where the output of a commit ends.

        Raises:
            CaptureError: it does not know; it says that it wrote more than there is, or takes back what it said.
        """
        assert self._outputs is not None, "the caller counts the output"
        if isinstance(committed.outputs, Pending):
            raise CaptureError(
                f"cannot capture {self._component}: at its commit {committed.number} its output had no room in the pipe to its "
                "guard; it is captured with its next commit, once the guard has emptied the pipe"
            )
        if committed.outputs is None:
            return until_now
        now_written = self._outputs.totals()
        for end, before, most in zip(committed.outputs, self.totals, now_written, strict=True):
            if not before <= end <= most:
                raise CaptureError(
                    f"cannot capture {self._component}: commit {committed.number} claims {end} bytes of output, where {before} "
                    f"to {most} were written; the program does not keep the rules of its segment"
                )
        return committed.outputs

    def acknowledge(self, position: Position) -> None:
        """See `checkpoint.engine.Session.acknowledge`."""
        for mark in self._waiting:
            if mark.position == position:
                self._acknowledged = mark
                if self._trees:
                    self._trees.keep((position, *(waiting.position for waiting in self._waiting)))

    def unchanged(self) -> Position | None:
        """The newest acknowledged position, if nothing was committed since; then a capture would say nothing new."""
        known = self._acknowledged
        if known is None or (known.commit, known.lineage) != (self._reader.newest(), self._reader.layout.lineage):
            return None
        return known.position

    def commit_at(self, position: Position) -> int:
        """The number of the commit that a capture of this session holds; 0 if it is none of the last ones."""
        mark = self._mark_at(position)
        return mark.commit if mark else 0

    def committed_ns(self, position: Position) -> int:
        """CLOCK_BOOTTIME at that commit, as its program says; now, if it is none of the last ones."""
        mark = self._mark_at(position)
        return mark.clocks.boottime_ns if mark else now().boottime_ns

    def _mark_at(self, position: Position) -> _Mark | None:
        known = [*self._waiting, self._acknowledged] if self._acknowledged else self._waiting
        return next((mark for mark in known if mark.position == position), None)

    def close(self) -> None:
        """See `checkpoint.engine.Session.close`."""
        self._reader.close()

    def _snapshot(
        self, committed: Committed, parent: _Mark | None, order: CaptureOrder, totals: Totals, parcel: Parcel | None
    ) -> tuple[Snapshot, PageTable]:
        addresses, contents = committed.layout.addresses()[committed.pages.astype(np.int64)], committed.contents
        if parcel is not None and len(parcel.addresses):
            addresses, contents = np.concatenate((addresses, parcel.addresses)), memoryview(b"".join((contents, parcel.content)))
        runs = page_set.page_runs(page_set.extents_of_addresses(addresses, PAGE))
        vmas = (*(_vma(region) for region in committed.layout.regions), *(parcel.vmas if parcel else ()))
        cleared = parcel.cleared if parcel and parent else ()
        table = (parent.table if parent else PageTable.empty(PAGE)).apply(cleared, runs, contents, vmas)
        made = Snapshot(
            component=self._component,
            engine=COOPERATIVE,
            position=Position(order.generation, order.sequence, bytes(16)),
            parent=parent.position if parent else None,
            machine=this_machine(order.robot),
            clocks=committed.clocks,
            process=self._process,
            threads=(),
            vmas=vmas,
            resources=(
                Resource(KIND, self._component, self._facts(committed)),
                *self.program,
                *(parcel.resources if parcel else ()),
            ),
            cleared=cleared,
            runs=runs,
            contents=contents,
            page_sum=table.page_sum,
            epoch=order.epoch,
            output=self._outputs.pieces(parent.totals if parent else (0, 0), totals) if self._outputs else (),
        )
        return replace(made, position=position_of(made, order.generation, order.sequence)), table

    def _facts(self, committed: Committed) -> dict[str, Fact]:
        return {
            "age": max(now().boottime_ns - committed.clocks.boottime_ns, 0),
            "arguments": list(self._process.arguments),
            "commit": committed.number,
            "directory": self._directory,
            "regions": [[region.kind, region.size] for region in committed.layout.regions],
        }


@contextlib.contextmanager
def _admitted(order: CaptureOrder, pid: int, *, stands_still: bool) -> Iterator[None]:
    """Ask the gate before the body: a program that runs at its times commits, and its files rest, between two of them."""
    if order.gate is None:
        yield
        return
    while not order.gate.opens((pid,)):
        pass
    try:
        yield
    finally:
        order.gate.closes(stood_still=stands_still)


@contextlib.contextmanager
def _standing_still(pid: int) -> Iterator[None]:
    """Hold all threads of a program for the body.

    Raises:
        CaptureError: it cannot be held.
    """
    from checkpoint.linux.trace.threads import Threads
    from checkpoint.linux.trace.tracee import Tracee

    threads = Threads(Tracee(spokesman_of(pid)), process=pid)
    threads.freeze()
    try:
        yield
    finally:
        threads.thaw()


def _nothing_since(parent: _Mark | None, layout: Layout) -> Committed:
    """The commit that was acknowledged, once more."""
    assert parent is not None, "a whole state is something"
    return Committed(layout, parent.commit, parent.clocks, np.empty(0, dtype=np.uint64), memoryview(b""), parent.totals)


def now() -> Clocks:
    """This machine's clocks."""
    return Clocks(*(time.clock_gettime_ns(clock) for clock in (time.CLOCK_REALTIME, time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME)))


def _vma(region: Region) -> Vma:
    return Vma(region.address, region.end, abi.PROT_READ | abi.PROT_WRITE, False, VmaKind.ANONYMOUS, name=region.name)


def this_machine(robot: str) -> Machine:
    """Where we run. The page size is the segment's, so that machines with other pages can take a snapshot up."""
    about = os.uname()
    with open("/proc/sys/kernel/random/boot_id") as file:
        boot_id = file.read().strip()
    return Machine(about.machine, PAGE, about.release, boot_id, socket.gethostname(), robot=robot)


def describe_process(pid: int) -> ProcessState:
    """The state of a program whose memory is not carried: its identity and how it was started.

    Args:
        pid: the id by which we look at it (`checkpoint.linux.procfs.live_thread`).

    Raises:
        ProcessGoneError: it ended.
    """
    status = procfs.status(pid)
    arguments = procfs.read_bytes(pid, "cmdline").rstrip(b"\0").split(b"\0")
    return ProcessState(
        pid=status.tgid,
        ppid=0,
        pgid=0,
        sid=0,
        executable=FileIdentity(procfs.read_link(pid, "exe")),
        arguments=tuple(word.decode(errors="replace") for word in arguments),
        layout=MemoryLayout(*(0,) * 11),
        working_directory=procfs.read_link(pid, "cwd"),
        root_directory="/",
        umask=0,
        credentials=Credentials(status.uids, status.gids, status.groups),
    )


# Finding the segment of a program that has not handed it to a guard


def open_segment(pid: int) -> SegmentReader:
    """The segment that a process commits to, found among its descriptors.

    Args:
        pid: the id by which we look at it (`checkpoint.linux.procfs.live_thread`).

    Raises:
        CaptureError: it has none, or several, or is another user's.
    """
    folder = f"/proc/{pid}/fd"
    try:
        found = [name for name in os.listdir(folder) if SEGMENT_NAME in _link(f"{folder}/{name}")]
    except OSError as error:
        raise CaptureError(f"cannot look for the segment of pid {pid}: {error.strerror}") from error
    for name in sorted(found, key=int, reverse=True):
        descriptor = os.open(f"{folder}/{name}", os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # never wait, also for a pipe
        try:
            reader = SegmentReader(descriptor)
        finally:
            os.close(descriptor)
        if not reader.is_superseded:
            return reader
        reader.close()
    raise CaptureError(f"pid {pid} has no segment: it keeps no state by failover, or has not committed yet")


def _link(path: str) -> str:
    try:
        return os.readlink(path)
    except FileNotFoundError:
        return ""


# Back from a snapshot


def regions_of(state: Snapshot) -> tuple[tuple[Region, NDArray[np.uint8]], ...]:
    """The regions of a folded base, each with its bytes (whole pages).

    Raises:
        RestoreError: it is no snapshot of this engine, or contradicts itself.
    """
    if state.engine != COOPERATIVE or not state.is_base:
        raise RestoreError(
            f"cannot restore {state.component}: it is no whole snapshot of the {COOPERATIVE} engine but of {state.engine}"
        )
    state = carried_files.without(state)
    regions = tuple(_region(vma, kind, size) for vma, (kind, size) in zip(state.vmas, _sizes(state), strict=True))
    try:
        Layout(regions, bytes(16)).check()
    except SegmentError as error:
        raise RestoreError(f"cannot restore {state.component}: {error}") from error
    contents = np.frombuffer(state.contents, dtype=np.uint8)
    addresses = page_set.addresses_of(page_set.extents(state.runs), PAGE)
    return tuple((region, _filled(region, addresses, contents)) for region in regions)


def age_ns(state: Snapshot) -> int:
    """How old the commit in a snapshot was when it was taken; 0 of a snapshot of another engine, or of one that does not say."""
    age = next((held.facts.get("age") for held in state.resources if held.kind == KIND), 0)
    return max(age, 0) if isinstance(age, int) else 0


def _sizes(state: Snapshot) -> list[tuple[int, int]]:
    facts = next((held.facts for held in state.resources if held.kind == KIND), {})
    listed = facts.get("regions")
    pairs = [pair for pair in listed if isinstance(pair, list) and len(pair) == 2] if isinstance(listed, list) else []
    sizes = [(kind, size) for kind, size in pairs if isinstance(kind, int) and isinstance(size, int)]
    if len(sizes) != len(state.vmas) or state.machine.page_size != PAGE:
        raise RestoreError(f"cannot restore {state.component}: its snapshot does not describe its pages")
    return sizes


def _region(vma: Vma, kind: int, size: int) -> Region:
    region = Region(vma.name, kind, vma.start, size)
    if region.end != vma.end:
        raise RestoreError(f"cannot restore region {vma.name!r}: {size} bytes do not fill the pages that its snapshot has")
    return region


def _filled(region: Region, addresses: Words, contents: NDArray[np.uint8]) -> NDArray[np.uint8]:
    found = np.zeros(region.page_count * PAGE, dtype=np.uint8)
    low, high = np.searchsorted(addresses, np.array([region.address, region.end], dtype=np.uint64))
    places = ((addresses[low:high] - np.uint64(region.address)) // np.uint64(PAGE)).astype(np.int64)
    found.reshape(-1, PAGE)[places] = contents.reshape(-1, PAGE)[low:high]
    return found


def fill_segment(state: Snapshot) -> SegmentWriter:
    """A segment that holds the state of a folded base as its first commit: what a waiting program is handed.

    Raises:
        RestoreError: it is no snapshot of this engine, or contradicts itself.
    """
    regions = regions_of(state)
    writer = SegmentWriter(Layout(tuple(region for region, _ in regions), secrets.token_bytes(16)), name=HANDED_NAME)
    assert writer.commit([Source(content[: region.size]) for region, content in regions]), "a new segment has no reader yet"
    return writer
