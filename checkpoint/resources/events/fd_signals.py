"""Signals of descriptors that become ready: F_SETOWN and F_SETSIG of fcntl(2), kept for every kind of open file.

Facts, added to a resource's own: ``signal`` (0 for SIGIO) and ``owner``: 1 if it is the process itself, 2 if its first thread
alone (F_OWNER_TID), 0 if there is none; in a component of several processes ``owner_pid``, which of them. One of its ``flags``
says whether signals are sent at all (O_ASYNC). Directory notifications (F_NOTIFY) cannot be queried; but nothing else gives a
directory an owner, so a directory that has an owner is refused.

Source: fcntl_dirnotify() in fs/notify/dnotify/dnotify.c.
"""

from __future__ import annotations

import fcntl
import os
import stat
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import signal_owners
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.signal_owners import O_PATH, OWNER

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "signals of a descriptor (F_SETOWN, F_SETSIG, O_ASYNC) to a process of the program, or to its first thread",
        "set again",
    ),
    refused(
        Area.PIPES,
        "signals of a descriptor to another process, a group or another thread",
        "let the program itself be the owner (F_SETOWN)",
        "sends its signals to",
    ),
    refused(Area.PIPES, "notifications of a directory by signals (F_NOTIFY)", "use inotify, which is preserved", "(F_NOTIFY)"),
)

F_SETOWN_EX: Final = 15
F_OWNER_TID: Final = 0
F_OWNER_PID: Final = 1
F_OWNER_PGRP: Final = 2
THE_PROCESS: Final = 1
ITS_FIRST_THREAD: Final = 2
_OWNERS: Final = {F_OWNER_PID: THE_PROCESS, F_OWNER_TID: ITS_FIRST_THREAD}
SETTABLE: Final = os.O_APPEND | os.O_ASYNC | os.O_DIRECT | os.O_NOATIME | os.O_NONBLOCK
"""The flags that F_SETFL changes; it ignores the rest."""


def describe(held: OpenFile) -> dict[str, Fact]:
    """The facts of one open file; none where nothing was set."""
    sent = signal_owners.of(held)
    if not sent:
        return {}
    if not _is_of_ours(held, sent.owner):
        return {"signal": sent.signal, "owner": 0}
    facts: dict[str, Fact] = {"signal": sent.signal, "owner": _OWNERS.get(sent.kind, 0)}
    return facts | ({"owner_pid": procfs.status(sent.owner).pids[-1]} if held.kin.pids else {})


def _is_of_ours(held: OpenFile, owner: int) -> bool:
    """Whether the owner is the process itself, or another one of its component."""
    return owner == procfs.status(held.pid).tgid or owner in held.kin.pids


def refuse(held: OpenFile) -> str | None:
    """Why its signals cannot be kept: they go to another process, or to a single thread."""
    sent = signal_owners.of(held)
    if not sent.owner:
        return None
    if stat.S_ISDIR(held.first.mode):
        return f"{held.name} is a directory whose changes are told by a signal (F_NOTIFY), which is not kept: use inotify"
    kind, owner = sent.kind, sent.owner
    if _is_of_ours(held, owner) and kind in _OWNERS:
        return None
    whom = {F_OWNER_TID: f"thread {owner} alone", F_OWNER_PGRP: f"process group {owner}"}.get(kind, str(owner))
    return f"{held.name} sends its signals to {whom}, not to the process itself, which is not kept: let the program own them"


def rebuild(table: CallTable, descriptor: int, held: Resource, inner_pid: int) -> None:
    """Set them again, as far as the process itself owns them. `settle` does the others: their owners may not be born yet."""
    if held.facts.get("owner") and held.facts.get("owner_pid", inner_pid) == inner_pid:
        _own(table, descriptor, held, inner_pid)
    if held.facts.get("signal"):
        table.call(f"choose the signal of {held.name}", "fcntl", descriptor, fcntl.F_SETSIG, int(str(held.facts["signal"])))
    flags = int(str(held.facts.get("flags", 0)))
    if flags & os.O_ASYNC:
        # open(2) takes the flag without asking for signals, and the kernel acts only where it changes (open(2), BUGS)
        for wanted in (flags & SETTABLE & ~os.O_ASYNC, flags & SETTABLE):
            table.call(f"ask for the signals of {held.name}", "fcntl", descriptor, fcntl.F_SETFL, wanted)


def settle(table: CallTable, descriptor: int, held: Resource) -> None:
    """Give them to whichever process of the component had them: all are there now; and begin to send them."""
    if held.facts.get("owner") and "owner_pid" in held.facts:
        _own(table, descriptor, held, number_of(held.facts["owner_pid"]))
    flags = number_of(held.facts.get("flags", 0))
    if flags & os.O_ASYNC and not flags & O_PATH:
        table.call(f"have {held.name} send signals", "fcntl", descriptor, fcntl.F_SETFL, flags)


def _own(table: CallTable, descriptor: int, held: Resource, pid: int) -> None:
    kind = F_OWNER_TID if held.facts["owner"] == ITS_FIRST_THREAD else F_OWNER_PID
    place = table.place(OWNER.pack(kind, pid))
    table.call(f"own the signals of {held.name}", "fcntl", descriptor, F_SETOWN_EX, place)


def disown(table: CallTable, descriptor: int) -> None:
    """Leave them without an owner for now."""
    table.call("disown the signals of a descriptor", "fcntl", descriptor, fcntl.F_SETOWN, 0)
