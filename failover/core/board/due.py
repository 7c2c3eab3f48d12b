"""Which of a robot's items go into its next frame: those whose round it is, and those that found no room in the frame before.

An item of period P and phase p is due in the rounds r with (r − p) mod P = 0, whether its value is new or not: what was lost is
repaired, and the load is constant. What did not fit goes first in the next frame, so that no item waits for two frames because
others are due in each. An urgent item that was put goes at once, besides: `Bucket` says how often.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from msgspec import Struct

URGENT_PER_S = 10
"""Frames that one item may bring about in a second, besides the rounds; as many at one time."""

NS_PER_S = 1_000_000_000


class Sent(Struct, frozen=True):
    """An item as far as its turn is concerned."""

    number: int
    period: int
    phase: int


class Turns:
    """Whose turn it is. ``waited``: number of an item → frames in which it found no room."""

    def __init__(self) -> None:
        self.waited: Counter[int] = Counter()
        self._items: dict[int, Sent] = {}
        self._always: list[int] = []
        self._waiting: dict[int, None] = {}

    def hold(self, items: Iterable[Sent]) -> None:
        """These are the items now, in their order; what waits and is none of them any more is forgotten."""
        self._items = {item.number: item for item in items}
        self._always = list(self._items) if all(item.period == 1 for item in self._items.values()) else []
        self._waiting = {number: None for number in self._waiting if number in self._items}

    def due(self, round_: int, since: int | None = None) -> list[int]:
        """Numbers of the items for the frame of this round, in the order in which they are to find room.

        Args:
            since: round of the frame before, for frames that leave more seldom than rounds pass: a turn after that counts, too.
        """
        waiting = list(self._waiting)
        if self._always and (since is None or round_ > since):
            turn = self._always
        elif since is None:
            turn = [item.number for item in self._items.values() if (round_ - item.phase) % item.period == 0]
        else:
            turn = [
                item.number
                for item in self._items.values()
                if (round_ - item.phase) // item.period > (since - item.phase) // item.period
            ]
        return [*waiting, *[number for number in turn if number not in self._waiting]] if waiting else turn

    def left(self, numbers: Iterable[int]) -> None:
        """These found no room in the frame, in this order; all others that were due did, or had no value."""
        self._waiting = dict.fromkeys(numbers)
        if self._waiting:
            self.waited.update(self._waiting.keys())


class Bucket(Struct):
    """How many urgent frames one item may still bring about."""

    _tokens: float = URGENT_PER_S
    _at_ns: int = 0

    def take(self, now_ns: int) -> bool:
        """Whether this one may; it counts then."""
        if self._at_ns:
            self._tokens = min(self._tokens + (now_ns - self._at_ns) * URGENT_PER_S / NS_PER_S, URGENT_PER_S)
        self._at_ns = now_ns
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True
