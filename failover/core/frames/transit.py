"""How long a frame travels, for the slots, without comparing two clocks: half of the least round trip of the last 64.

A frame echoes the counter of each sender heard lately, and for how long it held it. Round trip = (echo came − that frame left) −
hold; each difference is of one robot's own clock. It tells when a frame is likely to have left. It bounds no age: a frame may
have waited in a queue for much longer than the fastest of 64.
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
        self._least: dict[int, int] = {}

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
            trips = self._trips.setdefault(rank, deque(maxlen=TRIPS_MAX))
            trips.append(trip_ns)
            self._least[rank] = min(trips)

    def likely_ns(self, rank: int) -> int:
        """What is subtracted from an arrival to tell when the frame left."""
        least_ns = self._least.get(rank)
        return self._first_ns if least_ns is None else least_ns // 2

    def forget(self, rank: int) -> None:
        """A peer began a new life: it may be another machine at another place."""
        self._trips.pop(rank, None)
        self._least.pop(rank, None)
