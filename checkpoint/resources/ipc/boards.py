"""The team's board that a program has mapped (`failover.board`, failover_board.h): told, and never captured.

A board belongs to a robot, not to the programs that use it. Its pages are in no snapshot, so they neither count as shared memory
that others have, too, nor carry one robot's values to another. A restore maps private pages of zeros in their places, and opens
/dev/null in place of the files. A generation of zero tells the program's client that it must open the board again: it then opens
the board of the robot where it runs, and takes its locks there.

Its files have fixed names (``own``, ``private``, ``own+UID``, ``peer-ROBOT``, ``guest-WORLD.ROBOT``, ``agent``, and the tasks
of the robot, ``schedule``) in a directory ``/dev/shm/failover-…``; ``schedule`` also in one that is called ``failover-schedule``.
In any other directory a file counts as a board's if it also begins as one.

Facts of a descriptor: ``descriptors``, ``path``, ``flags`` of open(2). Facts of the mappings: ``descriptors`` (none),
``mappings``: [address, pages] of each.

Source: failover/core/board/BOARD.md.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Final

from msgspec.structs import replace

from checkpoint.capability import Area, preserved
from checkpoint.engine import KEPT, Finding
from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.linux.memory.tracker import BOARD
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import DELETED, MapsLine
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "board"
CAPABILITIES: Final = (
    preserved(
        Area.MEMORY,
        "the team's board (`failover.board`, failover_board.h)",
        "its pages are never captured; the program uses the board of the robot on which it resumes, from its next call on "
        "(docs/c.md)",
    ),
)

MAGIC: Final = b"\x89FOBRD\r\n"
PLACE: Final = "/dev/shm/failover-"
"""How the path of a board's directory begins where an agent makes it."""
SCHEDULE: Final = "/failover-schedule/schedule"
"""How the path of the schedule ends on a robot without a board."""
SCHEDULE_MAGIC: Final = b"\x89FOSCH\r\n"
NAMES: Final = ("own", "private", "agent", "schedule")
PREFIXES: Final = ("own+", "peer-", "guest-")
HARMLESS: Final = "/dev/null"
FLAGS: Final = os.O_ACCMODE | os.O_NONBLOCK
KNOWN_MAX: Final = 256
"""Files that are remembered, which were looked into."""


# --- Recognised --------------------------------------------------------------------------------------------------------


def is_board(pid: int, path: str, key: tuple[int, int]) -> bool:
    """Whether a file that a process has open, or mapped shared, is one of a board.

    Args:
        path: as the kernel tells it, with its " (deleted)".
        key: its device and inode number.
    """
    directory, _, name = path.removesuffix(DELETED).rpartition("/")
    if name not in NAMES and not name.startswith(PREFIXES):
        return False
    if directory.startswith(PLACE) and "/" not in directory[len(PLACE) :]:
        return True
    if path.removesuffix(DELETED).endswith(SCHEDULE):
        return True
    return not path.endswith(DELETED) and _begins_as_one(f"{procfs.outlook(pid)}{path}", key)


@lru_cache(maxsize=KNOWN_MAX)
def _begins_as_one(path: str, key: tuple[int, int]) -> bool:
    """Whether a file holds a board.

    Args:
        key: a file that is replaced under its name is another one.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:  # closed to us, or gone
        return False
    try:
        return stat.S_ISREG(os.fstat(descriptor).st_mode) and os.pread(descriptor, len(MAGIC), 0) in (MAGIC, SCHEDULE_MAGIC)
    except OSError:
        return False
    finally:
        os.close(descriptor)


def is_open_one(held: OpenFile) -> bool:
    """Whether an open file is one of a board."""
    first = held.first
    return stat.S_ISREG(first.mode) and is_board(held.pid, first.target, (first.device, first.inode))


# --- Mappings ----------------------------------------------------------------------------------------------------------


def as_told(pid: int, line: MapsLine) -> MapsLine:
    """A mapping of a board as a snapshot tells it: private pages without content. Any other as it is."""
    if not line.shared or not line.has_file or not is_board(pid, line.name, (line.device, line.inode)):
        return line
    return replace(line, name=BOARD, shared=False, offset=0, device=0, inode=0)


def describe_mappings(lines: Iterable[MapsLine]) -> tuple[Resource, ...]:
    """What a process has mapped of boards.

    Args:
        lines: as `as_told` gives them.
    """
    told: list[Fact] = [[line.start, line.size // PAGE_SIZE] for line in lines if line.name == BOARD]
    return (Resource(KIND, "board", {"descriptors": [], "mappings": told}),) if told else ()


def findings(pid: int, lines: Iterable[MapsLine]) -> Iterator[Finding]:
    """The same for an operator."""
    for line in lines:
        if as_told(pid, line) is not line:
            pages = line.size // PAGE_SIZE
            text = f"board, {pages} pages at address {line.start:#x}: the program uses the board of the robot on which it resumes"
            yield Finding("memory", line.name, KEPT, text)


# --- Descriptors -------------------------------------------------------------------------------------------------------


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """A board's file that is open."""
    if not is_open_one(held):
        return None
    path, flags = held.first.target.removesuffix(DELETED), held.first.flags & ~os.O_CLOEXEC
    return Resource(KIND, held.name, {"descriptors": held.numbers, "path": path, "flags": flags})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """None is refused."""
    return None


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open what no harm can be done to: the program's client closes it when it opens the board of this robot."""
    return table.open(HARMLESS, number_of(held.facts["flags"]) & FLAGS)
