"""The rules that every snapshot must fulfil: checked before one is written and before a decoded one is used."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from itertools import pairwise

from checkpoint.errors import FormatError
from checkpoint.model import OutputPiece, PageCopy, PageRun, Position, Snapshot, ThreadState, Vma
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Mappings
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot.canonical_state import STATE_DIGEST_SIZE
from checkpoint.snapshot.layout import MAX_CONTENTS_SIZE
from checkpoint.snapshot.process_tree import SLOT_LIMIT, SLOT_SHIFT, every_mapping, shifted_runs

MIN_PAGE_SIZE = 4096
MAX_PAGE_SIZE = 1 << 16
"""Page sizes of the kernels that we know: 4, 16 and 64 KiB."""

ADDRESS_END = (1 << 64) - MAX_PAGE_SIZE
"""Nothing is mapped from here on: the end of a run must itself be an address."""

MAX_NUMBER = (1 << 63) - 1
"""Largest generation, sequence or epoch."""

STREAMS = (1, 2)
"""Standard output and standard error."""


def check_snapshot(snapshot: Snapshot, contents_size: int | None = None) -> None:
    """Refuse a snapshot that does not hold together.

    Args:
        contents_size: bytes of contents, where they are not in ``snapshot.contents`` yet.

    Raises:
        FormatError: names the first thing that cannot be.
    """
    page_size = snapshot.machine.page_size
    if page_size not in range(MIN_PAGE_SIZE, MAX_PAGE_SIZE + 1) or page_size & (page_size - 1):
        raise FormatError(f"machine: page size {page_size} is not a power of two from {MIN_PAGE_SIZE} to {MAX_PAGE_SIZE}")
    _check_numbers(snapshot)
    _check_mappings(snapshot.vmas, page_size, "vmas")
    _check_extents(snapshot.cleared, page_size, "cleared runs")
    carried = page_set.joined(_check_extents(snapshot.runs, page_size, "runs"))
    _check_members(snapshot, page_size)
    _check_mapped(carried, snapshot)
    _check_copies(snapshot, page_size)
    _check_differences(snapshot, page_size, carried)
    _check_guards(snapshot, page_size, carried)
    _check_contents(snapshot, len(memoryview(snapshot.contents).cast("B")) if contents_size is None else contents_size)
    _check_threads(snapshot.process.pid, snapshot.threads)
    _check_output(snapshot.output)


def _check_numbers(snapshot: Snapshot) -> None:
    _check_position(snapshot.position, "position")
    if snapshot.parent is not None:
        _check_position(snapshot.parent, "parent")
        parent, position = snapshot.parent, snapshot.position
        if (parent.generation, parent.sequence) >= (position.generation, position.sequence):
            raise FormatError(f"parent {place(parent)} is not before position {place(position)}")
    if len(snapshot.page_sum) != page_set.DIGEST_SIZE:
        raise FormatError(f"page sum: {len(snapshot.page_sum)} bytes where {page_set.DIGEST_SIZE} belong")
    for name, number in (("epoch", snapshot.epoch), ("freeze_us", snapshot.freeze_us)):
        if not 0 <= number <= MAX_NUMBER:
            raise FormatError(f"{name}: {number} is not from 0 to {MAX_NUMBER}")


def _check_position(position: Position, name: str) -> None:
    if not (0 <= position.generation <= MAX_NUMBER and 0 <= position.sequence <= MAX_NUMBER):
        raise FormatError(f"{name}: {place(position)} is not of numbers from 0 to {MAX_NUMBER}")
    if len(position.digest) != STATE_DIGEST_SIZE:
        raise FormatError(f"{name}: a digest of {len(position.digest)} bytes where {STATE_DIGEST_SIZE} belong")


def place(position: Position) -> str:
    """A position in words, for messages: ``3.17``."""
    return f"{position.generation}.{position.sequence}"


def _check_mappings(vmas: tuple[Vma, ...], page_size: int, name: str) -> None:
    """As `_check_extents`, once for the same ones."""
    if isinstance(vmas, Mappings) and vmas.sound_for == page_size:
        return
    bounds = _check_extents(vmas, page_size, name)
    if isinstance(vmas, Mappings):
        vmas.sound_for = page_size
        vmas.know(bounds)


def _check_extents(items: Iterable[PageRun | PageCopy | Vma], page_size: int, name: str) -> page_set.Words:
    """Aligned, not empty, in address order, without overlap: start and end of each."""
    edges = [edge for item in items for edge in (item.start, item.end)]
    if not edges:
        return np.empty((0, 2), dtype=np.uint64)
    if not 0 <= min(edges) <= max(edges) <= ADDRESS_END or any(map(operator.ge, edges[::2], edges[1::2])):
        start, end = next(pair for pair in zip(edges[::2], edges[1::2], strict=True) if not 0 <= pair[0] < pair[1] <= ADDRESS_END)
        raise FormatError(f"{name}: {start:#x}-{end:#x} is empty or beyond the address space")
    bounds = np.array(edges, dtype=np.uint64).reshape(-1, 2)
    if int(np.bitwise_or.reduce(bounds, axis=None)) & (page_size - 1):
        unaligned = np.flatnonzero((bounds & np.uint64(page_size - 1)).any(axis=1))
        raise FormatError(f"{name}: {_span(bounds, unaligned[0])} is not of whole pages of {page_size} bytes")
    if (bounds[1:, 0] < bounds[:-1, 1]).any():
        early = np.flatnonzero(bounds[1:, 0] < bounds[:-1, 1])
        raise FormatError(f"{name}: {_span(bounds, early[0] + 1)} overlaps or comes before {_span(bounds, early[0])}")
    return bounds


def _span(bounds: page_set.Words, index: np.intp) -> str:
    return f"{int(bounds[index, 0]):#x}-{int(bounds[index, 1]):#x}"


def _check_members(snapshot: Snapshot, page_size: int) -> None:
    """Slots in order, addresses inside them, ids once, parents that are there."""
    slots = [0, *(member.slot for member in snapshot.members)]
    if any(later <= earlier for earlier, later in pairwise(slots)) or slots[-1] >= SLOT_LIMIT:
        raise FormatError(f"members: slots {slots[1:]} are not in order, from 1 to {SLOT_LIMIT - 1}")
    processes = [snapshot.process, *(member.process for member in snapshot.members)]
    pids = [process.pid for process in processes]
    every = [*pids, *(zombie.pid for zombie in snapshot.zombies)]
    if len(set(every)) != len(every):
        raise FormatError("members: two have the same pid")
    for pid, parent in (
        *((process.pid, process.ppid) for process in processes[1:]),
        *((zombie.pid, zombie.ppid) for zombie in snapshot.zombies),
    ):
        if parent not in (0, *pids) or parent == pid:
            raise FormatError(f"members: the parent {parent} of {pid} is none of them")
    _check_descent({process.pid: process.ppid for process in processes[1:]})
    for member in snapshot.members:
        _check_mappings(member.vmas, page_size, f"vmas of {member.process.pid}")
        if member.vmas and member.vmas[-1].end > 1 << SLOT_SHIFT:
            raise FormatError(f"vmas of {member.process.pid}: beyond its slot")
        if not member.threads:
            raise FormatError(f"threads of {member.process.pid}: there are none")
        _check_threads(member.process.pid, member.threads)


def _check_descent(parents: Mapping[int, int]) -> None:
    """No process is an ancestor of its own: the way up from each ends at the first process, or at a parent that is not listed."""
    settled: set[int] = set()
    for pid in parents:
        line: set[int] = set()
        while pid in parents and pid not in settled:
            if pid in line:
                raise FormatError(f"members: {pid} is an ancestor of its own")
            line.add(pid)
            pid = parents[pid]
        settled |= line


def _check_mapped(carried: page_set.Words, snapshot: Snapshot) -> None:
    mapped = page_set.extents(every_mapping(snapshot))
    if not page_set.covers(mapped, carried):
        stray = page_set.difference(carried, mapped)
        raise FormatError(f"runs: {_span(stray, np.intp(0))} lies in no mapping")


def _check_copies(snapshot: Snapshot, page_size: int) -> None:
    """Copies are of several processes, lie in mappings and not among the carried runs, and each is of a part of one of those."""
    if not snapshot.copies:
        return
    if not snapshot.is_tree:
        raise FormatError("copies: one process alone has none")
    _check_extents(snapshot.copies, page_size, "copies")
    targets, carried = page_set.extents(snapshot.copies), page_set.extents(snapshot.runs)
    _check_mapped(targets, snapshot)
    if len(twice := page_set.intersection(targets, carried)):
        raise FormatError(f"copies: {_span(twice, np.intp(0))} is carried, too")
    sources = [PageRun(copy.source, copy.source + copy.size) for copy in snapshot.copies]
    if any(run.start < 0 or run.end > ADDRESS_END or run.start & (page_size - 1) for run in sources):
        raise FormatError("copies: a source is not of whole pages, or beyond the address space")
    if len(stray := page_set.difference(page_set.extents(sources), carried)):
        raise FormatError(f"copies: {_span(stray, np.intp(0))}, of which one is, is not carried")
    size = sum(copy.size for copy in snapshot.copies) + sum(run.size for run in snapshot.runs)
    if size > MAX_CONTENTS_SIZE:
        raise FormatError(f"copies: {size} bytes with their sources, above the limit of {MAX_CONTENTS_SIZE}")


def _check_differences(snapshot: Snapshot, page_size: int, carried: page_set.Words) -> None:
    """Differences are of a delta, carried, from a page that is still there when they are applied, and no copy is of one."""
    if not snapshot.differences:
        return
    if snapshot.parent is None:
        raise FormatError("differences: a base has nothing that they could be from")
    told = page_set.joined(_check_extents(snapshot.differences, page_size, "differences"))
    if not page_set.covers(carried, told):
        stray = page_set.difference(told, carried)
        raise FormatError(f"differences: {_span(stray, np.intp(0))} is not carried")
    sources = page_set.extents(PageRun(copy.source, copy.source + copy.size) for copy in snapshot.copies)
    for what, others in (("cleared", page_set.extents(snapshot.cleared)), ("copied", sources)):
        if len(both := page_set.intersection(told, others)):
            raise FormatError(f"differences: {_span(both, np.intp(0))} is {what}, too")


def _check_guards(snapshot: Snapshot, page_size: int, carried: page_set.Words) -> None:
    """Guards lie inside their own mapping and hold nothing."""
    for slot, vmas in ((0, snapshot.vmas), *((member.slot, member.vmas) for member in snapshot.members)):
        guarded = vmas.guarded if isinstance(vmas, Mappings) else [vma for vma in vmas if vma.guards]
        if not guarded:
            continue
        for vma in guarded:
            _check_extents(vma.guards, page_size, "guards")
            if vma.guards[0].start < vma.start or vma.guards[-1].end > vma.end:
                raise FormatError(f"guards: not all inside their mapping {vma.start:#x}-{vma.end:#x}")
        every = page_set.extents(shifted_runs((guard for vma in guarded for guard in vma.guards), slot))
        if len(both := page_set.intersection(every, carried)):
            raise FormatError(f"guards: {_span(both, np.intp(0))} is carried, too")


def _check_contents(snapshot: Snapshot, contents_size: int) -> None:
    needed = sum(run.size for run in snapshot.runs)
    if needed != contents_size:
        raise FormatError(f"contents: {contents_size} bytes where the runs need {needed}")


def _check_threads(pid: int, threads: tuple[ThreadState, ...]) -> None:
    tids = [thread.tid for thread in threads]
    if len(set(tids)) != len(tids):
        raise FormatError("threads: two have the same id")
    if tids and tids[0] != pid:
        raise FormatError(f"threads: the first is {tids[0]}, of process {pid}")


def _check_output(output: tuple[OutputPiece, ...]) -> None:
    """Streams that exist, pieces of one stream in order and without overlap."""
    for piece in output:
        if piece.stream not in STREAMS or not 0 <= piece.offset <= MAX_NUMBER:
            raise FormatError(f"output: stream {piece.stream} at offset {piece.offset} cannot be")
    for stream in STREAMS:
        ours = [piece for piece in output if piece.stream == stream]
        for earlier, later in pairwise(ours):
            if later.offset < earlier.offset + len(earlier.content):
                raise FormatError(f"output: pieces of stream {stream} overlap at offset {later.offset}")
