"""Build the program's address space inside a vessel: clear, map, fill, settle.

There are four steps, because the restore writes the pages from outside in between: `clear` and `map_program` go into the first
table of calls, `fill` writes every page that the snapshot carries, `settle` (second table) removes the write permission that
filling needed and gives the advice back.

Sources: mmap(2), mremap(2), madvise(2), process_vm_writev(2).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from types import MappingProxyType
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engine import Terms
from checkpoint.engines.ptrace.restore import mapping_kinds
from checkpoint.engines.ptrace.restore.forked_memory import Legacy
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.tracker import MEMORY_PLACE, NONE
from checkpoint.linux.procfs import vm_flags
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import PageRun, Snapshot, Vma, VmaKind
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, Words
from checkpoint.pages.source import PageSource
from checkpoint.resources.events import aio
from checkpoint.resources.files import memfd, unlinked
from checkpoint.resources.ipc import system_v_memory
from checkpoint.runtime.lazy_numpy import NDArray

OWNERS_ALONE: Final = 0o600
MREMAP_MAYMOVE_FIXED: Final = 1 | 2
MAP_LOCKED_ON_FAULT: Final = 1

KERNEL_KINDS: Final = frozenset({VmaKind.VDSO, VmaKind.VVAR, VmaKind.VSYSCALL})
"""Mappings that the kernel made: moved, never mapped."""

KERNEL_NAMES: Final = ("[vdso]", "[vvar", "[vsyscall]")
VSYSCALL: Final = "[vsyscall]"
LAST_ADDRESS: Final = (1 << 64) - 1
NOTHING: Final = Legacy()

ADVICE: Final = {"sr": 2, "rr": 1, "dc": 10, "mg": 12, "hg": 14, "nh": 15, "dd": 16, "wf": 18}
"""madvise(2) by the letters of VmFlags: sequential, random, don't fork, mergeable, huge, not huge, don't dump, wipe on fork."""

NAMED_ANONYMOUS: Final = "[anon:"
PR_SET_VMA: Final = 0x53564D41


def clear(table: CallTable, vessel: Iterable[MapsLine], legacy: Legacy = NOTHING) -> None:
    """Unmap everything that the vessel came with, but the kernel's own pages, and what it keeps."""
    theirs = [PageRun(line.start, line.end) for line in vessel if not line.name.startswith(KERNEL_NAMES)]
    for start, end in page_set.difference(page_set.extents(theirs), legacy.kept).tolist():
        table.call(f"unmap {start:#x} of the vessel", "munmap", start, end - start)
    legacy.empty_stale(table)


def kernel_pages(vessel: Iterable[MapsLine]) -> list[MapsLine]:
    """The vessel's vdso and its data, in address order, the vdso last; vsyscall has one address everywhere."""
    return [line for line in vessel if line.name.startswith(KERNEL_NAMES) and line.name != VSYSCALL]


def kernel_pages_of(vmas: Iterable[Vma]) -> list[Vma]:
    """The same of the program."""
    return [vma for vma in vmas if vma.kind in (VmaKind.VDSO, VmaKind.VVAR)]


def move_kernel_pages(table: CallTable, vessel: Sequence[MapsLine], program: Sequence[Vma], refuge: int) -> int:
    """Move the vdso and its data to where the program has them; where the vdso lies then.

    Args:
        program: empty where it has another kernel's (`checkpoint.engines.ptrace.restore.vdso`): they stay in the refuge.
        refuge: an address with room for all of them in a hole; they go there first, so that old and new places may overlap.
    """
    places = []
    for line in vessel:
        _move(table, line.start, refuge, line.size)
        places.append(refuge)
        refuge += line.size
    if not program:
        return places[-1]
    for place, line, theirs in zip(places, vessel, program, strict=True):
        _move(table, place, theirs.start, line.size)
    return program[-1].start


def _move(table: CallTable, start: int, target: int, size: int) -> None:
    table.call(
        f"move the vdso to {target:#x}", "mremap", start, size, size, MREMAP_MAYMOVE_FIXED, target, least=target, most=target
    )


Object = tuple[int, int]
"""Device and inode number of a file without a name, or of shared memory."""


class Present(Struct, frozen=True):
    """Memory that is there already, where a program is mapped.

    Attributes:
        objects: files without a name, and shared memory: a descriptor of each, which is left as it is.
        anonymous: shared memory without a file: where it is mapped whole.
        legacy: private memory.
    """

    objects: Mapping[Object, int] = MappingProxyType({})
    anonymous: Mapping[Object, int] = MappingProxyType({})
    legacy: Legacy = NOTHING


NOTHING_PRESENT: Final = Present()


def map_program(
    table: CallTable,
    vmas: Iterable[Vma],
    runs: Sequence[PageRun] | Words,
    brought: Mapping[str, int],
    present: Present = NOTHING_PRESENT,
    untouched: Words = NONE,
) -> dict[Object, int]:
    """Map everything that the program had, but for attached segments and rings; what will be filled is writable for now.

    Answers with a descriptor of each shared object without a name, by (device, inode): open files may be of the same one.

    Args:
        brought: descriptors of what is mapped in place of this machine's files, by path; they stay open.
        present: memory that needs no mapping of its own.
        untouched: pages of objects without a name that private mappings show as they are.
    """
    carried, inherited, anonymous = Carried(runs), present.objects, present.anonymous
    vmas = tuple(vmas)
    made_elsewhere = (system_v_memory.is_segment, aio.is_ring)
    mapped = [vma for vma in vmas if vma.kind not in KERNEL_KINDS and not any(is_one(vma) for is_one in made_elsewhere)]
    files = [vma for vma in mapped if is_file_mapping(vma)]
    for (path, writable), group in groupby(sorted(files, key=_file_order), key=_file_order):
        pieces = list(group)
        if path in brought and not writable:
            for vma in pieces:
                _map(table, vma, first_protection(vma, carried), brought[path])
            continue
        if path.startswith(MEMORY_PLACE) and not os.path.lexists(path):
            descriptor = _make_shared_memory(table, pieces[0])
        else:
            descriptor = table.open(path, (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC)
        for vma in pieces:
            for start, end in present.legacy.without_kept(vma):
                piece = replace(vma, start=start, end=end, offset=vma.offset + start - vma.start)
                _map(table, piece, first_protection(vma, carried), descriptor)
        table.close(descriptor)
    objects = [vma for vma in mapped if is_object_mapping(vma) or _shows_object(vma, untouched)]
    made = {
        key: make_object(table, list(group))
        for key, group in groupby(sorted(objects, key=object_of), key=object_of)
        if key not in inherited
    }
    for vma in objects:
        key = object_of(vma)
        _map(table, vma, first_protection(vma, carried), inherited[key] if key in inherited else made[key])
    for vma in mapped:
        if is_anonymous_object(vma) and object_of(vma) in anonymous:
            _map_again(table, vma, anonymous[object_of(vma)])
    there = {vma.start for vma in objects}
    others = (vma for vma in mapped if not is_file_mapping(vma) and vma.start not in there)
    for piece in joined_shared(vma for vma in others if not (is_anonymous_object(vma) and object_of(vma) in anonymous)):
        for start, end in present.legacy.without_kept(piece):
            _map(table, replace(piece, start=start, end=end), first_protection(piece, carried), -1)
    return made


def anonymous_sizes(vmas: Iterable[Vma]) -> dict[Object, int]:
    """How long each piece of shared memory without a file is, of which it is told which, as far as it is mapped."""
    sizes: dict[Object, int] = {}
    for vma in filter(is_anonymous_object, vmas):
        sizes[object_of(vma)] = max(sizes.get(object_of(vma), 0), vma.offset + vma.size)
    return sizes


def map_anonymous(table: CallTable, sizes: Mapping[Object, int], place: int) -> dict[Object, int]:
    """Map each whole, one after the other from an address on: where each lies."""
    places: dict[Object, int] = {}
    for key, size in sizes.items():
        flags = abi.MAP_SHARED | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
        arguments = (place, size, abi.PROT_READ | abi.PROT_WRITE, flags, -1, 0)
        table.call(f"map {size >> 10} KiB of shared memory", "mmap", *arguments, least=place, most=place)
        places[key] = place
        place += size
    return places


def is_anonymous_object(vma: Vma) -> bool:
    """Whether it is shared memory without a file whose identity the snapshot tells: it is mapped in other places, too."""
    return vma.kind is VmaKind.ANONYMOUS and vma.shared and vma.file is not None


def _map_again(table: CallTable, vma: Vma, whole: int) -> None:
    """Map a part of shared memory once more. Source: mremap(2): an old size of zero makes a second mapping of the same pages."""
    what = f"map {vma.size >> 10} KiB of shared memory at {vma.start:#x}"
    arguments = (whole + vma.offset, 0, vma.size, MREMAP_MAYMOVE_FIXED, vma.start)
    table.call(what, "mremap", *arguments, least=vma.start, most=vma.start)


def _make_shared_memory(table: CallTable, vma: Vma) -> int:
    """Make POSIX shared memory that the program had to itself, and that this machine lacks."""
    file = vma.file
    assert file is not None
    made = table.open(file.path, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, file.mode & 0o7777)
    table.call(f"set the mode of {file.path}", "fchmod", made, file.mode & 0o7777)
    table.call(f"size {file.path}", "ftruncate", made, file.size)
    return made


def makes_shared_memory(vmas: Iterable[Vma], path: str) -> bool:
    """Whether a file is shared memory of which the program has mapped everything: then a restore can make it."""
    mapped = sorted(
        (vma for vma in vmas if vma.file is not None and vma.file.path == path and vma.shared), key=lambda vma: vma.offset
    )
    if not path.startswith(MEMORY_PLACE) or not mapped or not all(vma.protection & abi.PROT_WRITE for vma in mapped):
        return False
    end = 0
    for vma in mapped:
        end = max(end, vma.offset + vma.size) if vma.offset <= end else end
    return mapped[0].file is not None and end >= mapped[0].file.size


def is_object_mapping(vma: Vma) -> bool:
    """Whether it is a shared mapping of a memory file, or of a file that has no name any more."""
    is_named_nowhere = vma.kind is VmaKind.FILE and vma.file is not None and vma.file.deleted
    return is_named_nowhere and vma.shared and not mapping_kinds.is_huge(vma) and not aio.is_ring(vma)


def _shows_object(vma: Vma, untouched: Words) -> bool:
    """Whether it is a private mapping of one, in some pages of which the object itself is seen."""
    is_nameless = vma.kind is VmaKind.FILE and vma.file is not None and vma.file.deleted and not vma.shared
    return is_nameless and not mapping_kinds.is_huge(vma) and len(page_set.intersection(page_set.extents([vma]), untouched)) > 0


def object_of(vma: Vma) -> tuple[int, int]:
    assert vma.file is not None
    return vma.file.device, vma.file.inode


def make_object(table: CallTable, vmas: Sequence[Vma]) -> int:
    """Make what they are mappings of, long enough for all; its content is written through them."""
    file = vmas[0].file
    assert file is not None
    size, mode = file.size, file.mode & 0o7777
    if not file.mode:  # an ordinary user captured it, and could not ask its size: the mapped size counts
        size, mode = max(vma.offset + vma.size for vma in vmas), OWNERS_ALONE
    if file.path.startswith(memfd.PREFIX):
        return memfd.make(table, file.path.removeprefix(memfd.PREFIX), mode, size)
    made = unlinked.make_file(table, file.path, mode)
    table.call(f"size {file.path}", "ftruncate", made, size)
    return made


def is_file_mapping(vma: Vma) -> bool:
    """Whether it is mapped from a file that has a name; others are rebuilt from their pages alone."""
    return vma.kind is VmaKind.FILE and vma.file is not None and not vma.file.deleted


def is_only_read(vma: Vma) -> bool:
    """Whether it is a mapping of a file with a name that cannot be written through: the C library has such ones."""
    return is_file_mapping(vma) and not vma.protection & abi.PROT_WRITE and vm_flags.MAY_WRITE not in vma.flags


def _file_order(vma: Vma) -> tuple[str, bool]:
    assert vma.file is not None
    return vma.file.path, vma.shared and (bool(vma.protection & abi.PROT_WRITE) or vm_flags.MAY_WRITE in vma.flags)


def joined_shared(vmas: Iterable[Vma]) -> list[Vma]:
    """Give neighbouring pieces of one shared object back their unity: they were split by mprotect or madvise, and share pages.

    `settle` splits them again by giving each its protection.
    """
    pieces: list[Vma] = []
    for vma in vmas:
        last = pieces[-1] if pieces else None
        if last and vma.shared and last.shared and last.end == vma.start and last.offset + last.size == vma.offset and vma.offset:
            pieces[-1] = Vma(last.start, vma.end, last.protection, True, last.kind, last.offset, last.name, last.file, last.flags)
        else:
            pieces.append(vma)
    return pieces


def _map(table: CallTable, vma: Vma, protection: int, descriptor: int) -> None:
    flags = abi.MAP_FIXED | (abi.MAP_SHARED if vma.shared else abi.MAP_PRIVATE)
    offset = vma.offset if descriptor >= 0 else 0
    if descriptor < 0:
        flags |= abi.MAP_ANONYMOUS
    if "gd" in vma.flags:
        flags |= abi.MAP_GROWSDOWN | abi.MAP_STACK
    if "nr" in vma.flags:
        flags |= abi.MAP_NORESERVE
    if mapping_kinds.is_special(vma):
        mapping_kinds.map_special(table, vma, protection, flags & ~abi.MAP_FIXED)
        return
    what = f"map {vma.size >> 10} KiB at {vma.start:#x} ({vma.name or 'anonymous'})"
    arguments = (vma.start, vma.size, protection, flags, descriptor, offset)
    table.call(what, "mmap", *arguments, least=vma.start, most=vma.start)


def first_protection(vma: Vma, carried: Carried) -> int:
    """The protection of a mapping while its pages are written: `settle` gives it its own.

    No instruction runs there by then: a processor whose caches do not see what is written among instructions (aarch64) is told
    by the kernel when a page becomes one of instructions, and not when it is written to afterwards.
    """
    if not carried.within(vma) or (vma.shared and is_only_read(vma)):
        return vma.protection
    return (vma.protection | abi.PROT_READ | abi.PROT_WRITE) & ~abi.PROT_EXEC


class Carried:
    """Which mappings the snapshot carries pages for."""

    def __init__(self, runs: Sequence[PageRun] | Words) -> None:
        if not isinstance(runs, np.ndarray):
            runs = np.array([(run.start, run.end) for run in runs], np.uint64).reshape(-1, 2)
        self._starts: NDArray[np.uint64] = np.ascontiguousarray(runs[:, 0])
        self._ends: NDArray[np.uint64] = np.ascontiguousarray(runs[:, 1])

    def within(self, vma: Vma) -> bool:
        """Whether a page of this mapping is carried."""
        index = int(np.searchsorted(self._ends, np.uint64(vma.start), side="right"))
        return index < len(self._starts) and int(self._starts[index]) < vma.end


def fill(memory: Memory, snapshot: Snapshot, legacy: Legacy = NOTHING, untouched: Words = NONE, threads: int = 1) -> None:
    """Write every page that the snapshot carries, but for those of the kernel's own mappings, and those that are there.

    By several threads, if there is much of it: most of the time is the kernel's, which finds and clears a page for each of ours.
    """
    _write(memory, page_set.extents(snapshot.runs), snapshot.contents, _filled(snapshot, legacy, untouched), threads)


def fill_from(
    memory: Memory,
    outline: Snapshot,
    source: PageSource,
    legacy: Legacy = NOTHING,
    untouched: Words = NONE,
    threads: int = 1,
) -> None:
    """The same of pages that are elsewhere: each is still in a processor's cache when it is written.

    Memory without a file is zero by itself: pages of zeros are left out there, where the source may tell some.

    Raises:
        FormatError, ChainError: its pages have changed; some were written.
    """
    filled = _filled(outline, legacy, untouched)
    zero = page_set.extents(vma for vma in outline.vmas if vma.file is None) if source.tells_zeros else NONE

    def written(row: Words, content: Buffer) -> None:
        _write(Memory(memory.pid), *_without_zeros(row, content, zero), filled)

    source.within(filled).each(written, threads)


def _without_zeros(row: Words, content: Buffer, zero: Words) -> tuple[Words, Buffer]:
    """The pages and their bytes, without pages of zeros where there are zeros already."""
    if not len(zero):
        return row, content
    is_zero = page_set.zero_pages(content, abi.PAGE_SIZE)
    if not is_zero.any():
        return row, content
    addresses = page_set.addresses_of(row, abi.PAGE_SIZE)
    kept = ~(is_zero & page_set.covered(zero, addresses))
    rows = np.frombuffer(content, np.uint8).reshape(-1, abi.PAGE_SIZE)[kept]
    return page_set.extents_of_addresses(addresses[kept], abi.PAGE_SIZE), rows.reshape(-1).data


def _filled(snapshot: Snapshot, legacy: Legacy, untouched: Words) -> Words:
    """Where pages are written.

    Droppable memory begins empty, as its program must expect at any time: seeds of random numbers lie there (vgetrandom), which
    two lives must not have in common. A shared mapping that may not be written to has the content of its file.
    """
    mapped = page_set.extents(vma for vma in snapshot.vmas if vma.kind not in KERNEL_KINDS and not _keeps_its_own(vma))
    return page_set.difference(page_set.difference(mapped, legacy.there), untouched)


def extents_shared(vmas: Iterable[Vma], terms: Terms) -> Words:
    """Where files are mapped that keep the content that they have here: others write to them as well."""
    files = (vma for vma in vmas if vma.shared and vma.file is not None and is_file_mapping(vma))
    return page_set.extents(vma for vma in files if vma.file is not None and terms.is_shared(vma.file.path))


def _keeps_its_own(vma: Vma) -> bool:
    return vm_flags.DROPPABLE in vma.flags or (vma.shared and is_only_read(vma))


def _write(memory: Memory, carried: Words, content: Buffer, filled: Words, threads: int = 1) -> None:
    """Write those of the carried pages that are to be filled."""
    contents, position = np.frombuffer(content, np.uint8), 0
    for is_wanted, piece in _cut(carried, filled):
        size = page_set.total_size(piece)
        if is_wanted:
            memory.write_side_by_side(piece, contents[position : position + size], threads)
        position += size


def _cut(whole: Words, mapped: Words) -> Iterator[tuple[bool, Words]]:
    """Pages in order, in as few pieces as there are changes between pages in a set and others."""
    if page_set.covers(mapped, whole):
        yield True, whole
        return
    outside = page_set.difference(whole, mapped)
    begin = 0
    for first, last in outside.tolist():
        before = page_set.intersection(whole, np.array([[begin, first]], np.uint64))
        yield from ((True, before),) if len(before) else ()
        yield False, np.array([[first, last]], np.uint64)
        begin = last
    rest = page_set.intersection(whole, np.array([[begin, LAST_ADDRESS]], np.uint64))
    yield from ((True, rest),) if len(rest) else ()


def content_at(state: Snapshot, address: int, size: int) -> bytes | None:
    """Bytes of the program's memory, as far as the snapshot carries the page; None when it does not."""
    position = 0
    for run in state.runs:
        if run.start <= address and address + size <= run.end:
            offset = position + address - run.start
            return bytes(memoryview(state.contents)[offset : offset + size])
        position += run.size
    return None


def settle(table: CallTable, vmas: Iterable[Vma], runs: Sequence[PageRun] | Words) -> None:
    """Give every mapping its own protection, guards, advice, name and lock (a locked mapping takes no guards)."""
    carried = Carried(runs)
    for vma in vmas:
        if vma.kind in KERNEL_KINDS:
            continue
        if vma.shared or first_protection(vma, carried) != vma.protection:
            table.call(f"protect {vma.start:#x}", "mprotect", vma.start, vma.size, vma.protection)
        for guard in vma.guards:
            table.call(f"install a guard at {guard.start:#x}", "madvise", guard.start, guard.size, abi.MADV_GUARD_INSTALL)
        for letters in vma.flags:
            if letters in ADVICE:
                lost = f"memory at {vma.start:#x} loses its advice {letters!r}"
                table.attempt(lost, "madvise", vma.start, vma.size, ADVICE[letters])
        if "lo" in vma.flags:
            on_fault = MAP_LOCKED_ON_FAULT if "lf" in vma.flags else 0
            table.attempt(f"memory at {vma.start:#x} is not locked", "mlock2", vma.start, vma.size, on_fault)
        mapping_kinds.protect(table, (vma,))
        if vma.name.startswith(NAMED_ANONYMOUS):
            name = table.place_path(vma.name.removeprefix(NAMED_ANONYMOUS).removesuffix("]"))
            table.attempt("", "prctl", PR_SET_VMA, 0, vma.start, vma.size, name)
        mapping_kinds.seal(table, vma)
