"""A mission: visit the wells of a plan, look into each, come home when the battery asks for it.

    python mission.py           until the mission is over; kill it at any time, and start it again

The state is an object as one would write it anyway, with enums, nested dataclasses, and a leg that is one of the plan.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from enum import Enum
from math import hypot

import failover

REACH = 0.5
"""Metres that the robot drives in a step."""


class Phase(Enum):
    """What the robot is about."""

    DRIVING = "driving"
    LOOKING = "looking"
    RETURNING = "returning"
    CHARGING = "charging"
    OVER = "over"


@dataclass
class Point:
    """A place, in metres."""

    x: float = 0.0
    y: float = 0.0

    def approach(self, goal: Point) -> bool:
        """Go one step there; answer whether it is reached."""
        way = hypot(goal.x - self.x, goal.y - self.y)
        part = min(1.0, REACH / way) if way else 1.0
        self.x, self.y = self.x + part * (goal.x - self.x), self.y + part * (goal.y - self.y)
        return part == 1.0


@dataclass
class Leg:
    """One well, and how deep the water stands in it; None before it was looked into."""

    well: Point
    depth: float | None = None


@dataclass
class Mission:
    """All that must survive."""

    number: int = 0
    phase: Phase = Phase.DRIVING
    robot: Point = field(default_factory=Point)
    battery: float = 1.0
    plan: list[Leg] = field(default_factory=lambda: [Leg(Point(2.0 * n, n * n % 7)) for n in range(1, 7)])
    leg: Leg | None = None

    def step(self) -> None:
        """Do what the phase asks for, and choose the next one."""
        self.number += 1
        self.battery -= 0.01
        match self.phase:
            case Phase.DRIVING:
                self.leg = self.leg or next(leg for leg in self.plan if leg.depth is None)
                if self.battery < 0.4:
                    self.phase = Phase.RETURNING
                elif self.robot.approach(self.leg.well):
                    self.phase = Phase.LOOKING
            case Phase.LOOKING if self.leg:
                self.leg.depth = round(1 + self.leg.well.x * self.leg.well.y % 3, 2)
                self.leg = None
                self.phase = Phase.DRIVING if any(leg.depth is None for leg in self.plan) else Phase.RETURNING
            case Phase.RETURNING if self.robot.approach(Point()):
                self.phase = Phase.CHARGING
            case Phase.CHARGING:
                self.battery = min(self.battery + 0.12, 1.0)
                if self.battery == 1.0:
                    self.phase = Phase.DRIVING if any(leg.depth is None for leg in self.plan) else Phase.OVER

    def __str__(self) -> str:
        looked = sum(leg.depth is not None for leg in self.plan)
        where = f"({self.robot.x:.2f}, {self.robot.y:.2f})"
        return f"{self.number} {self.phase.value} at {where}, battery {self.battery:.0%}, {looked} of {len(self.plan)} wells"


mission = failover.resume("mission", default=Mission())
if resumed := failover.resumed():
    print(f"goes on after step {mission.number}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
while mission.phase is not Phase.OVER:
    mission.step()
    print(mission, flush=True)
    failover.commit()
    time.sleep(0.01)
