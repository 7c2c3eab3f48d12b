"""How much older than told a value can be that came in a frame, though no two clocks agree.

A frame says when it left by its sender's clock, and for how long the sender had held the newest frame of ours. θ is our clock
minus the sender's, which is not known. Two things are sure of each frame:

    it did not arrive before it left:            θ ≤ came − left
    nor did ours, which it echoes:               θ ≥ instant at which ours left − (left − hold)

The second kind also bounds other frames: the way of one took came − left − θ, at most came − left − the greatest lower bound. A
bound gets worse as the clocks drift apart, by at most `DRIFT_PPM`. By the echo in the frame itself the way took at most the round
trip. By the echo of a faster round trip it took at most that one, and as much more as this frame waited longer.

The least round trip of the last 64 alone would not do as a bound: a frame that waited in a queue was longer on its way than the
fastest of 64. `tests/failover/core/frames/test_clock_offset.py` shows it. Round trips are for slots (`transit.py`).
"""

from __future__ import annotations

from typing import Final

from msgspec import Struct

DRIFT_PPM: Final = 1_200
"""Two clocks drift apart by less: NTP slews each by at most 500 ppm (adjtimex(2)), and each is wrong by less than 100."""

MILLION: Final = 1_000_000

RESOLUTION_NS: Final = 1_000
"""Instants and holds travel as microseconds, rounded down."""


class ClockOffset(Struct):
    """Our clock minus one peer's, on one medium, as far as it is known. All instants are ns.

    The caller may say of an arrival, or of a hold, that it was later or shorter than it was; that makes bounds wider, not wrong.

    Attributes:
        contradicted: how often frames arrived before they can have left: a clock was not what we believe of clocks. Then only the
            echo of that frame counts.
    """

    contradicted: int = 0
    _floor_ns: int | None = None
    _ceiling_ns: int | None = None

    def heard(self, left_ns: int, came_ns: int) -> None:
        """A frame of the peer left at ``left_ns`` of its clock and came at ``came_ns`` of ours."""
        bound = came_ns - left_ns - came_ns * DRIFT_PPM // MILLION
        if self._ceiling_ns is None or bound < self._ceiling_ns:
            self._ceiling_ns = bound

    def echoed(self, ours_left_ns: int, left_ns: int, hold_ns: int, came_ns: int) -> int | None:
        """That frame echoes ours, which left at ``ours_left_ns`` of our clock; the peer had held it for ``hold_ns``.

        Returns:
            `most_ns` of that frame.
        """
        bound = ours_left_ns - (left_ns - hold_ns) - RESOLUTION_NS + ours_left_ns * DRIFT_PPM // MILLION
        if self._floor_ns is None or bound > self._floor_ns:
            self._floor_ns = bound
        most_ns = self.most_ns(left_ns, came_ns)
        if most_ns is None:
            self.contradicted += 1
            self._floor_ns, self._ceiling_ns = bound, came_ns - left_ns - _drift(came_ns)
            return self.most_ns(left_ns, came_ns)
        return most_ns

    def most_ns(self, left_ns: int, came_ns: int) -> int | None:
        """The longest that a frame can have been on its way; None before the first echo, and where clocks contradict it."""
        if self._floor_ns is None:
            return None
        way_ns = came_ns - left_ns - self._floor_ns + came_ns * DRIFT_PPM // MILLION
        return way_ns + 2 * (way_ns * DRIFT_PPM // MILLION) if way_ns >= 0 else None

    def between(self, now_ns: int) -> tuple[int, int] | None:
        """θ lies between these two; None before the first echo. For people and for messages, never for a rule."""
        if self._floor_ns is None or self._ceiling_ns is None:
            return None
        return self._floor_ns - _drift(now_ns), self._ceiling_ns + _drift(now_ns)


def _drift(span_ns: int) -> int:
    return span_ns * DRIFT_PPM // MILLION
