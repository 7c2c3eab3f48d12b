"""Processes by descriptor (pidfd_open(2)): one that stands for a process of the program stands for it again.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``pid``: of another process of the component, as the program knows it; 0: its own.

Source: pidfd_show_fdinfo() in fs/pidfs.c; pidfd_open(2).
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux import procfs
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources import OpenFile, Surroundings, elsewhere
from checkpoint.resources.rebuilding import Rebuilding, number_of

KIND: Final = "pidfds"

CAPABILITIES: Final = (
    preserved(Area.PIPES, "a pidfd of the program itself, or of a child of it", "it stands for it again"),
    refused(
        Area.PIPES,
        "a pidfd of another program, of a process that has ended, or of a single thread; one that several processes share",
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
    pid = _target(held)
    inner = procfs.status(pid).pids[-1] if pid in held.kin.pids and pid != held.pid else 0
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, "pid": inner})


def _target(held: OpenFile) -> int:
    return int(held.first.fields.get("Pid", NOBODY))


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a pidfd cannot be kept: it stands for somebody else."""
    if held.first.target != TARGET:
        return None
    pid = _target(held)
    if (pid == held.pid or pid in held.kin.pids) and not held.description:
        return elsewhere.refuse(held, "a pidfd")
    whom = "a process that has ended" if pid == NOBODY else f"pid {pid}"
    if held.first.flags & os.O_EXCL:
        whom = f"the single thread {pid}"
    if held.description:
        whom += " that several processes share"
    return f"{held.name} is a pidfd of {whom}, which is not kept yet: let the program close it, or wait by number"


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again."""
    flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_EXCL)
    return table.obtain(
        f"open the pidfd of {held.name}", "pidfd_open", number_of(held.facts["pid"]) or rebuilding.inner_pid, flags
    )
