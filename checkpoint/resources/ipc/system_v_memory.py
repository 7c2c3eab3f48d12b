"""Restore a program's own System V shared memory (shmget(2), shmat(2)): content, key, size, owner, and the id where it is free.

Its processes may have it attached together: then each of them describes it, and the restore makes it once.

Its pages are those of the mappings; this module describes how to make it. A segment whose id the program knows but which it has
not attached cannot be seen, and is not restored.

Facts: ``descriptors`` (none); ``id``; ``key``; ``size`` in bytes; ``permissions``, with SHM_DEST where it goes with the last
process that has it attached; ``uid`` and ``gid`` of its owner; ``changed`` in seconds of the wall clock: 0 or missing where it is
not known.

Source: shmget(2), shmop(2); ipc/shm.c: the inode number of a mapping is the id.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import RestoreError
from checkpoint.linux import abi, system_v_ipc
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.system_v_ipc import SHM_DEST, Segment
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource, Vma
from checkpoint.resources.restore_context import number_of

KIND: Final = "system_v_memory"
PREFIX: Final = "/SYSV"
"""How the kernel names such a mapping; the key follows."""
CAPABILITIES: Final = (
    preserved(
        Area.MEMORY,
        "System V shared memory that only the program has",
        "made again, once for all of its processes, with its content, key, owner and id; if the id is taken, it gets "
        "another one, and a note says so",
    ),
    refused(
        Area.MEMORY,
        "System V shared memory that other programs have too, or that is partly unmapped",
        "protect them as one component, or give the program a copy of its own (`--shared-memory detach`)",
        "attached by other processes, too",
        "of which it has unmapped a part",
    ),
    refused(
        Area.THERE,
        "a key of its System V shared memory that another program has",
        "end that program, or remove its segment (ipcrm)",
        "belongs to another segment here",
    ),
)


def is_segment(mapping: MapsLine | Vma) -> bool:
    """Whether a mapping is of a segment."""
    return mapping.shared and mapping.name.startswith(PREFIX)


def describe(lines: Iterable[MapsLine], detached: Collection[tuple[int, int]] = ()) -> tuple[Resource, ...]:
    """Every segment that a program has attached.

    Args:
        detached: device and inode number of those that become its own copy: without a key, by which others would find it, and
            gone with the program.
    """
    wanted = {line.inode: (line.device, line.inode) in detached for line in lines if is_segment(line)}
    known = system_v_ipc.segments() if wanted else {}
    told = ((known[identifier], wanted[identifier]) for identifier in sorted(wanted) if identifier in known)
    return tuple(_described(_own_copy(segment) if is_detached else segment) for segment, is_detached in told)


def _own_copy(segment: Segment) -> Segment:
    return replace(segment, key=0, permissions=segment.permissions | SHM_DEST, changed=0)


def _described(segment: Segment) -> Resource:
    return Resource(
        KIND,
        f"shared memory segment {segment.identifier}",
        {
            "descriptors": [],
            "id": segment.identifier,
            "key": segment.key,
            "size": segment.size,
            "permissions": segment.permissions,
            "uid": segment.uid,
            "gid": segment.gid,
            "changed": segment.changed,
        },
    )


def here(lines: Iterable[MapsLine]) -> dict[int, Segment]:
    """The segments of this machine, where one of them is mapped."""
    return system_v_ipc.segments() if any(map(is_segment, lines)) else {}


def refuse(lines: Iterable[MapsLine], known: Mapping[int, Segment], *, detaches: bool = False) -> Iterator[str]:
    """Why a segment of a program cannot be kept.

    Args:
        lines: the mappings of all of its processes.
        known: the segments of this machine, of the same instant.
        detaches: what others have, too, becomes its own copy.
    """
    found: dict[int, list[MapsLine]] = {}
    for line in lines:
        if is_segment(line):
            found.setdefault(line.inode, []).append(line)
    for identifier, pieces in found.items():
        segment, what = known.get(identifier), f"System V shared memory {identifier} is"
        if segment is None:
            continue  # it has just gone
        if segment.attached > len(pieces) and not detaches:
            yield (
                f"{what} attached by other processes, too, which stay behind: protect all of them as one component, or give the "
                "program a copy of its own (--shared-memory detach, see docs/shared-memory.md)"
            )
        if not _is_whole(pieces, segment.size):
            yield f"{what} one of which it has unmapped a part: let the program keep the whole"


def _is_whole(pieces: Sequence[MapsLine], size: int) -> bool:
    """Whether mappings cover a segment from its beginning to its end."""
    end = 0
    for piece in sorted(pieces, key=lambda piece: piece.offset):
        if piece.offset <= end:
            end = max(end, piece.offset + piece.size)
    return end >= size


# --- Restore -----------------------------------------------------------------------------------------------------------


def _wanted(held: Resource) -> Segment:
    facts = {name: number_of(held.facts[name]) for name in ("key", "id", "permissions", "size", "uid", "gid")}
    changed = number_of(held.facts.get("changed", 0))
    return Segment(facts["key"], facts["id"], facts["permissions"], facts["size"], 0, facts["uid"], facts["gid"], changed=changed)


def _left_behind(wanted: Segment, here: Iterable[Segment]) -> Segment | None:
    """The very segment that the program left here when it died, if no process has it attached any more.

    A program that uses another segment like it would share the program's memory. A segment without a key is known by when it
    was made: of this machine's there is no other with the same id at the same time.
    """

    def is_it(one: Segment) -> bool:
        is_known = wanted.key or (wanted.changed and one.changed == wanted.changed)
        alike = replace(one, attached=0, creator=wanted.creator, changed=wanted.changed) == wanted
        return bool(is_known) and alike and not one.attached and one.creator in (wanted.uid, os.geteuid())

    return next(filter(is_it, here), None)


def mismatches(held: Resource) -> Iterator[str]:
    """Why it cannot be made here."""
    wanted, here = _wanted(held), system_v_ipc.segments().values()
    if wanted.key and any(one.key == wanted.key for one in here) and not _left_behind(wanted, here):
        cure = "end the programs that use it, or remove it (ipcrm)"
        yield f"the key {wanted.key & 0xFFFFFFFF:#x} of its System V shared memory belongs to another segment here: {cure}"


class Segments(Struct):
    """The segments of a program, made on this machine: once, however many of its processes tell of them.

    Attributes:
        ids: there → here.
        notes: sentences for the operator.
    """

    ids: dict[int, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _made: list[int] = field(default_factory=list)
    _passing: list[int] = field(default_factory=list)

    def make(self, resources: Iterable[Resource]) -> None:
        """Make them, empty; those that were made for another of its processes are there.

        Raises:
            RestoreError: one cannot be made.
        """
        told = [_wanted(held) for held in resources if held.kind == KIND]
        for wanted in (one for one in told if one.identifier not in self.ids):
            left = _left_behind(wanted, system_v_ipc.segments().values())
            self.ids[wanted.identifier] = self._emptied(left) if left else self._new(wanted)
            if wanted.permissions & SHM_DEST:
                self._passing.append(self.ids[wanted.identifier])

    def _emptied(self, left: Segment) -> int:
        """Empty it of later writes of the program: pages that were zero at the snapshot are not in it."""
        try:
            system_v_ipc.wipe(left)
        except OSError as error:
            what = f"the System V shared memory {left.identifier} that the program left"
            raise RestoreError(f"cannot empty {what}: {error.strerror}; remove it (ipcrm)") from error
        return left.identifier

    def _new(self, wanted: Segment) -> int:
        try:
            made = system_v_ipc.make(wanted)
        except OSError as error:
            what = f"{wanted.size} bytes of System V shared memory"
            raise RestoreError(f"cannot make {what}: {error.strerror}; see kernel.shmmax, kernel.shmmni, or ipcs") from error
        self._made.append(made)
        if made != wanted.identifier:
            self.notes.append(f"its System V shared memory {wanted.identifier} is {made} here: that id was not available")
        return made

    def attached(self) -> None:
        """The program has them: those that go with it are marked so."""
        for identifier in self._passing:
            system_v_ipc.remove(identifier)

    def undo(self) -> None:
        """Remove what was made, for the restore has failed."""
        for identifier in self._made:
            system_v_ipc.remove(identifier)


def attach(table: CallTable, vmas: Iterable[Vma], ids: Mapping[int, int], sizes: Mapping[int, int]) -> None:
    """Add the calls that attach them where the program had them, all writable for now. Nothing else is mapped yet.

    Args:
        ids: of segments, there → here.
        sizes: of segments in bytes, by their ids there.
    """
    places: dict[tuple[int, int], list[Vma]] = {}
    for vma in vmas:
        places.setdefault((vma.file.inode if vma.file else 0, vma.start - vma.offset), []).append(vma)
    for (identifier, base), pieces in places.items():
        what = f"attach System V shared memory {ids[identifier]} at {base:#x}"
        table.call(what, "shmat", ids[identifier], base, 0, least=base, most=base)
        end = base + -(-sizes[identifier] // abi.PAGE_SIZE) * abi.PAGE_SIZE
        gap = base
        for piece in sorted(pieces, key=lambda piece: piece.start):
            _unmap(table, gap, piece.start)
            gap = piece.end
        _unmap(table, gap, end)


def _unmap(table: CallTable, start: int, end: int) -> None:
    if start < end:
        table.call(f"unmap {start:#x} of a segment", "munmap", start, end - start)


def sizes_of(resources: Iterable[Resource]) -> dict[int, int]:
    """The size of each segment, by its id there."""
    return {number_of(held.facts["id"]): number_of(held.facts["size"]) for held in resources if held.kind == KIND}
