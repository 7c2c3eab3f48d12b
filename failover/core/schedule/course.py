"""The instants of a task: which activation is due when, and which one covers an instant. Pure integers.

An activation's instant is computed from an anchor, never from the one before: lateness of one moves no later one.
"""

from __future__ import annotations

import enum

from msgspec import Struct


class Overrun(enum.IntEnum):
    """What becomes of activations that fall due while an earlier one is under way.

    SKIP: they are counted, and not run. QUEUE: the newest of them runs at once, the others are counted. CATCH_UP: each runs, one
    after the other, as fast as they end.
    """

    SKIP = 0
    QUEUE = 1
    CATCH_UP = 2


class Course(Struct, frozen=True):
    """Activation ``number`` is due at ``anchor_ns``, the following ones a period apart.

    Attributes:
        period_ns: 0: there are no following ones, until the course is another one.
    """

    number: int
    anchor_ns: int
    period_ns: int

    def due_ns(self, number: int) -> int:
        """When an activation is due."""
        return self.anchor_ns + (number - self.number) * self.period_ns

    def covering(self, instant_ns: int) -> int:
        """The newest activation that is due at an instant or before; one less than the anchor's before that."""
        if instant_ns < self.anchor_ns:
            return self.number - 1
        return self.number + ((instant_ns - self.anchor_ns) // self.period_ns if self.period_ns else 0)

    def first_from(self, instant_ns: int) -> int:
        """The first activation that is due at an instant or after; never one before the anchor's."""
        if instant_ns <= self.anchor_ns or not self.period_ns:
            return self.number
        return self.number - (self.anchor_ns - instant_ns) // self.period_ns

    def following(self, number: int, now_ns: int, overrun: Overrun = Overrun.SKIP) -> int:
        """The activation that comes after one that ends now."""
        late = self.first_from(now_ns) - number - 1 if self.period_ns else 0
        if late <= 0 or overrun is Overrun.CATCH_UP:
            return number + 1
        return number + late + (overrun is Overrun.SKIP)
