"""Event counters of eventfd(2): made again with their count.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``count``; ``semaphore``: whether it was made with EFD_SEMAPHORE.

Source: eventfd_show_fdinfo() in fs/eventfd.c; the line eventfd-semaphore is of Linux 6.5.
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources import OpenFile, Surroundings, elsewhere
from checkpoint.resources.rebuilding import Rebuilding, number_of

KIND: Final = "eventfds"

CAPABILITIES: Final = (
    preserved(Area.PIPES, "event counters (eventfd)", "with their count"),
    refused(
        Area.PIPES,
        "an eventfd on a kernel before 6.5",
        "boot Linux 6.5 or later: an older one does not tell of which kind it is",
        "does not tell of which kind",
    ),
)

TARGET: Final = "anon_inode:[eventfd]"
EFD_SEMAPHORE: Final = 1
INITIAL_MAX: Final = (1 << 32) - 1
"""What eventfd(2) takes at first; more is written."""


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Its count and kind."""
    if held.first.target != TARGET:
        return None
    fields = held.first.fields
    return Resource(
        KIND,
        held.name,
        {
            "descriptors": held.numbers,
            "flags": held.first.flags & ~os.O_CLOEXEC,
            "count": int(fields["eventfd-count"], 16),
            "semaphore": fields["eventfd-semaphore"] != "0",
        },
    )


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why an eventfd cannot be kept."""
    if held.first.target != TARGET:
        return None
    if "eventfd-semaphore" not in held.first.fields:
        return f"{held.name} is an eventfd, and this kernel does not tell of which kind: boot Linux 6.5 or later"
    return elsewhere.refuse(held, "an eventfd")


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again."""
    count, flags = number_of(held.facts["count"]), number_of(held.facts["flags"]) & os.O_NONBLOCK
    kind = EFD_SEMAPHORE if held.facts["semaphore"] else 0
    made = table.obtain(f"make the eventfd of {held.name}", "eventfd2", min(count, INITIAL_MAX), flags | kind)
    if count > INITIAL_MAX:
        rest = table.place((count - INITIAL_MAX).to_bytes(8, "little"))
        table.call(f"count up the eventfd of {held.name}", "write", made, rest, 8, least=8, most=8)
    return made
