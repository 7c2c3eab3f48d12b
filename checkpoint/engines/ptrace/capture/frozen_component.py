"""The result of one freeze of a component."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from msgspec import Struct, field

from checkpoint.engines.ptrace.capture.process import Look
from checkpoint.engines.ptrace.capture.tree import SeenOthers
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.system_v_ipc import Segment
from checkpoint.resources.carried.capture import Seen
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.sockets import tcp_handover
from checkpoint.resources.sockets.tcp_handover import Departing


class Frozen(Struct, frozen=True):
    """Everything that one freeze has read; nothing in it needs the process any more.

    Attributes:
        first: of the first process.
        others: the looks at the others; None where there are none.
        freeze_us: how long the program stood still; of several times, which a capture that is made again has, the longest.
        seen: its carried files.
        departing: its connections, where it may stand still for good.
        segments: System V shared memory of this machine, where any of them has some attached.
    """

    first: Look
    others: SeenOthers | None
    freeze_us: int
    seen: Seen = field(default_factory=Seen)
    departing: Departing = tcp_handover.NOBODY
    segments: Mapping[int, Segment] = field(default_factory=dict)


def opened(first: Look, others: SeenOthers | None) -> list[OpenFile]:
    """The open files of all processes."""
    looks = [first, *(look for _, look in others.looks())] if others else [first]
    return [held for look in looks for held in look.standing.opened]


def lines_of_all(first: Look, others: SeenOthers | None) -> Iterator[MapsLine]:
    """The mappings of all processes."""
    yield from first.taken.lines
    for _, other in others.looks() if others else ():
        yield from other.taken.lines


def shared_inodes(first: Look, others: SeenOthers | None) -> set[int]:
    """The inodes of files that any of the processes has mapped to be shared."""
    return {line.inode for line in lines_of_all(first, others) if line.shared}
