"""Restore descriptors of signalfd(2), from which signals are read. Signals that wait in them are the process's pending signals.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``mask``: the signals, bit 0 is signal 1.

Source: signalfd_show_fdinfo() in fs/signalfd.c.
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "signalfds"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "signals that are read (signalfd)",
        "with their mask; the signals that wait in them are the program's pending signals",
    ),
)

TARGET: Final = "anon_inode:[signalfd]"


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Its signals."""
    if held.first.target != TARGET:
        return None
    mask = int(held.first.fields["sigmask"], 16)
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, "mask": mask})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a signalfd cannot be kept."""
    return other_holders.refuse(held, "a signalfd") if held.first.target == TARGET else None


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again."""
    mask = table.place(number_of(held.facts["mask"]).to_bytes(abi.SIGSET_SIZE, "little"))
    flags = number_of(held.facts["flags"]) & os.O_NONBLOCK
    return table.obtain(f"make the signalfd of {held.name}", "signalfd4", -1, mask, abi.SIGSET_SIZE, flags)
