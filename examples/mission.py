"""A mission: visit the wells of a plan, look into each, come home when the battery asks for it.

    python mission.py           until the mission is over; kill it at any time, and start it again

The state is an object as one would write it anyway, with enums, nested dataclasses, and a leg that is one of the plan.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from enum import Enum
from math import dist

import failover

REACH = 0.5  # metres that the robot drives in a step

Phase = Enum("Phase", "DRIVING LOOKING RETURNING CHARGING OVER")


@dataclass
class Leg:
    """One well, where it is in metres, and how deep the water stands in it; None before it was looked into."""

    x: float
    y: float
    depth: float | None = None


@dataclass
class Mission:
    """All that must survive."""

    number: int = 0
    phase: Phase = Phase.DRIVING
    x: float = 0.0
    y: float = 0.0
    battery: float = 1.0
    plan: list[Leg] = field(default_factory=lambda: [Leg(2.0 * n, n * n % 7) for n in range(1, 7)])
    leg: Leg | None = None

    def step(self) -> None:
        """Do what the phase asks for, and choose the next one."""
        self.number += 1
        self.battery -= 0.01
        left = [leg for leg in self.plan if leg.depth is None]
        match self.phase:
            case Phase.DRIVING:
                self.leg = self.leg or left[0]
                if self.battery < 0.4:
                    self.phase = Phase.RETURNING
                elif self.reaches(self.leg.x, self.leg.y):
                    self.phase = Phase.LOOKING
            case Phase.LOOKING if self.leg:
                self.leg.depth = round(1 + self.leg.x * self.leg.y % 3, 2)
                self.leg = None
                self.phase = Phase.DRIVING if len(left) > 1 else Phase.RETURNING
            case Phase.RETURNING if self.reaches(0, 0):
                self.phase = Phase.CHARGING
            case Phase.CHARGING:
                self.battery = min(self.battery + 0.12, 1.0)
                if self.battery == 1.0:
                    self.phase = Phase.DRIVING if left else Phase.OVER

    def reaches(self, x: float, y: float) -> bool:
        """Go one step there; answer whether the robot has arrived."""
        part = min(1.0, REACH / max(dist((self.x, self.y), (x, y)), REACH))
        self.x, self.y = self.x + part * (x - self.x), self.y + part * (y - self.y)
        return part == 1.0


mission = failover.resume("mission", default=Mission())
if resumed := failover.resumed():
    print(f"goes on after step {mission.number}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
for _ in failover.every(0.01):  # each turn that is done is committed
    if mission.phase is Phase.OVER:
        break
    mission.step()
    print(mission.number, mission.phase.name, f"at {mission.x:.2f} {mission.y:.2f}, battery {mission.battery:.0%}", flush=True)
