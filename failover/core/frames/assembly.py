"""Puts items together that came in several pieces: a value is given out when all of it is there, and never a part of it.

The pieces of one put follow each other in one frame. A piece that was lost, or a newer put, drops the put: the next one comes in
a round. What was dropped, and why, is counted by name.
"""

from __future__ import annotations

from collections import Counter, OrderedDict

from msgspec import Struct, field

from failover.core.frames.frame import Portion

UNFINISHED_MAX = 8
"""Items of one sender that are put together at one time: pieces of one follow each other, so more are never needed."""

INCOMPLETE = "item whose pieces did not all come"
CONTRADICTORY = "item whose pieces contradict each other"


class _Unfinished(Struct):
    put: int
    value: bytearray
    pieces: dict[int, int] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """Whether the pieces lie side by side from the beginning to the end."""
        at = 0
        while size := self.pieces.get(at, 0):
            at += size
        return at == len(self.value) and len(self.pieces) == self._steps(at)

    def _steps(self, end: int) -> int:
        at = steps = 0
        while at < end:
            at += self.pieces[at]
            steps += 1
        return steps


class Assembly:
    """The items under way to one robot. ``dropped``: by reason."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._of: dict[str, OrderedDict[int, _Unfinished]] = {}

    def take(self, sender: str, portion: Portion) -> Portion | None:
        """The whole item, if it is all there now. A piece that is sound lies inside of its value (`Portion.is_sound`)."""
        if portion.total == 0:
            return portion
        under_way = self._of.setdefault(sender, OrderedDict())
        item = under_way.get(portion.number)
        if item is None or item.put != portion.put:
            if item is not None:
                self._drop(under_way, portion.number, INCOMPLETE)
            if len(under_way) == UNFINISHED_MAX:
                self._drop(under_way, next(iter(under_way)), INCOMPLETE)
            item = under_way[portion.number] = _Unfinished(portion.put, bytearray(portion.total))
        if len(item.value) != portion.total:
            self._drop(under_way, portion.number, CONTRADICTORY)
            return None
        item.pieces[portion.offset] = len(portion.value)
        item.value[portion.offset : portion.offset + len(portion.value)] = portion.value
        if sum(item.pieces.values()) < portion.total:
            return None
        if not item.is_whole:
            self._drop(under_way, portion.number, CONTRADICTORY)
            return None
        del under_way[portion.number]
        return Portion(portion.number, portion.age_us, portion.put, bytes(item.value))

    def forget(self, sender: str) -> None:
        """It begins another life: its puts are counted anew."""
        self._of.pop(sender, None)

    def _drop(self, under_way: OrderedDict[int, _Unfinished], number: int, why: str) -> None:
        del under_way[number]
        self.dropped[why] += 1
