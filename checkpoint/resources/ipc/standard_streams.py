"""Restore standard input, output and error: streams of the component, not of a robot.

A terminal, pipe or socket at 0, 1 or 2 becomes the restored side's own stream of that number. The guard's pipes show which
streams lead to the guard of the component. A regular file or a device there is no stream and is restored as itself. The same
holds for a pipe or socket of which the program also has the other end.

Facts: ``descriptors``; ``stream``, 0, 1 or 2: which of the vessel's own it becomes; ``flags`` of open(2) and fcntl(2).
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator, Sequence
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.engine import NOTED, Finding
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.model import Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings

KIND: Final = "streams"

CAPABILITIES: Final = (
    preserved(
        Area.TERMINALS,
        "standard input, output and error",
        "become the streams of the component at the other robot; nothing written is lost or repeated. Where another process "
        "read the output of a program that failover protect took, the lines since the last checkpoint come twice: failover "
        "check says so",
        "another process",
        "pid {} ({})",
    ),
)

STANDARD: Final = (0, 1, 2)
OUTPUTS: Final = {1: "output", 2: "error"}


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


def findings(opened: Sequence[OpenFile], surroundings: Surroundings) -> Iterator[Finding]:
    """Output of the first process of a component that another process reads: it does not go along."""
    for held in opened if surroundings.may_repeat else ():
        is_read = stat.S_ISFIFO(held.first.mode) or stat.S_ISSOCK(held.first.mode)
        outputs = [f"standard {OUTPUTS[one.number]}" for one in held.descriptors if one.number in OUTPUTS]
        if not (is_read and outputs) or held.first.target in surroundings.pipes or _stream_of(held, surroundings) is None:
            continue
        read = f"its {' and '.join(outputs)} {'is' if len(outputs) == 1 else 'are'} read by {_reader_of(held)}"
        text = (
            f"{read}, which does not move along: after a takeover failover "
            "logs shows its output, and the lines since the last checkpoint come twice. Start it by failover run --output "
            "committed instead"
        )
        yield Finding(KIND, held.name, NOTED, text)


def _reader_of(held: OpenFile) -> str:
    if (reader := other_holders.reader_of(held)) is not None:
        with contextlib.suppress(ProbeError, ProcessGoneError):
            return f"pid {reader} ({procfs.status(reader).name})"
    return "another process"


def _is_terminal(held: OpenFile) -> bool:
    """Whether it is a terminal: /dev/tty, a console or serial line, or the inside of a pseudo-terminal."""
    majors = (4, 5, *range(136, 144))  # Documentation/admin-guide/devices.txt
    return stat.S_ISCHR(held.first.mode) and os.major(held.first.rdev) in majors and held.first.rdev != os.makedev(5, 2)


def of_first(opened: Sequence[OpenFile], surroundings: Surroundings) -> dict[str, int]:
    """The streams of a component's first process that lead outside, by the kernel's name: its other processes have the same."""
    return {held.first.target: stream for held in opened if (stream := _stream_of(held, surroundings)) is not None}
