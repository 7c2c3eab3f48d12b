"""How long a frame travels, without comparing two clocks: the least round trip of the last 64, half of it each way.

A frame echoes the counter of each sender heard lately, and for how long it held it. Round trip = (echo came − that frame left) −
hold; each difference is of one robot's own clock. The true one-way delay lies between 0 and the round trip, so a value's age has
an upper bound though no two clocks agree.
"""

from __future__ import annotations

from collections import OrderedDict, deque

LEFT_MAX = 64
"""Frames of ours whose instant of leaving is remembered: at 20 ms more than a second."""

TRIPS_MAX = 64
"""Round trips of which the least counts; older ones are of another place of a robot that drives."""

TRIP_NS_MAX = 2_000_000_000
"""A longer round trip is none: its hold was not told right."""


class Transit:
    """Of one medium: when our frames left, and the round trips with each peer."""

    def __init__(self, first_us: int) -> None:
        self._first_ns = first_us * 1_000
        self._left: OrderedDict[int, int] = OrderedDict()
        self._trips: dict[int, deque[int]] = {}

    def left(self, counter: int, now_ns: int) -> None:
        """Our frame of this number left."""
        self._left[counter] = now_ns
        if len(self._left) > LEFT_MAX:
            self._left.popitem(last=False)

    def echoed(self, rank: int, counter: int, hold_us: int, came_ns: int) -> None:
        """A peer's frame said that it had held our frame of this number for so long."""
        left_ns = self._left.get(counter)
        trip_ns = came_ns - left_ns - hold_us * 1_000 if left_ns is not None else -1
        if 0 <= trip_ns <= TRIP_NS_MAX:
            self._trips.setdefault(rank, deque(maxlen=TRIPS_MAX)).append(trip_ns)

    def most_ns(self, rank: int) -> int | None:
        """The most that a frame of this peer can have travelled at its fastest; None before the first echo."""
        trips = self._trips.get(rank)
        return min(trips) if trips else None

    def likely_ns(self, rank: int) -> int:
        """What is subtracted from an arrival to tell when the frame left."""
        trips = self._trips.get(rank)
        return min(trips) // 2 if trips else self._first_ns

    def forget(self, rank: int) -> None:
        """A peer began a new life: it may be another machine at another place."""
        self._trips.pop(rank, None)
