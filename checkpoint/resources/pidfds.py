"""Processes by descriptor (pidfd_open(2)): one that stands for the program itself stands for it again.

Facts: ``descriptors``; ``flags`` of fcntl(2).

Source: pidfd_show_fdinfo() in fs/pidfs.c; pidfd_open(2).
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources import OpenFile, Surroundings, elsewhere
from checkpoint.resources.rebuilding import Rebuilding, number_of

KIND: Final = "pidfds"

CAPABILITIES: Final = (
    preserved(Area.PIPES, "a pidfd of the program itself", "it stands for it again"),
    refused(
        Area.PIPES,
        "a pidfd of another process, of one that has ended, or of a single thread",
        "let the program close them, or wait by number",
        "is a pidfd of {}, which is not kept",
    ),
)

TARGET: Final = "anon_inode:[pidfd]"
NOBODY: Final = -1
"""What fdinfo tells of a process that has ended, and has been waited for."""


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The program itself, by descriptor."""
    if held.first.target != TARGET:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a pidfd cannot be kept: it stands for somebody else."""
    if held.first.target != TARGET:
        return None
    pid = int(held.first.fields.get("Pid", NOBODY))
    if pid == held.pid:
        return elsewhere.refuse(held, "a pidfd")
    whom = "a process that has ended" if pid == NOBODY else f"pid {pid}"
    if held.first.flags & os.O_EXCL:
        whom = f"the single thread {pid}"
    return f"{held.name} is a pidfd of {whom}, which is not kept yet: let the program close it, or wait by number"


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again."""
    flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_EXCL)
    return table.obtain(f"open the pidfd of {held.name}", "pidfd_open", rebuilding.inner_pid, flags)
