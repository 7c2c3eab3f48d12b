"""How a snapshot describes carried files (rule ``carry``): their content is stored as pages, and folded like memory.

Every file has a *stretch* of addresses that no program can have (`FIRST_ADDRESS` and up), with a mapping of kind CARRIED_FILE as
long as the file, in whole pages; a missing page is a hole. One resource for each carried path holds the names and owners of its
files: its ``name`` is the path, absolute. Its fact ``size`` is the size of its files, in whole pages. Its fact ``entries`` lists
the path itself (its name is b"") and everything below it, a directory before its content; a path without a file has no entries.
An entry is a list:

    name        relative to the path, bytes
    mode        st_mode; uid; gid; mtime_ns
    device      and inode, by which the program may remember it
    size        in bytes, of a regular file; else 0
    place       number of its stretch, -1 if it is no regular file; files with several names have one stretch
    target      of a symbolic link, bytes
    attributes  [name, value] of each extended attribute
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.errors import RestoreError
from checkpoint.model import Fact, PageRun, Resource, Snapshot, Vma, VmaKind

KIND: Final = "carried"

FIRST_ADDRESS: Final = 1 << 62
"""No processor's programs have addresses from here on (x86-64 has at most 2⁵⁶)."""
STRETCH: Final = 1 << 38
"""Bytes of address space for one file: 256 GiB, so that a sparse one may look larger than it is."""
PLACE_COUNT: Final = 1 << 24
"""Stretches: more than there are entries in any tree."""
NO_PLACE: Final = -1

PATHS: Final = ("path", "directory", "root")
"""Facts of resources that are paths."""
LISTED: Final = ("watches", "threads")
"""Facts that are lists of lists, the second item of which is a path where it is a text."""

OWN_PREFIX: Final = b".failover-"
"""How names of our own begin, beside a carried path or in it: they are never carried."""


class Entry(Struct, frozen=True):
    """One name. The fields stand at the top of this file."""

    name: bytes
    mode: int
    uid: int
    gid: int
    mtime_ns: int
    device: int = 0
    inode: int = 0
    size: int = 0
    place: int = NO_PLACE
    target: bytes = b""
    attributes: tuple[tuple[str, bytes], ...] = ()

    @property
    def is_file(self) -> bool:
        """Whether it is a regular file."""
        return stat.S_ISREG(self.mode)

    @property
    def is_directory(self) -> bool:
        """Whether it is a directory."""
        return stat.S_ISDIR(self.mode)

    def fact(self) -> list[Fact]:
        """As it stands in a snapshot."""
        attributes: list[Fact] = [[name, value] for name, value in self.attributes]
        numbers = self.mode, self.uid, self.gid, self.mtime_ns, self.device, self.inode, self.size, self.place
        return [self.name, *numbers, self.target, attributes]


class Tree(Struct, frozen=True):
    """A carried path and what stood there: a file, a directory with all below it, or nothing."""

    path: str
    entries: tuple[Entry, ...]
    held_size: int = 0

    def resource(self) -> Resource:
        """As it stands in a snapshot."""
        return Resource(KIND, self.path, {"entries": [entry.fact() for entry in self.entries], "size": self.held_size})


def is_carriable(path: str) -> bool:
    """Whether a path names a file or folder in full: absolute, normal, and not the root of everything."""
    return (
        path.startswith("/") and path != "/" and not path.startswith("//") and os.path.normpath(path) == path and "\0" not in path
    )


def start_of(place: int) -> int:
    """Where a stretch begins."""
    return FIRST_ADDRESS + place * STRETCH


def mappings_of(trees: Iterable[Tree], page_size: int) -> tuple[Vma, ...]:
    """The mappings of all files that hold something, in address order."""
    sizes = {entry.place: entry.size for tree in trees for entry in tree.entries if entry.place != NO_PLACE and entry.size}
    return tuple(_mapping(place, sizes[place], page_size) for place in sorted(sizes))


def _mapping(place: int, size: int, page_size: int) -> Vma:
    start = start_of(place)
    return Vma(start, start + -(-size // page_size) * page_size, 0, False, VmaKind.CARRIED_FILE)


# Out of a snapshot


def paths_of(state: Snapshot) -> tuple[str, ...]:
    """The carried paths."""
    return tuple(held.name for held in state.resources if held.kind == KIND)


def every_path(state: Snapshot) -> tuple[str, ...]:
    """Every file and folder that is carried.

    Raises:
        RestoreError: see `trees_of`.
    """
    return tuple(
        os.path.join(tree.path, os.fsdecode(entry.name)).rstrip("/") for tree in trees_of(state) for entry in tree.entries
    )


def without(state: Snapshot) -> Snapshot:
    """The snapshot of the program alone: the rest is what its process holds."""
    if not paths_of(state) and not any(vma.kind is VmaKind.CARRIED_FILE for vma in state.vmas):
        return state
    runs = tuple(run for run in state.runs if run.start < FIRST_ADDRESS)
    return replace(
        state,
        vmas=tuple(vma for vma in state.vmas if vma.kind is not VmaKind.CARRIED_FILE),
        resources=tuple(held for held in state.resources if held.kind != KIND),
        cleared=tuple(run for run in state.cleared if run.start < FIRST_ADDRESS),
        runs=runs,
        contents=memoryview(state.contents)[: sum(run.size for run in runs)],
    )


def relocated(state: Snapshot, places: Mapping[str, str]) -> Snapshot:
    """The same base with carried paths that lie elsewhere here: also for open and mapped files, and the working directory.

    Args:
        places: by the path that the snapshot tells of, the path here. Others stay where they are.
    """
    moved = {path: places[path] for path in paths_of(state) if path in places}
    if not moved:
        return state

    def here(path: str) -> str:
        found = next((old for old in moved if path == old or path.startswith(old + "/")), None)
        return path if found is None else moved[found] + path[len(found) :]

    return replace(
        state,
        process=replace(
            state.process,
            working_directory=here(state.process.working_directory),
            root_directory=here(state.process.root_directory),
        ),
        vmas=tuple(
            replace(vma, name=here(vma.name), file=replace(vma.file, path=here(vma.file.path))) if vma.file is not None else vma
            for vma in state.vmas
        ),
        resources=tuple(_resource_at(held, here) for held in state.resources),
    )


def _resource_at(held: Resource, here: Callable[[str], str]) -> Resource:
    if held.kind == KIND:
        return replace(held, name=here(held.name))
    return replace(held, facts={name: _fact_at(name, fact, here) for name, fact in held.facts.items()})


def _fact_at(name: str, fact: Fact, here: Callable[[str], str]) -> Fact:
    if name in PATHS and isinstance(fact, str):
        return here(fact)
    return [_listed_at(one, here) for one in fact] if name in LISTED and isinstance(fact, list) else fact


def _listed_at(one: Fact, here: Callable[[str], str]) -> Fact:
    match one:
        case [first, str() as path, *rest]:
            return [first, here(path), *rest]
    return one


def pieces(state: Snapshot) -> Mapping[int, list[tuple[int, memoryview]]]:
    """A base's content of each stretch: (offset in the file, bytes in whole pages), in order."""
    found: dict[int, list[tuple[int, memoryview]]] = {}
    content, position = memoryview(state.contents).cast("B"), 0
    for run in state.runs:
        if run.start >= FIRST_ADDRESS:
            _add_piece(found, run, content[position : position + run.size])
        position += run.size
    return found


def _add_piece(found: dict[int, list[tuple[int, memoryview]]], run: PageRun, content: memoryview) -> None:
    place, offset = divmod(run.start - FIRST_ADDRESS, STRETCH)
    found.setdefault(place, []).append((offset, content))


FIXED_SIZE: Final = 1 << 20
"""Bytes besides the content that must be free: names and attributes."""


def lack_of_room(sizes: Iterable[tuple[str, int]]) -> str:
    """Why files will not fit at their paths, all together and beside what stands there; "" if they will, as things are.

    Args:
        sizes: (absolute path, bytes that its files hold).
    """
    needed: dict[int, int] = {}
    for path, size in sizes:
        place = path
        while not os.path.isdir(place):
            place = os.path.dirname(place)
        device, about = os.stat(place).st_dev, os.statvfs(place)
        needed[device] = needed.get(device, 0) + size
        free = about.f_bavail * about.f_frsize
        if needed[device] + FIXED_SIZE > free:
            return f"its carried files need {needed[device] >> 10} KiB and {place} has {free >> 10} KiB free: make room there"
    return ""


def lack_of_room_for(state: Snapshot, places: Mapping[str, str]) -> str:
    """Why the carried files of a snapshot, of which the pages are not needed, will not fit here; "" if they will.

    Args:
        places: as for `relocated`.
    """
    sizes = [(places.get(held.name, held.name), held.facts.get("size")) for held in state.resources if held.kind == KIND]
    return lack_of_room((path, size) for path, size in sizes if isinstance(size, int) and path.startswith("/"))


def trees_of(state: Snapshot) -> tuple[Tree, ...]:
    """The carried trees of a snapshot.

    Raises:
        RestoreError: one of them is not as the top of this file says: it must not be laid down.
    """
    return tuple(_tree(held) for held in state.resources if held.kind == KIND)


def _tree(held: Resource) -> Tree:
    listed, held_size = held.facts.get("entries"), held.facts.get("size")
    is_known = set(held.facts) == {"entries", "size"} and isinstance(held_size, int)
    if not is_known or not isinstance(listed, list):
        raise RestoreError(f"cannot write {held.name!r}: its snapshot describes carried files in an unknown form")
    if not is_carriable(held.name):
        raise RestoreError(f"cannot write {held.name!r}: its snapshot does not name the path in full, as itself")
    tree = Tree(held.name, tuple(_entry(held.name, fact) for fact in listed), int(str(held_size)))
    if reason := _what_cannot_be(tree.entries):
        raise RestoreError(f"cannot write {held.name}: its snapshot {reason}")
    return tree


def _entry(path: str, fact: Fact) -> Entry:
    match fact:
        case [
            bytes() as name,
            int() as mode,
            int() as uid,
            int() as gid,
            int() as mtime_ns,
            int() as device,
            int() as inode,
            int() as size,
            int() as place,
            bytes() as target,
            list() as attributes,
        ]:
            about = mode, uid, gid, mtime_ns, device, inode, size, place
            return Entry(name, *about, target, tuple(_attributes(path, attributes)))
    raise RestoreError(f"cannot write {path}: its snapshot has an entry of another form")


def _attributes(path: str, listed: Iterable[Fact]) -> Iterator[tuple[str, bytes]]:
    for fact in listed:
        match fact:
            case [str() as name, bytes() as value]:
                yield name, value
            case _:
                raise RestoreError(f"cannot write {path}: its snapshot has an extended attribute of another form")


def _what_cannot_be(entries: Sequence[Entry]) -> str:
    """Why names must not be used: they would lead out of the tree, or are of no kind that is carried; "" if all is well."""
    directories: set[bytes] = set()
    seen: set[bytes] = set()
    for index, entry in enumerate(entries):
        if stat.S_IFMT(entry.mode) not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK, stat.S_IFIFO):
            return f"has {entry.name!r} of a kind that is not carried"
        if entry.is_file != (0 <= entry.place < PLACE_COUNT) or not 0 <= entry.size < STRETCH or min(entry.uid, entry.gid) < 0:
            return f"has {entry.name!r} with numbers that cannot be"
        if (entry.name == b"") != (index == 0) or entry.name in seen:
            return f"names {entry.name!r} twice, or out of order"
        parent, _, last = entry.name.rpartition(b"/")
        if index and (last in (b"", b".", b"..") or b"\0" in entry.name or parent not in directories):
            return f"has {entry.name!r}, which lies in no directory of it"
        seen.add(entry.name)
        if entry.is_directory:
            directories.add(entry.name)
    return ""
