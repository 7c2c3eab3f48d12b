"""Restore event counters of eventfd(2) with their count.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``count``; ``semaphore``: whether it was made with EFD_SEMAPHORE.

A kernel before Linux 6.5 does not report ``semaphore``. There the capture finds it out while every process that has the counter
is frozen: one read of a count of at least two shows it, and the capture gives back what the read took. A process that waits for
the counter wakes up from that and finds it unchanged. *Killed in the middle:* the count is wrong for good; that window is some
ten µs of each capture.

Source: eventfd_show_fdinfo(), eventfd_read() in fs/eventfd.c; the line eventfd-semaphore is of Linux 6.5.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "eventfds"

CAPABILITIES: Final = (preserved(Area.PIPES, "event counters (eventfd)", "with their count"),)

TARGET: Final = "anon_inode:[eventfd]"
EFD_SEMAPHORE: Final = 1
INITIAL_MAX: Final = (1 << 32) - 1
"""The largest count that eventfd(2) takes; a larger one is written."""
_TELLING: Final = 2
"""The least count of which one read tells the kind: a semaphore gives one."""
_SIZE: Final = 8
"""Bytes of a count that is read or written."""


def is_told(one: Descriptor) -> bool:
    """Whether the kernel tells of which kind it is."""
    return b"\neventfd-semaphore:" in one.told


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """The kind of one, where the kernel does not tell it. All processes that have it stand still.

    Raises:
        CaptureError: it cannot be asked.
    """
    count = _count(held.first)
    try:
        with copy_of(held.pid, held.first.number) as counter:
            if count < _TELLING:
                _add(counter, _TELLING - count)
            taken = _taken(counter)
            now = max(count, _TELLING) - taken
            while now > count:
                now -= _taken(counter)
            if now < count:
                _add(counter, count - now)
    except OSError as error:
        raise CaptureError(
            f"cannot find out of which kind the eventfd {held.name} of pid {held.pid} is: {error.strerror}; capture it again"
        ) from error
    return {"semaphore": taken == 1}


def _count(one: Descriptor) -> int:
    return int(one.fields["eventfd-count"], 16)


def _taken(counter: int) -> int:
    """The count that one read of it takes; it does not wait."""
    content = bytearray(_SIZE)
    os.preadv(counter, [content], -1, os.RWF_NOWAIT)
    return int.from_bytes(content, "little")


def _add(counter: int, count: int) -> None:
    os.write(counter, count.to_bytes(_SIZE, "little"))


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Its count and kind."""
    if held.first.target != TARGET:
        return None
    told = held.first.fields.get("eventfd-semaphore", "0") != "0"
    return Resource(
        KIND,
        held.name,
        {
            "descriptors": held.numbers,
            "flags": held.first.flags & ~os.O_CLOEXEC,
            "count": _count(held.first),
            "semaphore": held.observed.get("semaphore", told),
        },
    )


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why an eventfd cannot be kept."""
    return other_holders.refuse(held, "an eventfd") if held.first.target == TARGET else None


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again."""
    count, flags = number_of(held.facts["count"]), number_of(held.facts["flags"]) & os.O_NONBLOCK
    kind = EFD_SEMAPHORE if held.facts["semaphore"] else 0
    made = table.obtain(f"make the eventfd of {held.name}", "eventfd2", min(count, INITIAL_MAX), flags | kind)
    if count > INITIAL_MAX:
        rest = table.place((count - INITIAL_MAX).to_bytes(8, "little"))
        table.call(f"count up the eventfd of {held.name}", "write", made, rest, 8, least=8, most=8)
    return made
