"""Convert between one snapshot of a component of several processes and one snapshot of each process.

Every process has an address space of its own, and the snapshot one set of pages: page ``address`` of the process in slot ``n`` is
stored as ``address + n × 2⁴⁸``. The first process has slot 0, so a snapshot of one process keeps its earlier form, and the rules
of chains, sums and frames hold for trees without change.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.model import PageCopy, PageRun, Snapshot, Vma
from checkpoint.pages import page_set
from checkpoint.runtime.lazy_numpy import NDArray, np

SLOT_SHIFT: Final = 48
"""Addresses of programs are below 2⁴⁷ on x86-64 (and below 2⁴⁸ on aarch64)."""
SLOT_LIMIT: Final = 1 << 14
"""Processes of one component."""
COMPARED_AT_ONCE: Final = 1024
"""Pairs of pages: 8 MiB, which the allocator gives again and again without asking the kernel."""


def base_of(slot: int) -> int:
    """Where the pages of a slot begin."""
    return slot << SLOT_SHIFT


def whole(slot: int) -> PageRun:
    """All pages of a slot."""
    return PageRun(base_of(slot), base_of(slot + 1))


def shifted_runs(runs: Iterable[PageRun], slot: int) -> tuple[PageRun, ...]:
    """Runs of a slot's process as the snapshot has them."""
    base = base_of(slot)
    return tuple(PageRun(run.start + base, run.end + base) for run in runs)


def every_mapping(snapshot: Snapshot) -> Sequence[Vma | PageRun]:
    """The mappings of all its processes, in the order of the snapshot's pages."""
    if not snapshot.members:
        return snapshot.vmas
    found: list[Vma | PageRun] = [*snapshot.vmas]
    for member in snapshot.members:
        base = base_of(member.slot)
        found += [PageRun(vma.start + base, vma.end + base) for vma in member.vmas]
    return found


def expanded(snapshot: Snapshot) -> Snapshot:
    """The same, with every page told by its bytes; an outline, which has none, as it is."""
    if not snapshot.copies or not len(snapshot.contents):
        return replace(snapshot, copies=())
    page_size = snapshot.machine.page_size
    addresses, places = page_set.with_copied(snapshot.runs, snapshot.copies, page_size)
    contents = np.frombuffer(snapshot.contents, dtype=np.uint8).reshape(-1, page_size)[places]
    runs = page_set.page_runs(page_set.extents_of_addresses(addresses, page_size))
    return replace(snapshot, runs=runs, contents=contents.reshape(-1).data, copies=())


def told_once(runs: Iterable[PageRun], contents: memoryview, page_size: int) -> tuple[Runs, memoryview, tuple[PageCopy, ...]]:
    """The same pages, each content once: runs and bytes of those that are carried, and the copies."""
    addresses = page_set.addresses_of(page_set.extents(runs), page_size)
    rows = np.frombuffer(contents, dtype=np.uint8).reshape(-1, page_size)
    digests = page_set.digest_pages(contents, np.zeros_like(addresses), page_size)
    _, firsts, which = np.unique(digests, axis=0, return_index=True, return_inverse=True)
    places = firsts[which.reshape(-1)]
    is_copy = np.flatnonzero(places != np.arange(len(addresses)))
    is_copy = is_copy[_are_alike(rows, is_copy, places[is_copy])]
    if not len(is_copy):
        return tuple(runs), contents, ()
    kept = np.ones(len(addresses), dtype=np.bool_)
    kept[is_copy] = False
    copies = page_set.copies_of(addresses[is_copy], addresses[places[is_copy]], page_size)
    return page_set.page_runs(page_set.extents_of_addresses(addresses[kept], page_size)), rows[kept].reshape(-1).data, copies


def _are_alike(rows: NDArray[np.uint8], some: NDArray[np.intp], others: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether pages are equal, pair by pair; few at a time, in words, so that no second copy of all memory is made."""
    words = rows.view(np.uint64)
    begins = range(0, len(some), COMPARED_AT_ONCE)
    parts = [slice(begin, begin + COMPARED_AT_ONCE) for begin in begins]
    return np.concatenate([(words[some[part]] == words[others[part]]).all(axis=1) for part in parts] or [np.zeros(0, np.bool_)])


def views(snapshot: Snapshot) -> tuple[Snapshot, ...]:
    """Each process as a snapshot of its own, the first one first. Pages are not copied, but for ``copies``.

    Args:
        snapshot: a base, a delta that tells its pages whole, or an outline.
    """
    assert not (snapshot.differences and len(snapshot.contents)), "a difference is not the page"
    if not snapshot.is_tree:
        return (snapshot,)
    snapshot = expanded(snapshot)
    contents = memoryview(snapshot.contents).cast("B")
    places = _places(snapshot.runs)
    first = replace(snapshot, members=(), zombies=())
    others = [
        replace(
            first,
            process=member.process,
            threads=member.threads,
            vmas=member.vmas,
            resources=member.resources,
            output=(),
        )
        for member in snapshot.members
    ]
    slots = [0, *(member.slot for member in snapshot.members)]
    every = zip((first, *others), slots, strict=True)
    return tuple(
        replace(_with_pages(view, places, contents, slot), cleared=_of_slot(snapshot.cleared, slot)) for view, slot in every
    )


def _of_slot(runs: Sequence[PageRun], slot: int) -> Runs:
    """The part of them that is of one process, at its own addresses."""
    if not runs:
        return ()
    mine = page_set.intersection(page_set.extents(runs), page_set.extents([whole(slot)]))
    return page_set.page_runs(mine - np.uint64(base_of(slot)))


Runs = tuple[PageRun, ...]
Places = dict[int, tuple[list[PageRun], int]]
"""By slot: its runs, at the process's own addresses, and where their bytes begin."""


def _places(runs: Sequence[PageRun]) -> Places:
    found: Places = {}
    position = 0
    for run in runs:
        slot = run.start >> SLOT_SHIFT
        base = base_of(slot)
        found.setdefault(slot, ([], position))[0].append(PageRun(run.start - base, run.end - base))
        position += run.size
    return found


def _with_pages(view: Snapshot, places: Places, contents: memoryview, slot: int) -> Snapshot:
    runs, begin = places.get(slot, ([], 0))
    size = sum(run.size for run in runs)
    return replace(view, runs=tuple(runs), contents=contents[begin : begin + size])
