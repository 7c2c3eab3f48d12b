"""How the robots of one lab move: first-order motors, wheels, batteries. Arrays have a row for each robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from failover.simulators.world.parts import ENGINES_MAX, Robot

MOTOR_S: Final = 0.15
"""Time constant of a motor with its wheel."""
RIM_SPEED_MAX: Final = 0.8
"""Metres a second at the rim of a wheel, at full duty."""
WHEEL_RADIUS_M: Final = 0.04
FULL_S: Final = 7_200.0
"""A full battery lasts so long at rest …"""
LOAD: Final = 3.0
"""… and at full duty of all engines a (1 + LOAD)th of it."""
VOLTS_EMPTY: Final = 21.0
VOLTS_SPAN: Final = 4.6
"""Of two lead accumulators in a row."""

Floats = NDArray[np.float64]


def wheels(robot: Robot) -> Floats:
    """``ENGINES_MAX × 3``: speed ahead, to the left and turn (m/s, m/s, rad/s) → m/s at the rim of each wheel."""
    found = np.zeros((ENGINES_MAX, 3))
    for number in range(robot.engines):
        if robot.kind == "omni":  # equally spaced, each turns along the edge; source: Siegwart, Nourbakhsh, 3.2.3
            angle = math.pi * (2 * number + 1) / robot.engines
            found[number] = -math.sin(angle), math.cos(angle), robot.radius
        else:
            found[number] = 1.0, 0.0, robot.radius * (1 if number % 2 else -1)
    return found


class Motion:
    """Where the robots are, and how they move.

    Attributes:
        place: ``n × 2``, metres. heading: ``n``, radians.
        duty: ``n × ENGINES_MAX``, from -1 to 1. rim: the same of wheels' speeds, m/s.
        velocity: ``n × 3``: ahead, to the left, turn.
        level: of the batteries, from 0 to 1.
    """

    def __init__(self, robots: Sequence[Robot]) -> None:
        count = len(robots)
        self.place: Floats = np.array([robot.at for robot in robots], float).reshape(count, 2)
        self.heading: Floats = np.radians([robot.heading for robot in robots])
        self.radius: Floats = np.array([robot.radius for robot in robots], float)
        self.duty: Floats = np.zeros((count, ENGINES_MAX))
        self.rim: Floats = np.zeros((count, ENGINES_MAX))
        self.velocity: Floats = np.zeros((count, 3))
        self.level: Floats = np.array([1.0 if robot.battery is None else robot.battery for robot in robots], float)
        self.wheels: Floats = np.array([wheels(robot) for robot in robots]).reshape(count, ENGINES_MAX, 3)
        self._body = np.linalg.pinv(self.wheels)
        self._drain = np.array([0.0 if robot.battery is None else 1 / FULL_S for robot in robots], float)
        self._engines = np.array([robot.engines for robot in robots], float)

    def moved(self, span_s: float) -> Floats:
        """Let motors, headings and batteries go on; the places where the robots come to, if nothing is in their way."""
        target = self.duty * (RIM_SPEED_MAX * (self.level > 0))[:, None]
        self.rim = target + (self.rim - target) * math.exp(-span_s / MOTOR_S)
        self.velocity = np.einsum("nij,nj->ni", self._body, self.rim)
        middle = self.heading + self.velocity[:, 2] * (span_s / 2)
        ahead, left = self.velocity[:, 0] * span_s, self.velocity[:, 1] * span_s
        self.heading = np.remainder(self.heading + self.velocity[:, 2] * span_s, 2 * math.pi)
        load = 1 + LOAD * np.abs(self.duty).sum(axis=1) / self._engines
        self.level = np.clip(self.level - self._drain * load * span_s, 0.0, 1.0)
        cosine, sine = np.cos(middle), np.sin(middle)
        return self.place + np.stack([ahead * cosine - left * sine, ahead * sine + left * cosine], axis=1)

    def duties(self, robot: int, wanted: tuple[float, float, float]) -> Any:
        """Duties of a robot's engines for a velocity: ahead, to the left, turn; scaled down together where one is too large."""
        found = self.wheels[robot] @ wanted / RIM_SPEED_MAX
        return found / max(1.0, float(np.abs(found).max()))

    @property
    def volts(self) -> Floats:
        """Of the batteries."""
        return VOLTS_EMPTY + VOLTS_SPAN * self.level
