"""When the next heartbeat of a robot is due.

All members beat right after the one of the living that has the least name: what all say at one instant, each hears in one turn. A
turn after a sleep is dear, because by then the processor's caches hold other programs.
"""

from __future__ import annotations

from typing import Final

from msgspec import Struct

from failover.core.types import MS

URGENT_GAP_NS: Final = 2 * MS
"""Between a beat and the next one that carries a change: a flurry of changes makes no flood of beats."""

FREE_NS: Final = 1_500 * MS
"""For so long after its birth a robot follows no other: robots that start at one instant then claim at one instant, too."""

EARLY_PART: Final = 10
"""By this part of a period a beat leaves early at most, so that it follows the first member's…"""

LATE_PART: Final = 25
"""…and by this part of it late, where it followed the one before; by two of them where it left just before that."""


def least_ns(period_ns: int) -> int:
    """Between two beats at least, unless the second one carries a change."""
    return period_ns - period_ns // EARLY_PART


class BeatPace(Struct):
    """Of one life of a robot.

    A beat that leaves early, because it carries a change, is one more: the next regular one leaves when it would have left
    anyway. So robots that make a checkpoint ten times a second still beat together.

    Attributes:
        born_ns: when that began.
        next_ns: when the next beat is due.
        last_ns: when the newest one left.
        follows: the next beat is due at once, as soon as all is taken in that has come with the first member's.
    """

    born_ns: int
    next_ns: int
    last_ns: int = 0
    follows: bool = False
    _regular_ns: int = 0
    _due_ns: int = 0
    _patience_ns: int = 0
    _is_together: bool = False

    def left(self, now_ns: int, period_ns: int) -> None:
        """A beat leaves now."""
        self.last_ns = now_ns
        if not self.follows and now_ns < self._due_ns - period_ns // EARLY_PART:
            self.next_ns = self._due_ns
            return
        self._regular_ns, self._is_together = now_ns, self.follows
        self.next_ns = self._due_ns = now_ns + period_ns + self._patience_ns
        self.follows, self._patience_ns = False, 0

    def press(self) -> None:
        """A beat is due at once, as it carries a change."""
        self.next_ns = min(self.next_ns, self.last_ns + URGENT_GAP_NS)

    def tick(self, now_ns: int) -> None:
        """All that has come is taken in."""
        if self.follows:
            self.next_ns = min(self.next_ns, now_ns)

    def follow(self, now_ns: int, period_ns: int) -> None:
        """The first member has just beaten: so does this one, or it comes nearer to that instant by its next beat."""
        patience_ns, earliest_ns = period_ns // LATE_PART, self._regular_ns + least_ns(period_ns)
        if now_ns - self.born_ns < FREE_NS or self.next_ns < self._due_ns:  # the latter: a change waits
            return
        if now_ns >= earliest_ns:
            self.follows, self._patience_ns = True, patience_ns
        elif self._is_together:
            return  # one more of the first member's, with a change
        elif now_ns - self._regular_ns <= period_ns // 2:
            self._put(min(now_ns + patience_ns, self._regular_ns + 2 * patience_ns) + period_ns)
        else:
            self._put(earliest_ns)

    def _put(self, due_ns: int) -> None:
        self.next_ns = self._due_ns = due_ns
