"""A controller for robots that nothing else drives: ahead, and away from what is near."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from msgspec import Struct

NEAR_M: Final = 0.5
FREE_M: Final = 0.8
"""A robot turns from the one distance on until the other one is free ahead of it."""
SPEED: Final = 0.35
"""Metres a second."""
TURN: Final = 1.2
"""Radians a second."""


class Wander(Struct):
    """One robot's; ``turning``: 1 to the left, -1 to the right, 0 while it goes ahead."""

    turning: int = 0

    def velocity(self, ranges: Sequence[float]) -> tuple[float, float, float]:
        """Ahead, to the left (m/s), turn (rad/s), from the ranges of sensors: the first one ahead, then to the left."""
        if not ranges:
            return 0.0, 0.0, TURN / 4
        beside = max(len(ranges) // 8, 1) if len(ranges) > 2 else 0
        ahead = min(ranges[0], ranges[beside], ranges[-beside])
        if ahead < NEAR_M and not self.turning:
            self.turning = 1 if ranges[beside] >= ranges[-beside] else -1
        elif ahead > FREE_M:
            self.turning = 0
        if self.turning:
            return 0.0, 0.0, TURN * self.turning
        return SPEED * min(ahead / FREE_M, 1.0), 0.0, 0.0
