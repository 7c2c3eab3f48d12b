"""Work out what a delta changes in the mappings and pages of a standby copy, and the calls that apply it.

A page that a state does not hold has the content that its mapping gives it: zeros, or the file's bytes. So the copy drops
everything that a delta removes (madvise), and maps afresh what the delta maps in another way. Two mappings are the same if the
same object lies at the same place. Their protection and advice may differ; these are set at the end.

Memory that several processes share does not belong to their mappings: it lives, with its content, as long as any of these
processes. `held_of_objects` of all of them together says what a delta removes from it
(`checkpoint.engines.ptrace.standby_copy.tree`).

Sources: madvise(2), mmap(2).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.engines.ptrace.restore import memory as restored_memory
from checkpoint.engines.ptrace.restore.memory import (
    KERNEL_KINDS,
    NOTHING_PRESENT,
    Carried,
    Object,
    Present,
    first_protection,
    is_file_mapping,
)
from checkpoint.errors import RestoreError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Snapshot, Vma
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.sentences import copy_outdated

MADV_DONTNEED: Final = 4
MADV_REMOVE: Final = 9
NO_PAGES: Final[Words] = np.empty((0, 2), np.uint64)

Backing = tuple[object, ...]
"""The object that a mapping is of, and how it lies there."""


class Change(Struct, frozen=True):
    """From one position to the next.

    Attributes:
        gone: mapped no longer.
        fresh: to be mapped.
        dropped, removed: pages of private and of shared mappings that stay, to be as they were when they were mapped.
        protections: (start, end, protection) that other parts need while pages are written.
        carried: pages that the new state holds.
        rescued_pages: those that keep their content although they are mapped afresh.
        stiff: mappings that exist since birth, see `between`.
    """

    gone: Words
    fresh: tuple[Vma, ...]
    dropped: Words
    removed: Words
    protections: tuple[tuple[int, int, int], ...]
    carried: Words
    rescued_pages: Words
    stiff: Words = field(default_factory=lambda: NO_PAGES)

    @classmethod
    def between(cls, before: Sequence[Vma], held: Words, delta: Snapshot, stiff: Words = NO_PAGES) -> Change:
        """The changes that lead from mappings, and the pages held in them, to a delta's.

        Args:
            stiff: mappings with which a process was born: the kernel does not join them with later mappings beside them. A
                mapping that is new in part is mapped afresh as a whole (mremap(2) takes one mapping only).

        Raises:
            RestoreError: shared memory has grown in its place.
        """
        runs, cleared = page_set.extents(delta.runs), page_set.extents(delta.cleared)
        carried = page_set.union(page_set.difference(page_set.intersection(held, page_set.extents(delta.vmas)), cleared), runs)
        is_same = before == delta.vmas  # as of most deltas: they have written pages, and nothing else
        if is_same and np.array_equal(held, carried):  # what it clears it writes again, too
            return cls(NO_PAGES, (), NO_PAGES, NO_PAGES, (), carried, NO_PAGES, stiff)
        old, new = _ours(before), _ours(delta.vmas)
        gone, fresh_set = (NO_PAGES, NO_PAGES) if is_same else _moved(old, new)
        stiff = page_set.difference(page_set.difference(stiff, gone), fresh_set)
        torn_apart = [vma for vma in new if _is_partly(vma, stiff) and _is_partly(vma, fresh_set)] if len(stiff) else []
        fresh_set = page_set.union(fresh_set, _extents(torn_apart))
        fresh = tuple(piece for vma in new for piece in _pieces(vma, fresh_set)) if len(fresh_set) else ()
        emptied = page_set.intersection(page_set.intersection(cleared, held), _extents(new))
        lost = page_set.difference(page_set.difference(emptied, fresh_set), runs)
        shared, of_objects = _extents(vma for vma in new if vma.shared), _extents(filter(is_of_object, new))
        lost = page_set.difference(lost, of_objects)
        rescued = page_set.difference(page_set.difference(page_set.intersection(held, fresh_set), cleared), runs)
        rescued = page_set.difference(rescued, of_objects)
        return cls(
            gone,
            fresh,
            page_set.difference(lost, shared),
            page_set.intersection(lost, shared),
            tuple(_protections(old, Carried(held), new, Carried(carried), fresh_set)),
            carried,
            rescued,
            page_set.difference(stiff, fresh_set),
        )

    def fresh_files(self) -> list[Vma]:
        """The mappings to make that are of files with names."""
        return [vma for vma in self.fresh if is_file_mapping(vma)]

    def add_calls(
        self,
        table: CallTable,
        brought: Mapping[str, int],
        present: Present = NOTHING_PRESENT,
    ) -> None:
        """Add everything but the writing of pages.

        Args:
            brought: descriptors of what is mapped in place of this machine's files, by path.
            present: memory that several processes share.
        """
        for start, end in self.gone.tolist():
            table.call(f"unmap {start:#x} of the copy", "munmap", start, end - start)
        restored_memory.map_program(table, self.fresh, self.carried, brought, present)
        for advice, extents in ((MADV_DONTNEED, self.dropped), (MADV_REMOVE, self.removed)):
            for start, end in extents.tolist():
                table.call(f"empty {(end - start) >> 10} KiB at {start:#x}", "madvise", start, end - start, advice)
        for start, end, protection in self.protections:
            table.call(f"protect {start:#x}", "mprotect", start, end - start, protection)

    def rescued(self, memory: Memory) -> list[tuple[Words, bytearray]]:
        """The content of the pages that must outlive this change."""
        return [(self.rescued_pages, memory.read_pages(self.rescued_pages))] if len(self.rescued_pages) else []


def _is_partly(vma: Vma, some: Words) -> bool:
    """Whether some of a private mapping is in a set, and not all of it."""
    return not vma.shared and 0 < page_set.total_size(page_set.intersection(_extents([vma]), some)) < vma.size


def is_of_object(vma: Vma) -> bool:
    """Whether it shows memory that several processes may share, and that stays when it is unmapped here."""
    return restored_memory.is_anonymous_object(vma) or restored_memory.is_object_mapping(vma)


def held_of_objects(vmas: Iterable[Vma], held: Words) -> dict[Object, Words]:
    """Which parts of shared memory, by offset, the pages are that one process holds."""
    found: dict[Object, Words] = {}
    for vma in filter(is_of_object, vmas):
        part = page_set.intersection(held, _extents([vma]))
        if len(part):
            key = restored_memory.object_of(vma)
            found[key] = page_set.union(found.get(key, NO_PAGES), part - np.uint64(vma.start) + np.uint64(vma.offset))
    return found


def _ours(vmas: Iterable[Vma]) -> list[Vma]:
    """The mappings that a restore makes, in address order."""
    return sorted((vma for vma in vmas if vma.kind not in KERNEL_KINDS), key=lambda vma: vma.start)


def _extents(vmas: Iterable[Vma]) -> Words:
    return page_set.extents(vmas)


def backing(vma: Vma) -> Backing:
    """The object that it is of, the same for all parts that could be one mapping."""
    marks = "gd" in vma.flags, "nr" in vma.flags
    if is_file_mapping(vma):
        assert vma.file is not None
        return vma.file.path, vma.file.device, vma.file.inode, vma.start - vma.offset, *marks
    of_object = restored_memory.object_of(vma) if is_of_object(vma) else None
    return vma.shared, vma.start - vma.offset if vma.shared else 0, of_object, *marks


def _moved(old: Sequence[Vma], new: Sequence[Vma]) -> tuple[Words, Words]:
    """Ranges that are not mapped any more, or as something else; and ranges that are mapped afresh."""
    before, after = _by_backing(old), _by_backing(new)
    kept = NO_PAGES
    for key, extents in after.items():
        if key not in before or np.array_equal(before[key], extents):
            kept = page_set.union(kept, extents) if key in before else kept
            continue
        same = page_set.intersection(before[key], extents)
        is_of_one = key[0] is True and key[2] is None
        if is_of_one and len(same) and len(page_set.difference(extents, before[key])):
            raise RestoreError(copy_outdated("its shared memory has grown in its place"))
        kept = page_set.union(kept, same)
    return page_set.difference(_extents(old), kept), page_set.difference(_extents(new), kept)


def _by_backing(vmas: Iterable[Vma]) -> dict[Backing, Words]:
    groups: dict[Backing, list[Vma]] = {}
    for vma in vmas:
        groups.setdefault(backing(vma), []).append(vma)
    return {key: _extents(group) for key, group in groups.items()}


def _pieces(vma: Vma, wanted: Words) -> list[Vma]:
    """The parts of a mapping that lie in a set."""
    parts = page_set.intersection(_extents([vma]), wanted).tolist()
    return [replace(vma, start=start, end=end, offset=vma.offset + start - vma.start) for start, end in parts]


def _protections(
    old: Sequence[Vma], held: Carried, new: Sequence[Vma], carried: Carried, fresh: Words
) -> Iterable[tuple[int, int, int]]:
    """Where a kept mapping needs another protection than it has, and a mapped part needs that of its whole."""
    starts = [vma.start for vma in old]
    had = [first_protection(vma, held) for vma in old]
    for vma in new:
        wanted = first_protection(vma, carried)
        for piece in _pieces(vma, fresh) if len(fresh) else ():
            if first_protection(piece, carried) != wanted:
                yield piece.start, piece.end, wanted
        index = max(bisect_right(starts, vma.start) - 1, 0)
        while index < len(old) and old[index].start < vma.end:
            start, end = max(old[index].start, vma.start), min(old[index].end, vma.end)
            if start < end and had[index] != wanted:
                part = np.array([[start, end]], np.uint64)
                yield from ((first, last, wanted) for first, last in page_set.difference(part, fresh).tolist())
            index += 1
