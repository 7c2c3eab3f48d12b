"""Restore epoll instances of epoll(7) with every descriptor that they watch; an instance may watch another.

A registration belongs to an open file and to the number that it had when it was registered. This number may now be closed or lead
to another file. As long as the program has the open file under any number, the registration is restored under the old one. An
event that was reported once (EPOLLET) is reported once more after a restore. A registration that reports only once (EPOLLONESHOT)
and has reported stays silent, except for errors and hang-ups.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``watched``: a list of [number when it was registered, a descriptor that leads to
the same open file now, events, data].

Source: ep_show_fdinfo() in fs/eventpoll.c; kcmp(2), KCMP_EPOLL_TFD; epoll_ctl(2).
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final

from checkpoint.arch import stubs
from checkpoint.capability import Area, preserved, refused
from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "epolls"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "epoll, also nested",
        "with everything that it watches; it reports once more what it had reported by edge (EPOLLET)",
    ),
    refused(
        Area.PIPES,
        "an epoll instance that watches a descriptor which the program has closed and another process holds",
        "remove it from the instance (EPOLL_CTL_DEL) before closing it",
        "remove it (EPOLL_CTL_DEL)",
    ),
)

TARGET: Final = "anon_inode:[eventpoll]"

EPOLL_CTL_ADD: Final = 1
GONE: Final = -1
"""In place of a descriptor: the program has none any more that leads to what is watched."""

_WATCHED: Final = re.compile(rb"tfd: *(\d+) events: *([0-9a-f]+) data: *([0-9a-f]+) ")


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """The descriptors that it watches.

    Args:
        opened: everything that the process has open.
    """
    return {"watched": list(_watched(held, opened))}


def _watched(held: OpenFile, opened: Sequence[OpenFile]) -> Iterator[list[Fact]]:
    seen: dict[int, int] = {}
    for number, events, words in _WATCHED.findall(held.first.told):
        registered = int(number)
        slot = abi.EpollSlot(held.first.number, registered, seen.get(registered, 0))
        seen[registered] = seen.get(registered, 0) + 1
        yield [registered, _now(held, slot, opened), int(events, 16), int(words, 16)]


def _now(held: OpenFile, slot: abi.EpollSlot, opened: Sequence[OpenFile]) -> int:
    """A descriptor that leads to what is watched: that of the same number if it does, else the first that does, else `GONE`."""

    def leads_there(number: int) -> bool:
        return abi.kcmp(opened[0].pid, held.pid, abi.KCMP_EPOLL_TFD, number, ctypes.addressof(slot)) == 0

    if leads_there(slot.number):
        return int(slot.number)
    return next((one.first.number for one in opened if leads_there(one.first.number)), GONE)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The descriptors that it watches, as they were observed."""
    if held.first.target != TARGET:
        return None
    facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed}
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why an epoll instance cannot be kept."""
    if held.first.target != TARGET:
        return None
    if (closed := _closed(held)) is not None:
        return (
            f"{held.name} is an epoll instance that watches the former descriptor {closed}, which the program has closed and "
            "another process still holds: let the program remove it (EPOLL_CTL_DEL) before closing"
        )
    return other_holders.refuse(held, "an epoll instance")


def watches_what_is_gone(held: OpenFile) -> bool:
    """Whether it is an epoll instance that watches what the program has no descriptor of."""
    return held.first.target == TARGET and _closed(held) is not None


def _closed(held: OpenFile) -> int | None:
    """The number under which something was registered that the program has no descriptor of any more."""
    watched = held.observed.get("watched", [])
    assert isinstance(watched, list)
    return next((number_of(one[0]) for one in watched if isinstance(one, list) and one[1] == GONE), None)


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again; `settle` registers what it watches when everything is there."""
    return table.obtain(f"make the epoll instance of {held.name}", "epoll_create1", 0)


def settle(table: CallTable, held: Resource, descriptor: int, marked: Collection[int], spare: int) -> None:
    """Register what it watches.

    Args:
        descriptor: its own.
        marked: descriptors that are close-on-exec.
        spare: a number that is free.
    """
    watched = held.facts["watched"]
    assert isinstance(watched, list)
    for one in watched:
        assert isinstance(one, list)
        registered, now, events, word = map(number_of, one)
        what = f"watch descriptor {registered} by the epoll instance {held.name}"
        arguments = (descriptor, EPOLL_CTL_ADD, registered, table.place(stubs.EPOLL_EVENT.pack(events, word)))
        if now == registered:
            table.call(what, "epoll_ctl", *arguments)
        else:
            is_taken = registered in table.descriptors
            if is_taken:
                table.duplicate(registered, spare, os.O_CLOEXEC)
            table.duplicate(now, registered, 0)
            table.call(what, "epoll_ctl", *arguments)
            if is_taken:
                table.duplicate(spare, registered, os.O_CLOEXEC if registered in marked else 0)
            table.close(spare if is_taken else registered)
