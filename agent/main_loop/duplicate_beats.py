"""Drops duplicate frames: each travels over every link of its sender; the first counts, later ones prove their links.

A copy says nothing about whether its sender lives: it proves a link, and only once. A frame may come over one link by cast and by
unicast. A copy that comes a second time by the same way is a replay.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from failover.core.frames.frame import WINDOW, Part, Reason, Refused

RECENT_PARTS: Final = WINDOW
"""A part of a frame that was heard on one link may come over a slower one by so many parts later; an older copy is a replay."""


class Copies:
    """Which links brought the newest parts of each sender's frames."""

    def __init__(self) -> None:
        self._lives: dict[tuple[str, int], int] = {}
        self._brought: dict[tuple[str, int], OrderedDict[int, set[tuple[str, bool]]]] = {}
        self._carried: dict[str, dict[str, int]] = {}

    def heard(self, part: Part, link: str, *, cast: bool = False) -> None:
        """Note the first of a part; ``cast``: it came as one datagram for all."""
        lane = (part.sender, part.medium)
        if self._lives.get(lane) != part.boot:
            self._lives[lane] = part.boot
            self._brought[lane] = OrderedDict()
        brought = self._brought[lane]
        brought[part.counter] = {(link, cast)}
        if len(brought) > RECENT_PARTS:
            brought.popitem(last=False)

    def admit(self, refused: Refused, link: str, now_ns: int, *, medium: int = 0, cast: bool = False) -> bool:
        """Whether what was refused as seen before is a copy of a recent part by a way that had not brought it yet.

        Args:
            link: the interface that it came over; one without a name is no proof of any.
            medium: of the lane that refused it.
        """
        brought = self._brought.get((refused.sender, medium))
        ways = brought.get(refused.counter) if brought and refused.reason is Reason.REPLAYED else None
        if not link or ways is None or (link, cast) in ways:
            return False
        ways.add((link, cast))
        self._carried.setdefault(refused.sender, {})[link] = now_ns
        return True

    def take(self, sender: str) -> tuple[tuple[str, int], ...]:
        """(link, instant in ns) of the latest copy over each link since this was last asked."""
        return tuple(self._carried.pop(sender, {}).items())
