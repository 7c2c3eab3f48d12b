"""Restore descriptors of processes (pidfd_open(2)) so that each leads to the same process of the program.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``pid``: of another process of the component, as the program knows it; 0: its own.
For a process that has ended and was waited for, ``ended`` (see `checkpoint.resources.process.exited_processes`). For a single
thread of the process that holds the descriptor, ``thread``, its id: the thread does not exist before the threads are created, so
the descriptor leads to the process itself until then.

Source: pidfd_show_fdinfo() in fs/pidfs.c; pidfd_open(2).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.engine import REFUSED, Finding
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "pidfds"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "a pidfd of the program itself, of its child or thread, or of a process that has ended",
        "stands for the same process or thread again",
    ),
    refused(
        Area.PIPES,
        "a pidfd of another program, of a thread that has ended, that an epoll instance watches, or that is on its way in "
        "a unix socket; a pidfd of a living process that several processes share",
        "let the program close it, or wait for the process by its number",
        "is a pidfd of {}, which is not kept",
    ),
)

TARGET: Final = "anon_inode:[pidfd]"
NOBODY: Final = -1
"""The pid that fdinfo tells of a process that has ended, and has been waited for."""


def is_of_ended(one: Descriptor) -> bool:
    """Whether it stands for a process that has ended, and has been waited for."""
    return one.target == TARGET and not one.flags & os.O_EXCL and _pid_in(one) == NOBODY


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """Facts of a pidfd of a single thread of its process: that thread's id for the program, and whether epoll watches it."""
    tid = _target(held)
    if tid in (NOBODY, _process(held)) or not held.first.flags & os.O_EXCL:
        return {}
    try:
        inner = procfs.parse_status(procfs.read_text(held.pid, f"task/{tid}/status")).pids[-1]
    except (ProcessGoneError, ProbeError):
        return {}
    numbers = {one.number for one in held.descriptors}
    return {"thread": inner, "is_watched": any(int(word) in numbers for one in opened for word in _watched_by(one))}


def _watched_by(held: OpenFile) -> Iterator[str]:
    """The numbers that an epoll instance watches; of anything else none."""
    lines = (line.split() for line in held.first.text.splitlines() if line.startswith("tfd:"))
    return (words[1] for words in lines)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The program itself, by descriptor."""
    if held.first.target != TARGET:
        return None
    pid = _target(held)
    if pid == NOBODY:
        facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, "pid": 0}
        return Resource(KIND, held.name, {**facts, "ended": held.first.inode})
    inner = procfs.status(pid).pids[-1] if pid in held.kin.pids and pid != _process(held) else 0
    flags = held.first.flags & ~os.O_CLOEXEC
    thread: dict[str, Fact] = {"thread": held.observed["thread"]} if "thread" in held.observed else {}
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": flags, "pid": inner, **thread})


def _target(held: OpenFile) -> int:
    return _pid_in(held.first)


def _process(held: OpenFile) -> int:
    """The process that has it, as pidfds name one: `OpenFile.pid` may be its spokesman's."""
    return procfs.status(held.pid).tgid


def _pid_in(one: Descriptor) -> int:
    return int(one.fields.get("Pid", NOBODY))


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a pidfd cannot be kept: it stands for another process."""
    if held.first.target != TARGET:
        return None
    pid = _target(held)
    is_of_thread = bool(held.first.flags & os.O_EXCL)
    if is_of_ended(held.first):
        return other_holders.refuse(held, "a pidfd")
    is_kept = pid == _process(held) or pid in held.kin.pids or ("thread" in held.observed and not held.observed["is_watched"])
    if is_kept and not held.description:
        return other_holders.refuse(held, "a pidfd")
    whom = f"pid {pid}"
    if is_of_thread:
        whom = "a single thread that has ended" if pid == NOBODY else f"the single thread {pid}"
        whom += " that an epoll instance watches" if held.observed.get("is_watched") else ""
    if held.description:
        whom += " that several processes share"
    return f"{held.name} is a pidfd of {whom}, which is not kept yet: let the program close it, or wait by number"


def findings(held: Sequence[Resource]) -> Iterator[Finding]:
    """Refuse pidfds of threads that are also on their way in a socket: one sent before threads are born is of the process."""
    messages = [numbers for one in held for numbers in _list(one.facts.get("passed", []))]
    passed = {number for numbers in messages for number in _list(numbers)}
    for one in held:
        thread = number_of(one.facts.get("thread", 0)) if one.kind == KIND else 0
        if thread and passed & {_list(pair)[0] for pair in _list(one.facts["descriptors"])}:
            whom = f"the single thread {thread} that is on its way in a unix socket, too"
            text = f"{one.name} is a pidfd of {whom}, which is not kept yet: {AS_SOON_AS} the program has received that"
            yield Finding(KIND, one.name, REFUSED, text)


def _list(fact: Fact) -> list[Fact]:
    assert isinstance(fact, list)
    return fact


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again."""
    if held.facts.get("ended"):
        return rebuilding.ended(table, held)
    flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_EXCL)
    if held.facts.get("thread"):
        return table.obtain(f"open a place for {held.name}", "pidfd_open", rebuilding.inner_pid, 0)
    return table.obtain(
        f"open the pidfd of {held.name}", "pidfd_open", number_of(held.facts["pid"]) or rebuilding.inner_pid, flags
    )


def settle(table: CallTable, resources: Iterable[Resource]) -> None:
    """Have those that stand for a thread do so, now that it has been born."""
    for held in resources:
        if held.kind == KIND and held.facts.get("thread"):
            flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_EXCL)
            made = table.obtain(f"open the pidfd of {held.name}", "pidfd_open", number_of(held.facts["thread"]), flags)
            descriptors = held.facts["descriptors"]
            assert isinstance(descriptors, list)
            for one in descriptors:
                assert isinstance(one, list)
                table.duplicate(made, number_of(one[0]), os.O_CLOEXEC if one[1] else 0)
            table.close(made)
