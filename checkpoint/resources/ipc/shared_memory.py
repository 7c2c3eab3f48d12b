"""Shared memory that other programs also have: refused, or made the program's own copy by the rule ``shared_memory = "detach"``.

Data that programs exchange cannot move with one of them. Under the rule a snapshot tells of such memory as of memory without a
name: with all that it holds, read-only mappings included. A restore makes it anew, for all processes of the component together;
no name leads to it.

The check covers memory files, files in /dev/shm, deleted files and System V shared memory. Other files that are mapped shared lie
on a disk, where every robot has its own.

Facts of what is told to a restore: ``descriptors`` (none); ``names``: of the pieces that become the program's own copy.

Source: proc_pid_maps(5).
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.capability import Area, by_rule, refused
from checkpoint.engine import COPY_NOTE
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.memory.tracker import ANONYMOUS, MEMORY_PLACE
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.procfs import DELETED, MapsLine
from checkpoint.model import Fact, Resource
from checkpoint.resources.ipc import boards
from checkpoint.resources.ipc.middlewares import Middleware, made_by

KIND: Final = "detached_memory"

CAPABILITIES: Final = (
    by_rule(
        Area.MEMORY,
        'shared memory that another process has mapped, too (`shared_memory = "detach"`)',
        "the program gets a copy of its own with the content of the checkpoint: the others no longer see what it writes there, "
        "nor it what they write (docs/shared-memory.md)",
        "only what is mapped can be detached",
        "is a copy of its own (shared_memory =",
        "the program resumes with a copy of its own",
    ),
    refused(
        Area.MEMORY,
        "shared memory that another process has mapped, too",
        "turn it off in the middleware that made it, protect the other process with the program, or give the program a copy of "
        "its own (`--shared-memory detach`, docs/shared-memory.md)",
        "which stays behind:",
        "the shared memory {}{} is mapped by {} too",
        "pid {}",
    ),
)

_MAPPED: Final = re.compile(rb"^\S+ ...s \S+ (\S+ [1-9]\d*) +(/dev/shm/.*|.* \(deleted\))$", re.MULTILINE)
"""Device and inode number, and the name."""
FOREBEARS: Final = 8
"""Ancestors of a process that are looked at: a process that is born while we look at its component has few."""
NAMES_TOLD: Final = 2
"""Names of several pieces of one middleware, in one sentence."""

Object = tuple[int, int]
"""Device and inode number."""


class Mapped(Struct, frozen=True):
    """One piece of shared memory of a program that another process has mapped as well.

    Attributes:
        name: as the kernel calls it.
        pid: of the other process; of several the first.
        maker: the middleware that made it, if that is recognised.
    """

    key: Object
    name: str
    pid: int
    maker: Middleware | None


def mapped_elsewhere(pid: int, lines: Iterable[MapsLine], kin: Collection[int] = ()) -> tuple[Mapped, ...]:
    """The shared memory of a process that others, not of its component, have mapped as well.

    Args:
        lines: its mappings.
        kin: all processes of its component.
    """
    lines, found = tuple(lines), []
    asker = min(kin, default=pid)
    for key, name in dict(_objects_of(lines)).items():
        if boards.is_board(pid, name, key):
            continue
        mappers = _mappers(asker, time.monotonic_ns() // 1_000_000_000).get(_told(key), ())
        others = (other for other in mappers if other != pid and other not in kin and not _belongs(other, {pid, *kin}))
        if (other := next(others, None)) is not None:
            found.append(Mapped(key, name, other, made_by(name, (line.name for line in lines))))
    return tuple(found)


def of_all(mapped: Mapping[int, Sequence[MapsLine]]) -> tuple[Mapped, ...]:
    """The same of all processes of a component, each piece once.

    Args:
        mapped: their mappings, by pid.
    """
    found = (one for pid, lines in mapped.items() for one in mapped_elsewhere(pid, lines, mapped))
    return tuple({one.key: one for one in found}.values())


def refuse(pid: int, lines: Iterable[MapsLine], kin: Collection[int] = ()) -> Iterator[str]:
    """Why shared memory of a process cannot be kept, one sentence for what one middleware made. Arguments: `mapped_elsewhere`."""
    for pieces in _by_maker(mapped_elsewhere(pid, lines, kin)):
        first = pieces[0]
        cure = f"{first.maker.name} made it: {first.maker.cure}; or " if first.maker else ""
        yield (
            f"{_called(pieces)}, which stays behind: {cure}protect both as one component, or say --shared-memory detach: "
            "the program then resumes with a copy of its own, which the others do not see (docs/shared-memory.md)"
        )


def detached(found: Iterable[Mapped]) -> Iterator[str]:
    """The effect of the rule ``detach``, for an operator."""
    for pieces in _by_maker(found):
        yield (
            f'{_called(pieces)}. By the rule shared_memory = "detach" the program resumes with a copy of its own: others no '
            "longer see what it writes there, nor it what they write"
        )


def _by_maker(found: Iterable[Mapped]) -> Iterable[list[Mapped]]:
    """Pieces that are told together."""
    together: dict[tuple[int, str], list[Mapped]] = {}
    for one in found:
        together.setdefault((one.pid, one.maker.name) if one.maker else (one.pid, one.name), []).append(one)
    return together.values()


def _called(pieces: list[Mapped]) -> str:
    """Their names, and the process that maps them too."""
    names = ", ".join(one.name for one in pieces[:NAMES_TOLD])
    more = f" and {len(pieces) - NAMES_TOLD} more" if len(pieces) > NAMES_TOLD else ""
    return f"the shared memory {names}{more} is mapped by {_who(pieces[0].pid)} too"


def _who(pid: int) -> str:
    try:
        return f"pid {pid} ({procfs.status(pid).name})"
    except (ProbeError, ProcessGoneError):
        return f"pid {pid}"


# --- The rule ``detach`` -------------------------------------------------------------------------------------------------


def seen_detached(line: MapsLine, objects: Collection[Object]) -> MapsLine:
    """A shared mapping as the kernel would show it if no name led to its object any more."""
    if not line.shared or line.name.endswith(DELETED) or (line.device, line.inode) not in objects:
        return line
    return replace(line, name=f"{line.name}{DELETED}")


def descriptor_detached(one: Descriptor, objects: Mapping[Object, int]) -> Descriptor:
    """An open file as it would be shown then; what it holds comes with the mappings."""
    if (one.device, one.inode) not in objects or one.target.endswith(DELETED):
        return one
    return replace(one, target=f"{one.target}{DELETED}", links=0, stored=0)


def covered(lines: Iterable[MapsLine], objects: Collection[Object]) -> dict[Object, int]:
    """How many bytes of each object, from its beginning on, some mapping shows.

    Args:
        lines: of all processes of the component.
    """
    ends = dict.fromkeys(objects, 0)
    shared = (line for line in lines if line.shared and (line.device, line.inode) in ends)
    for line in sorted(shared, key=lambda line: line.offset):
        key = line.device, line.inode
        if line.offset <= ends[key]:
            ends[key] = max(ends[key], line.offset + line.size)
    return ends


def refuse_partial(one: Descriptor, objects: Mapping[Object, int]) -> str | None:
    """Why an open file cannot be detached: of what the program has not mapped nothing is carried."""
    size = objects.get((one.device, one.inode))
    if size is None or one.size <= size:
        return None
    return (
        f"{one.name} is {one.target}, shared memory of {one.size} bytes that others have mapped, too, and of which the program "
        f"has mapped {size}: only what is mapped can be detached; let the program map all of it, or close it"
    )


def describe(objects: Iterable[tuple[Object, str]]) -> tuple[Resource, ...]:
    """Tell a restore that these become the program's own copy.

    Args:
        objects: with their names.
    """
    names: list[Fact] = [name for _, name in objects]
    return (Resource(KIND, "detached shared memory", {"descriptors": [], "names": names}),) if names else ()


def notes(resources: Iterable[Resource]) -> tuple[str, ...]:
    """Sentences for the operator about a program that was restored."""
    told = [name for held in resources if held.kind == KIND for name in _names(held.facts["names"])]
    if not told:
        return ()
    more = f" and {len(told) - NAMES_TOLD} more" if len(told) > NAMES_TOLD else ""
    names = ", ".join(told[:NAMES_TOLD])
    return (f'{COPY_NOTE} {names}{more} is a copy of its own (shared_memory = "detach"): no other process sees it',)


def _names(fact: Fact) -> list[str]:
    assert isinstance(fact, list)
    return [str(name).removesuffix(DELETED) for name in fact]


# --- Which processes map which objects ----------------------------------------------------------------------------------


def _belongs(other: int, kin: Collection[int]) -> bool:
    """Whether a process was born of these since they were looked at, or has ended since."""
    forebear, is_there = other, False
    try:
        for _ in range(FOREBEARS):
            if forebear in kin:
                return True
            forebear, is_there = procfs.stat(forebear).ppid, True
    except ProcessGoneError:
        return not is_there  # else it is a forebear that has ended, or there is none
    return False


def _told(key: Object) -> bytes:
    """As /proc/PID/maps tells it."""
    return b"%02x:%02x %d" % (os.major(key[0]), os.minor(key[0]), key[1])


def _objects_of(lines: Iterable[MapsLine]) -> Iterator[tuple[Object, str]]:
    """As `_objects`, of mappings that have been read."""
    for line in lines:
        is_object = line.name.startswith(MEMORY_PLACE) or (line.name.endswith(DELETED) and line.name != ANONYMOUS)
        if line.shared and line.inode and is_object:
            yield (line.device, line.inode), line.name


def _objects(pid: int) -> Iterator[tuple[bytes, bytes]]:
    for key, name in _MAPPED.findall(procfs.read_bytes(pid, "maps")):
        if os.fsdecode(name) != ANONYMOUS:
            yield key, name


@lru_cache(maxsize=1)
def _mappers(asker: int, second: int) -> dict[bytes, list[int]]:
    """The processes that map each object, by device and inode number.

    Args:
        asker: a process of the component about which it is asked: each looks for itself.
        second: of our clock; all that is asked within one second looks once.
    """
    found: dict[bytes, list[int]] = {}
    for other in os.listdir("/proc"):
        if not other.isdigit() or int(other) == os.getpid():
            continue
        try:
            objects = dict(_objects(int(other)))
        except (ProbeError, ProcessGoneError):  # another user's, or ended meanwhile
            continue
        for key in objects:
            found.setdefault(key, []).append(int(other))
    return found
