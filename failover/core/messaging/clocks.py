"""How far two clocks are apart, from the stamps of messages between them; and where a message spent its time.

No clock is believed to be right. A message that left at ``a`` of clock A and came at ``b`` of clock B says: B − A is at most
b − a, because no message comes before it leaves. One the other way says: at least. Both bounds widen with time, because quartzes
drift by up to `DRIFT_PPM` each; all at the same rate, so the tightest one stays the tightest, and one of each is kept.

    offset B − A:   low ≤ offset ≤ high;   half the width is half of what the two fastest messages took together
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct

from failover.core.messaging.envelope import Hop

DRIFT_PPM: Final = 100
"""How much faster or slower than the second a quartz may be: the worst of cheap ones."""

_APART_PPM: Final = 2 * DRIFT_PPM + 1
"""Of two clocks against each other, seen by one of them, which may be slow itself."""

MILLION: Final = 1_000_000


class Bounds(Struct, frozen=True):
    """Between which values a duration or an offset lies, in ns. None: no message has bounded that side."""

    low_ns: int | None = None
    high_ns: int | None = None

    @property
    def middle_ns(self) -> int | None:
        """The estimate; None unless both sides are bounded."""
        return None if self.low_ns is None or self.high_ns is None else (self.low_ns + self.high_ns) // 2

    @property
    def half_ns(self) -> int | None:
        """The most by which the estimate is wrong."""
        return None if self.low_ns is None or self.high_ns is None else (self.high_ns - self.low_ns + 1) // 2


def _widened(ns: int) -> int:
    return -(-abs(ns) * _APART_PPM // MILLION)


class ClockPair:
    """The offset of clock B from clock A; instants ``at`` are A's."""

    def __init__(self) -> None:
        self._high: tuple[int, int] | None = None
        self._low: tuple[int, int] | None = None

    def forward(self, left_ns: int, came_ns: int) -> None:
        """A message left A, and came to B."""
        high = came_ns - left_ns
        if self._high is None or high < self._high[1] + _widened(left_ns - self._high[0]):
            self._high = left_ns, high

    def backward(self, left_ns: int, came_ns: int) -> None:
        """A message left B, and came to A."""
        low = left_ns - came_ns
        if self._low is None or low > self._low[1] - _widened(came_ns - self._low[0]):
            self._low = came_ns, low

    def offset(self, at_ns: int) -> Bounds:
        """B − A at that instant."""
        low = None if self._low is None else self._low[1] - _widened(at_ns - self._low[0])
        high = None if self._high is None else self._high[1] + _widened(at_ns - self._high[0])
        return Bounds(low, high)


class Part(Struct, frozen=True):
    """Where a message was for a while. ``to``: "" while it waited in ``who``, else to whom it travelled."""

    who: str
    to: str
    took: Bounds


Offsets = Callable[[str, str, int], Bounds]
"""Called with (A, B, instant of A): B − A."""


def parts(hops: Sequence[Hop], offsets: Offsets) -> list[Part]:
    """Waiting and travelling in turn, from the first hop to the last.

    Each clock measures its own waiting, right to `DRIFT_PPM`. Travelling lies between bounds, the low one 0 or more. If messages
    came in one direction only, one of the two is missing.
    """
    found: list[Part] = []
    for place, hop in enumerate(hops):
        if hop.left_ns is None:
            break
        found.append(Part(hop.who, "", _measured(hop.left_ns - hop.came_ns)))
        if place + 1 < len(hops):
            found.append(Part(hop.who, hops[place + 1].who, _travelled(hop, hops[place + 1], offsets)))
    return found


def further_ways(hops: Sequence[Hop], ways: Sequence[tuple[Hop, ...]]) -> list[tuple[Hop, ...]]:
    """Of ways that began with the same hop: those that went on from this one, each to its end, in the order in which they did.

    A driver that calls another one while it carries out a message has that one's stamp of arrival in both ways.
    """
    known = {_stations(way): way for way in ways}
    longest = [
        stations for stations in known if not any(stations == other[: len(stations)] for other in known if other != stations)
    ]
    own = _stations(hops)
    found = [known[one] for one in longest if len(one) > len(own) and one[: len(own)] == own]
    return sorted(found, key=lambda way: way[len(own) - 1].left_ns or 0)


def _stations(way: Sequence[Hop]) -> tuple[tuple[str, int], ...]:
    return tuple((hop.who, hop.came_ns) for hop in way)


def _measured(took_ns: int) -> Bounds:
    error_ns = _widened(took_ns)
    return Bounds(max(took_ns - error_ns, 0), max(took_ns + error_ns, 0))


def _travelled(hop: Hop, after: Hop, offsets: Offsets) -> Bounds:
    left_ns = hop.left_ns or 0
    offset = offsets(hop.who, after.who, left_ns)
    apart_ns = after.came_ns - left_ns
    high = None if offset.low_ns is None else max(apart_ns - offset.low_ns, 0)
    low = 0 if offset.high_ns is None else max(apart_ns - offset.high_ns, 0)
    return Bounds(low - _widened(low) if low else 0, None if high is None else high + _widened(high))
