"""Processes by descriptor (pidfd_open(2)): one that stands for a process of the program stands for it again.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``pid``: of another process of the component, as the program knows it; 0: its own;
of one that has ended, and was waited for, ``ended`` (see `departed`).

Source: pidfd_show_fdinfo() in fs/pidfs.c; pidfd_open(2).
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux import procfs
from checkpoint.linux.call_table import CallTable
from checkpoint.linux.descriptors import descriptors_to
from checkpoint.model import Fact, Resource
from checkpoint.resources import OpenFile, Surroundings, elsewhere
from checkpoint.resources.rebuilding import Rebuilding, number_of

KIND: Final = "pidfds"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES, "a pidfd of the program itself, of a child of it, or of a process that has ended", "it stands for it again"
    ),
    refused(
        Area.PIPES,
        "a pidfd of another program, or of a single thread; one that several processes share",
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
    if pid == NOBODY:
        facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, "pid": 0}
        return Resource(KIND, held.name, {**facts, "ended": held.first.inode})
    inner = procfs.status(pid).pids[-1] if pid in held.kin.pids and pid != held.pid else 0
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, "pid": inner})


def _target(held: OpenFile) -> int:
    return int(held.first.fields.get("Pid", NOBODY))


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a pidfd cannot be kept: it stands for somebody else."""
    if held.first.target != TARGET:
        return None
    pid = _target(held)
    if pid == NOBODY:
        is_kept = not held.first.flags & os.O_EXCL and not _is_of_several(held)
    else:
        is_kept = pid == held.pid or pid in held.kin.pids
    if is_kept and not held.description:
        return elsewhere.refuse(held, "a pidfd")
    whom = "a process that has ended" if pid == NOBODY else f"pid {pid}"
    if held.first.flags & os.O_EXCL:
        whom = "a single thread that has ended" if pid == NOBODY else f"the single thread {pid}"
    if held.description or (pid == NOBODY and not held.first.flags & os.O_EXCL):
        whom += " that several processes share"
    return f"{held.name} is a pidfd of {whom}, which is not kept yet: let the program close it, or wait by number"


def _is_of_several(held: OpenFile) -> bool:
    """Whether another process of the component has one of the same ended process: the same it could not become again."""
    others = (one for pid in held.kin.pids if pid != held.pid for one in descriptors_to(pid, TARGET))
    return any(one.inode == held.first.inode and int(one.fields.get("Pid", NOBODY)) == NOBODY for one in others)


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again."""
    if held.facts.get("ended"):
        return rebuilding.ended(table, held)
    flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_EXCL)
    return table.obtain(
        f"open the pidfd of {held.name}", "pidfd_open", number_of(held.facts["pid"]) or rebuilding.inner_pid, flags
    )
