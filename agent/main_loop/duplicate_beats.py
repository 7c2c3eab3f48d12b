"""Drops duplicate frames: each travels over every link of its sender; the first counts, later ones prove their links.

A copy says nothing about whether its sender lives: it proves a link, and only once. A copy that comes a second time over one link
is a replay.
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
        self._lives: dict[str, int] = {}
        self._brought: dict[str, OrderedDict[int, set[str]]] = {}
        self._carried: dict[str, dict[str, int]] = {}

    def heard(self, part: Part, link: str) -> None:
        """Note the first of a part."""
        if self._lives.get(part.sender) != part.boot:
            self._lives[part.sender] = part.boot
            self._brought[part.sender] = OrderedDict()
        brought = self._brought[part.sender]
        brought[part.counter] = {link}
        if len(brought) > RECENT_PARTS:
            brought.popitem(last=False)

    def admit(self, refused: Refused, link: str, now_ns: int) -> bool:
        """Whether what was refused as seen before is a copy of a recent part over a link that had not brought it yet.

        Args:
            link: the interface that it came over; one without a name is no proof of any.
        """
        brought = self._brought.get(refused.sender)
        links = brought.get(refused.counter) if brought and refused.reason is Reason.REPLAYED else None
        if not link or links is None or link in links:
            return False
        links.add(link)
        self._carried.setdefault(refused.sender, {})[link] = now_ns
        return True

    def take(self, sender: str) -> tuple[tuple[str, int], ...]:
        """(link, instant in ns) of the latest copy over each link since this was last asked."""
        return tuple(self._carried.pop(sender, {}).items())
