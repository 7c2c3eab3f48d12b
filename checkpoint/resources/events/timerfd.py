"""Restore timers of timerfd_create(2) with the rest of their time, minus the outage, and with their unread expirations.

A periodic timer keeps its own rhythm, and counts the expirations that it missed. A timer that was set to an hour of the day
(TFD_TIMER_ABSTIME of the realtime clock) keeps that hour.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``clock``; ``settings``: flags of timerfd_settime(2); ``value_ns``: until its next
expiration, 0 if disarmed; ``interval_ns``; ``ticks``: unread expirations; ``asked_ns``: the time of this reading by the realtime
clock, a moment after the snapshot's clocks were read.

Source: timerfd_show() in fs/timerfd.c; TFD_IOC_SET_TICKS in timerfd_create(2).
"""

from __future__ import annotations

import ctypes
import os
import re
import select
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.procfs.descriptors import copy_of, descriptor
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "timerfds"

CAPABILITIES: Final = (
    preserved(
        Area.TIME,
        "timers that are read (timerfd)",
        "with the time that was left, the outage counted, and with expirations that were not read yet",
    ),
)

TARGET: Final = "anon_inode:[timerfd]"

TFD_TIMER_ABSTIME: Final = 1
TFD_TIMER_CANCEL_ON_SET: Final = 2
TFD_IOC_SET_TICKS: Final = 0x40085400
REALTIME_CLOCKS: Final = (time.CLOCK_REALTIME, 8)
"""CLOCK_REALTIME and CLOCK_REALTIME_ALARM."""

_TICKS: Final = re.compile(rb"ticks: (\d+)\n")
_TOLD: Final = re.compile(rb"clockid: (\d+)\nticks: (\d+)\nsettime flags: (\d+)\n")
_TIMES: Final = struct.Struct("<4q")
_NS_PER_S: Final = 1_000_000_000
DUE_MS: Final = 2
"""How long a periodic timer of which nothing is left is given to go off: its processor may be late to notice, a virtual one above
all. One that was disarmed and has an interval still looks the same, and costs as much."""
SOONEST_WITH_TICKS_NS: Final = 200_000
"""A timer with unread expirations is not armed for less: the next one would come before they have been set."""

_libc = ctypes.CDLL(None, use_errno=True)


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """Its clock, how it was set, the time left, and the expirations that were not read.

    It goes on meanwhile, and may go off between two questions. Asking winds a periodic timer up that went off and was not read,
    so that its unread expirations can be told: `timerfd_gettime` changes nothing else.

    Raises:
        CaptureError: it cannot be asked.
    """
    told = _TOLD.search(held.first.told)
    assert told is not None, "every kernel with fdinfo tells of timers so"
    try:
        with copy_of(held.pid, held.first.number) as timer:
            interval_ns, value_ns, asked_ns = _times(timer)
            ticks = int(told[2])
            if not interval_ns:
                ticks = ticks or (_ticks(held) if _went_off(timer) else 0)
            else:
                value_ns, ticks, asked_ns = _periodic(held, timer, value_ns)
    except OSError as error:
        raise CaptureError(f"cannot ask the timerfd {held.name} of pid {held.pid}: {error.strerror}; try again") from error
    return {
        "clock": int(told[1]),
        "settings": int(told[3], 8),
        "value_ns": value_ns if interval_ns or not ticks else 0,
        "interval_ns": interval_ns,
        "ticks": ticks,
        "asked_ns": asked_ns,
    }


def _periodic(held: OpenFile, timer: int, value_ns: int) -> tuple[int, int, int]:
    """Of a periodic timer: the time left, how many expirations were not read, and when that was so."""
    while True:
        went_off, before_ns = _went_off(timer, 0 if value_ns else DUE_MS), value_ns
        ticks = _ticks(held) if went_off else 0
        _, value_ns, asked_ns = _times(timer)
        if not value_ns and not before_ns and not went_off:  # disarmed
            return 0, 0, asked_ns
        if 0 < value_ns <= before_ns:  # not wound up between two questions
            return value_ns, ticks, asked_ns


def _times(timer: int) -> tuple[int, int, int]:
    """The interval, the time left, and when that was so, by the calendar; ns."""
    times = ctypes.create_string_buffer(_TIMES.size)
    if _libc.timerfd_gettime(timer, times):
        abi.raise_errno("timerfd_gettime")
    asked_ns = time.time_ns()
    interval_s, interval_ns, value_s, value_ns = _TIMES.unpack(times.raw)
    return interval_s * _NS_PER_S + interval_ns, value_s * _NS_PER_S + value_ns, asked_ns


def _went_off(timer: int, patience_ms: int = 0) -> bool:
    """Whether it has expirations that were not read."""
    asking = select.poll()
    asking.register(timer, select.POLLIN)
    return bool(asking.poll(patience_ms))


def _ticks(held: OpenFile) -> int:
    """How many expirations were not read, by now."""
    again = descriptor(held.pid, held.first.number)
    counted = _TICKS.search(again.told) if again else None
    return int(counted[1]) if counted else 1


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The timer as it was observed."""
    if held.first.target != TARGET:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a timerfd cannot be kept."""
    return other_holders.refuse(held, "a timerfd") if held.first.target == TARGET else None


class Left(Struct, frozen=True):
    """The rest of a timer when some time has gone by."""

    value_ns: int
    ticks: int


def left_after(value_ns: int, interval_ns: int, ticks: int, elapsed_ns: int) -> Left:
    """The rest: the expirations of a periodic timer are counted, a single one goes off as soon as it is armed."""
    if not value_ns:
        return Left(0, ticks)
    if value_ns > elapsed_ns:
        return Left(value_ns - elapsed_ns, ticks)
    if not interval_ns:
        return Left(1, 0)
    missed, into = divmod(elapsed_ns - value_ns, interval_ns)
    return Left(interval_ns - into, ticks + 1 + missed)


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again and arm it."""
    facts = {
        name: number_of(held.facts[name])
        for name in ("clock", "settings", "value_ns", "interval_ns", "ticks", "flags", "asked_ns")
    }
    made = table.obtain(f"make the timerfd of {held.name}", "timerfd_create", facts["clock"], facts["flags"] & os.O_NONBLOCK)
    since_ns = rebuilding.clocks.realtime_ns + rebuilding.elapsed_ns - facts["asked_ns"]
    left = left_after(facts["value_ns"], facts["interval_ns"], facts["ticks"], since_ns)
    value_ns, settings = left.value_ns, 0
    if value_ns and left.ticks:
        value_ns = max(value_ns, SOONEST_WITH_TICKS_NS)
    if value_ns > 1 and facts["settings"] & TFD_TIMER_ABSTIME and facts["clock"] in REALTIME_CLOCKS:
        value_ns += facts["asked_ns"] + since_ns
        settings = facts["settings"] & (TFD_TIMER_ABSTIME | TFD_TIMER_CANCEL_ON_SET)
    if value_ns:
        times = _TIMES.pack(*divmod(facts["interval_ns"], _NS_PER_S), *divmod(value_ns, _NS_PER_S))
        table.call(f"arm the timerfd of {held.name}", "timerfd_settime", made, settings, table.place(times), 0)
    if left.ticks:
        lost = f"{left.ticks} expirations of {held.name} that were not read are lost"
        table.attempt(lost, "ioctl", made, TFD_IOC_SET_TICKS, table.place(left.ticks.to_bytes(8, "little")))
    return made
