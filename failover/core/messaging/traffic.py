"""Who talks to one driver: how often, how much, with which errors, how slowly; over the last hour. Pure: time is an argument.

Each edge (sender, verb) has a row for each of the last 60 minutes; the oldest leaves when a new one begins.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

MINUTES: Final = 60
MINUTE_NS: Final = 60_000_000_000

EDGES_MAX: Final = 1_024
"""Senders × verbs; further ones count together as `OTHERS`."""

OTHERS: Final = "others"
BY_HAND: Final = "by hand"
"""Messages without ``from``."""

STEPS: Final = 64
"""Classes of duration, each twice as long every second one: from a microsecond to an hour."""


def who(sender: str) -> str:
    """A sender without pid and number: what stays the same when it is started again."""
    if sender.startswith("by-hand-"):
        return BY_HAND
    name, dash, number = sender.rpartition("-")
    while dash and number.isdecimal():
        left = name
        name, dash, number = left.rpartition("-")
        if not (dash and number.isdecimal()):
            return left or sender
    return sender


Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Edge(Struct, frozen=True, rename={"sender": "from"}):
    """One row of a driver's answer to ``_graph``: what one sender has sent to one verb in the last hour.

    Attributes:
        p99_us: in which time 99 of 100 were answered; None: none was.
    """

    sender: str
    verb: str
    count: Count
    bytes: Count
    errors: Count
    p99_us: Annotated[float, Meta(ge=0)] | None = None


class Minute(Struct):
    """What one minute saw. ``durations``: class of `_step_of` → how many took so long."""

    number: int
    count: int = 0
    bytes: int = 0
    errors: int = 0
    durations: dict[int, int] = {}


class Traffic:
    """All edges that end at one driver."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], list[Minute]] = {}
        self._names: dict[str, str] = {}

    def came(self, sender: str, verb: str, size: int, now_ns: int) -> None:
        """A message of so many bytes has come; one that comes again counts again."""
        minute = self._minute(sender, verb, now_ns)
        minute.count += 1
        minute.bytes += size

    def done(self, sender: str, verb: str, took_ns: int, now_ns: int, *, is_error: bool) -> None:
        """It was handled, so long after it came."""
        minute = self._minute(sender, verb, now_ns)
        minute.errors += is_error
        step = _step_of(took_ns)
        minute.durations[step] = minute.durations.get(step, 0) + 1

    def rows(self, now_ns: int) -> list[dict[str, Any]]:
        """The edges of the last hour, each an `Edge` as plain data."""
        oldest = now_ns // MINUTE_NS - MINUTES
        found = []
        for (sender, verb), minutes in list(self._edges.items()):
            minutes[:] = [one for one in minutes if one.number > oldest]
            if not minutes:
                del self._edges[sender, verb]
                continue
            count, size, errors = (sum(getattr(one, name) for one in minutes) for name in ("count", "bytes", "errors"))
            found.append(Edge(sender, verb, count, size, errors, _p99_us(minutes)))
        return [msgspec.to_builtins(edge) for edge in found]

    def _minute(self, sender: str, verb: str, now_ns: int) -> Minute:
        name = self._names.get(sender)
        if name is None:
            if len(self._names) >= EDGES_MAX:
                self._names.clear()
            name = self._names[sender] = who(sender)
        minutes = self._edges.get((name, verb))
        if minutes is None:
            if len(self._edges) >= EDGES_MAX:
                name, verb = OTHERS, ""
            minutes = self._edges.setdefault((name, verb), [])
        number = now_ns // MINUTE_NS
        if not minutes or minutes[-1].number < number:
            minutes.append(Minute(number, durations={}))
            del minutes[:-MINUTES]
        return minutes[-1]


def _step_of(took_ns: int) -> int:
    """The class of a duration: ``n`` whole halves of a doubling above a microsecond."""
    us = max(took_ns, 0) // 1_000
    bits = us.bit_length()
    upper = bits > 1 and us * 2 >= 3 << (bits - 1)
    return min(2 * bits + upper, STEPS - 1)


def _most_us(step: int) -> int:
    """The longest duration of a class."""
    bits, upper = divmod(step, 2)
    if not bits:
        return 1
    return 1 << bits if upper or bits == 1 else 3 << (bits - 2)


def _p99_us(minutes: list[Minute]) -> int | None:
    """So many microseconds at most took 99 of 100; at most half too much."""
    steps: dict[int, int] = {}
    for one in minutes:
        for step, count in one.durations.items():
            steps[step] = steps.get(step, 0) + count
    left = sum(steps.values()) // 100
    for step in sorted(steps, reverse=True):
        if steps[step] > left:
            return _most_us(step)
        left -= steps[step]
    return None
