"""Read the timers of a process (timer_create(2)) from /proc."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

from msgspec import Struct

from checkpoint.linux.procfs.procfs import parse_fields


class TimerLine(Struct, frozen=True):
    """One timer of /proc/PID/timers; ``notify`` as of SIGEV_*, ``tid`` only with SIGEV_THREAD_ID."""

    timer_id: int
    signal: int
    value: int
    notify: int
    tid: int
    clock: int


_NOTIFY: Final[Mapping[str, int]] = {"signal": 0, "none": 1, "thread": 2}
SIGEV_THREAD_ID: Final = 4


def parse_timers(text: str) -> tuple[TimerLine, ...]:
    """Read /proc/PID/timers.

    Source: fs/proc/base.c, show_timer(): "ID:", "signal: N/hex-value", "notify: word/(pid|tid).N", "ClockID:".
    """
    return tuple(_timers_of(text))


def _timers_of(text: str) -> Iterator[TimerLine]:
    for block in re.split(r"(?m)^(?=ID:)", text):
        fields = parse_fields(block)
        if "ID" not in fields:
            continue
        signal, _, value = fields["signal"].partition("/")
        word, _, target = fields["notify"].partition("/")
        kind, _, number = target.partition(".")
        to_thread = kind == "tid"
        yield TimerLine(
            timer_id=int(fields["ID"]),
            signal=int(signal),
            value=int(value, 16),
            notify=_NOTIFY[word] | (SIGEV_THREAD_ID if to_thread else 0),
            tid=int(number) if to_thread else 0,
            clock=int(fields["ClockID"]),
        )
