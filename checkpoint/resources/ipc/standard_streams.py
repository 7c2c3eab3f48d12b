"""Restore standard input, output and error: streams of the component, not of a robot.

A terminal, pipe or socket at 0, 1 or 2 becomes the restored side's own stream of that number. The guard's pipes show which
streams lead to the guard of the component. A regular file or a device there is no stream and is restored as itself. The same
holds for a pipe or socket of which the program also has the other end.

Facts: ``descriptors``; ``stream``, 0, 1 or 2: which of the vessel's own it becomes; ``flags`` of open(2) and fcntl(2).
"""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.model import Resource
from checkpoint.resources.open_file import OpenFile, Surroundings

KIND: Final = "streams"

CAPABILITIES: Final = (
    preserved(
        Area.TERMINALS,
        "standard input, output and error",
        "become the streams of the component at the other robot; nothing written is lost or repeated",
    ),
)

STANDARD: Final = (0, 1, 2)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The stream that an open file stands for, if it does."""
    stream = _stream_of(held, surroundings)
    if stream is None:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "stream": stream, "flags": held.first.flags & ~os.O_CLOEXEC})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Streams are never refused."""
    return None


def _stream_of(held: OpenFile, surroundings: Surroundings) -> int | None:
    guarded = surroundings.pipes.get(held.first.target)
    if guarded is not None:
        return guarded
    leads_to_itself = held.is_its_own and stat.S_ISFIFO(held.first.mode)
    if not surroundings.is_first or leads_to_itself or held.first.target in held.kin.pipes or held.observed.get("peer_is_ours"):
        return None  # the component's own: it leads from one of its processes to another, or to itself
    standard = next((one.number for one in held.descriptors if one.number in STANDARD), None)
    if standard is not None and (stat.S_ISFIFO(held.first.mode) or stat.S_ISSOCK(held.first.mode) or _is_terminal(held)):
        return standard
    return None


def _is_terminal(held: OpenFile) -> bool:
    """Whether it is a terminal: /dev/tty, a console or serial line, or the inside of a pseudo-terminal."""
    majors = (4, 5, *range(136, 144))  # Documentation/admin-guide/devices.txt
    return stat.S_ISCHR(held.first.mode) and os.major(held.first.rdev) in majors and held.first.rdev != os.makedev(5, 2)


def of_first(opened: Sequence[OpenFile], surroundings: Surroundings) -> dict[str, int]:
    """What leads outside from the first process of a component, by the kernel's name: its other processes have the same."""
    return {held.first.target: stream for held in opened if (stream := _stream_of(held, surroundings)) is not None}
