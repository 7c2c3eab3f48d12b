"""Restore private memory that processes share since a fork, so that it exists once and not once for each process.

The restore puts content that is equal at the same address in several processes into the vessel of the first process, before it
creates the others. They inherit it, and the kernel keeps one copy until a process writes (copy-on-write). Each process keeps the
part that lies in mappings of its own, and gets the rest as usual.

Only plain memory counts: private, readable and writable, anonymous or of a file that has a name. Anonymous memory and the memory
of each file are compared separately. Pure except for the methods of `Inheritance`.

Source: fork(2); mmap(2).
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct, field

from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import MEMORY_PLACE
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Snapshot, Vma, VmaKind
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.runtime.lazy_numpy import NDArray
from checkpoint.store.member_pages import MemberPages

PLAIN_KINDS: Final = (VmaKind.ANONYMOUS, VmaKind.HEAP)
PLAIN_FLAGS: Final = frozenset(("dc", "dd", "hg", "mg", "nh", "rr", "sr", "wf", "mw"))
"""Codes that say nothing of how the mapping is made: advice, given later."""
COMPARED_AT_ONCE: Final = 1024
"""Pages."""
MADV_DONTNEED: Final = 4
NO_PAGES: Final[Words] = np.empty((0, 2), np.uint64)


class Legacy(Struct, frozen=True):
    """The memory that one process is born with.

    Attributes:
        kept: where it stays mapped.
        there: pages that hold what they must.
        stale: pages that hold what others have, and must be empty.
    """

    kept: Words = field(default_factory=lambda: NO_PAGES)
    there: Words = field(default_factory=lambda: NO_PAGES)
    stale: Words = field(default_factory=lambda: NO_PAGES)

    def without_kept(self, vma: Vma) -> tuple[tuple[int, int], ...]:
        """Start and end of the parts of a mapping that must be mapped."""
        if not (_is_plain(vma) or _file_of(vma)):
            return ((vma.start, vma.end),)
        return tuple((start, end) for start, end in page_set.difference(page_set.extents([vma]), self.kept).tolist())

    def empty_stale(self, table: CallTable) -> None:
        """Add the calls that give back what others have."""
        for start, end in self.stale.tolist():
            table.call(f"empty {(end - start) >> 10} KiB at {start:#x}", "madvise", start, end - start, MADV_DONTNEED)


class Told(Struct, frozen=True):
    """A process as its snapshot tells of it, the addresses of its pages, and where their bytes are, if they are not there."""

    view: Snapshot
    addresses: Words
    source: MemberPages | None

    def rows_at(self, some: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The bytes of some of the pages, by their number."""
        if self.source is not None:
            return self.source.rows_at(some)
        return np.frombuffer(self.view.contents, np.uint8).reshape(-1, abi.PAGE_SIZE)[some]


class Inheritance(Struct, frozen=True):
    """The memory that all of them are born with.

    Attributes:
        regions: where the vessel has it mapped, as far as it is anonymous.
        of_files: the same of files.
        sources: the process that each page is of: the pages' numbers among its own, and their addresses.
        legacies: of each process.
    """

    regions: Words
    of_files: tuple[tuple[FilePlace, Words], ...]
    sources: tuple[tuple[Told, NDArray[np.intp], Words], ...]
    legacies: tuple[Legacy, ...]

    def leave(self, table: CallTable) -> None:
        """Add the calls that map it in the vessel."""
        flags = abi.MAP_PRIVATE | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
        for start, end in self.regions.tolist():
            arguments = (start, end - start, abi.PROT_READ | abi.PROT_WRITE, flags, -1, 0)
            table.call(f"map {(end - start) >> 10} KiB for several processes", "mmap", *arguments, least=start, most=start)

    def leave_files(self, table: CallTable) -> None:
        """Add the calls that map there what is of files, opened with the rights that the vessel has by then."""
        for (path, _, _, shift), regions in self.of_files:
            opened = table.open(path, os.O_RDONLY | os.O_CLOEXEC)
            for start, end in regions.tolist():
                flags = abi.MAP_PRIVATE | abi.MAP_FIXED_NOREPLACE
                arguments = (start, end - start, abi.PROT_READ | abi.PROT_WRITE, flags, opened, start - shift)
                table.call(
                    f"map {(end - start) >> 10} KiB of {path} for several processes", "mmap", *arguments, least=start, most=start
                )
            table.close(opened)

    def put_in(self, memory: Memory) -> None:
        """Write the pages to the vessel."""
        for one, rows, addresses in self.sources:
            for first in range(0, len(rows), COMPARED_AT_ONCE):
                some = slice(first, first + COMPARED_AT_ONCE)
                ranges = page_set.extents_of_addresses(addresses[some], abi.PAGE_SIZE)
                ranges[:, 1] -= ranges[:, 0]
                memory.write_from(ranges, np.ascontiguousarray(one.rows_at(rows[some])).reshape(-1))


class _Known(Struct):
    """The first page that any process has at an address, in the order of addresses."""

    addresses: Words
    views: NDArray[np.intp]
    rows: NDArray[np.intp]
    is_common: NDArray[np.bool_]


FilePlace = tuple[str, int, int, int]
"""Path, device and inode of a file, and the address at which its first byte would lie."""
Mapped = Mapping[int, Sequence[Vma]]
"""Mappings of one sort, by the process, in the order of these."""


def of(
    views: Sequence[Snapshot],
    taken: Words,
    elsewhere: Collection[str] = (),
    sources: Sequence[MemberPages | None] = (),
) -> Inheritance:
    """The memory that these processes have in common.

    Args:
        taken: where the vessel has something mapped.
        elsewhere: paths of files that are not this machine's own.
        sources: of their pages, where the views do not hold them.
    """
    each = zip(views, sources or (None,) * len(views), strict=True)
    told = [Told(view, page_set.addresses_of(page_set.extents(view.runs), abi.PAGE_SIZE), source) for view, source in each]
    anonymous = _alike(told, taken, {index: list(filter(_is_plain, view.vmas)) for index, view in enumerate(views)})
    taken = page_set.union(taken, anonymous.regions)
    parts, of_files = [anonymous], []
    for place, mapped in _files_of_several(told):
        if place[0] not in elsewhere and not place[0].startswith(MEMORY_PLACE):  # which may have to be made first
            part = _alike(told, taken, mapped)
            taken = page_set.union(taken, part.regions)
            parts.append(part)
            of_files.append((place, part.regions))
    return Inheritance(
        anonymous.regions,
        tuple((place, regions) for place, regions in of_files if len(regions)),
        tuple(source for part in parts for source in part.sources),
        tuple(_joined([part.legacies[index] for part in parts if index in part.legacies]) for index in range(len(views))),
    )


def _files_of_several(told: Sequence[Told]) -> Iterator[tuple[FilePlace, Mapped]]:
    """Where several processes have the same file mapped, and pages of their own in it."""
    found: dict[FilePlace, dict[int, list[Vma]]] = {}
    for index, one in enumerate(told):
        for vma in one.view.vmas:
            if (place := _file_of(vma)) and len(_within(one, page_set.extents([vma]))):
                found.setdefault(place, {}).setdefault(index, []).append(vma)
    return ((place, mapped) for place, mapped in found.items() if len(mapped) > 1)


def _file_of(vma: Vma) -> FilePlace | None:
    """The file and place of a plain mapping; None: it is not of a file, or not plain."""
    file = vma.file
    if vma.kind is not VmaKind.FILE or file is None or file.deleted or vma.shared or vma.guards:
        return None
    if vma.protection != abi.PROT_READ | abi.PROT_WRITE or not PLAIN_FLAGS.issuperset(vma.flags):
        return None
    return file.path, file.device, file.inode, vma.start - vma.offset


def _joined(legacies: Sequence[Legacy]) -> Legacy:
    return Legacy(*(_whole(parts) for parts in zip(*((one.kept, one.there, one.stale) for one in legacies), strict=True)))


def _whole(parts: Iterable[Words]) -> Words:
    """Sets that have nothing in common as one."""
    every = np.concatenate([NO_PAGES, *parts])
    every = every[np.argsort(every[:, 0])]
    begins = np.ones(len(every), np.bool_)
    begins[1:] = every[1:, 0] != every[:-1, 1]
    return np.stack((every[begins, 0], every[np.roll(begins, -1), 1]), axis=1)


class _Part(Struct, frozen=True):
    """The inheritance of one sort of memory: see `Inheritance`; legacies by the process."""

    regions: Words
    sources: tuple[tuple[Told, NDArray[np.intp], Words], ...]
    legacies: Mapping[int, Legacy]


def _alike(told: Sequence[Told], taken: Words, mapped: Mapped) -> _Part:
    """The pages that mappings of one sort have in common."""
    known = _Known(np.empty(0, np.uint64), np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0, np.bool_))
    plain = {index: page_set.difference(page_set.extents(vmas), taken) for index, vmas in mapped.items()}
    equal = {index: _compared(known, told, index, plain[index]) for index in mapped}
    common = known.addresses[known.is_common]
    regions = _regions(plain, known, mapped)
    legacies = {
        index: _legacy(told[index], page_set.intersection(regions, plain[index]), equal[index], known, common, index)
        for index in mapped
    }
    sources = []
    for index in mapped:
        mine = known.is_common & (known.views == index)
        if mine.any():
            sources.append((told[index], known.rows[mine], known.addresses[mine]))
    return _Part(regions, tuple(sources), legacies)


def _is_plain(vma: Vma) -> bool:
    is_private = vma.kind in PLAIN_KINDS and not vma.shared and vma.file is None and not vma.guards
    return is_private and vma.protection == abi.PROT_READ | abi.PROT_WRITE and PLAIN_FLAGS.issuperset(vma.flags)


def _within(one: Told, some: Words) -> NDArray[np.intp]:
    """The places of the pages that lie in a set, among all that are carried."""
    bounds = np.searchsorted(one.addresses, some).tolist()
    return np.concatenate([np.arange(first, last, dtype=np.intp) for first, last in bounds] or [np.empty(0, np.intp)])


def _compared(known: _Known, told: Sequence[Told], index: int, plain: Words) -> Words:
    """Where a process has known pages, by address; pages at new addresses are known from then on."""
    rows = _within(told[index], plain)
    addresses = told[index].addresses[rows]
    _, theirs, ours = np.intersect1d(known.addresses, addresses, assume_unique=True, return_indices=True)
    is_equal = np.zeros(len(ours), np.bool_)
    for view in np.unique(known.views[theirs]).tolist():
        of_view = np.flatnonzero(known.views[theirs] == view)
        for first in range(0, len(of_view), COMPARED_AT_ONCE):
            some = of_view[first : first + COMPARED_AT_ONCE]
            left, right = told[view].rows_at(known.rows[theirs[some]]), told[index].rows_at(rows[ours[some]])
            is_equal[some] = (left == right).all(axis=1)
    known.is_common[theirs[is_equal]] = True
    fresh = np.ones(len(addresses), np.bool_)
    fresh[ours] = False
    _add(known, addresses[fresh], rows[fresh], index)
    return addresses[ours[is_equal]]


def _add(known: _Known, addresses: Words, rows: NDArray[np.intp], index: int) -> None:
    merged = np.concatenate((known.addresses, addresses))
    order = np.argsort(merged, kind="stable")
    known.addresses = merged[order]
    known.views = np.concatenate((known.views, np.full(len(addresses), index, np.intp)))[order]
    known.rows = np.concatenate((known.rows, rows.astype(np.intp)))[order]
    known.is_common = np.concatenate((known.is_common, np.zeros(len(addresses), np.bool_)))[order]


def _regions(plain: Mapping[int, Words], known: _Known, mapped: Mapped) -> Words:
    """The whole mappings in which something is common."""
    found = NO_PAGES
    for index, vmas in mapped.items():
        addresses = known.addresses[known.is_common & (known.views == index)]
        if not len(addresses):
            continue
        for vma in vmas:
            first, last = np.searchsorted(addresses, np.array([vma.start, vma.end], np.uint64)).tolist()
            if first < last:
                found = page_set.union(found, page_set.intersection(page_set.extents([vma]), plain[index]))
    return found


def _legacy(one: Told, kept: Words, equal: Words, known: _Known, common: Words, index: int) -> Legacy:
    mine = known.addresses[known.is_common & (known.views == index)]
    there = page_set.extents_of_addresses(np.union1d(equal, mine), abi.PAGE_SIZE)
    inside = common[page_set.covered(kept, common)]
    is_there, _ = page_set.found_among(one.addresses, inside)
    return Legacy(kept, there, page_set.extents_of_addresses(inside[~is_there], abi.PAGE_SIZE))
