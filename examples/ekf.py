"""Where am I? A robot drives in a circle, sees landmarks, and keeps its estimate: an extended Kalman filter with its map.

    python ekf.py [STEPS]       for ever, or so many steps; kill it at any time, and start it again

Pose, map and covariance survive; what the sensors say comes from dice that are thrown anew for each step.
"""

from __future__ import annotations

import sys
from math import atan2, cos, hypot, pi, remainder, sin

import numpy as np
from numpy.typing import NDArray

import failover

LAST = int(sys.argv[1]) if len(sys.argv) > 1 else None
COUNT = 50
"""Landmarks. The covariance of so many is kept as what was changed in it."""
LANDMARKS = np.random.default_rng(7).uniform(-12, 12, (COUNT, 2))
PERIOD_S, SPEED, TURN = 0.01, 4.0, 0.5
"""Seconds a step; metres and radians a second: a circle of 8 m."""
SIGHT = 5.0
ODOMETRY = np.diag([0.02, 0.002]) ** 2
"""Variances of metres and radians driven in a step."""
SENSOR = np.diag([0.1, 0.02]) ** 2
"""Variances of a range and a bearing."""

Vector = NDArray[np.float64]


@failover.component(name="ekf", every=PERIOD_S)
class Ekf:
    """Mean and covariance of the pose (x, y, heading) and of every landmark's place."""

    number: int = failover.kept(default=0)
    pose: Vector = failover.kept(factory=lambda: np.array([8.0, 0.0, pi / 2]))
    places: Vector = failover.kept(shape=(COUNT, 2), dtype=np.float64)
    covariance: Vector = failover.kept(factory=lambda: np.diag([0.0] * 3 + [1e6] * (2 * COUNT)))

    def on_resume(self, resumed: failover.Resumed) -> None:
        print(f"goes on after step {self.number}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)

    def step(self) -> object:
        if self.number == LAST:
            return failover.FINISHED
        self.number += 1
        angle = TURN * PERIOD_S * self.number
        true = (8 * cos(angle), 8 * sin(angle), angle + pi / 2)
        dice = np.random.default_rng(self.number)
        self.predict(*(np.array([SPEED, TURN]) * PERIOD_S + dice.normal(0, np.sqrt(np.diag(ODOMETRY)))))
        for mark, (x, y) in enumerate(LANDMARKS - true[:2]):
            if hypot(x, y) < SIGHT:
                noise = dice.normal(0, np.sqrt(np.diag(SENSOR)))
                self.correct(mark, hypot(x, y) + noise[0], atan2(y, x) - true[2] + noise[1])
        known = np.count_nonzero(np.diag(self.covariance)[3:] < 1) // 2
        x, y, heading = self.pose
        off = hypot(x - true[0], y - true[1])
        print(f"{self.number} at {x:+.3f} {y:+.3f} {heading:.3f}, {off:.3f} m off, {known} landmarks", flush=True)
        return None

    def predict(self, way: float, turn: float) -> None:
        """Move by what the wheels say."""
        heading = self.pose[2] + turn / 2
        self.pose += (way * cos(heading), way * sin(heading), turn)
        move = np.eye(3)
        move[:2, 2] = -way * sin(heading), way * cos(heading)
        drive = np.array([[cos(heading), 0], [sin(heading), 0], [0, 1]])
        self.covariance[:3] = move @ self.covariance[:3]
        self.covariance[:, :3] = self.covariance[:, :3] @ move.T
        self.covariance[:3, :3] += drive @ ODOMETRY @ drive.T

    def correct(self, mark: int, far: float, bearing: float) -> None:
        """Take in that a landmark was seen so far away, and where."""
        if not self.places[mark].any():  # seen for the first time
            direction = self.pose[2] + bearing
            self.places[mark] = self.pose[:2] + far * np.array([cos(direction), sin(direction)])
        x, y = self.places[mark] - self.pose[:2]
        r = hypot(x, y)
        slope = np.array([[-x / r, -y / r, 0, x / r, y / r], [y / r**2, -x / r**2, -1, -y / r**2, x / r**2]])
        here = [0, 1, 2, 3 + 2 * mark, 4 + 2 * mark]
        spread = self.covariance[:, here] @ slope.T
        gain = spread @ np.linalg.inv(slope @ spread[here] + SENSOR)
        change = gain @ np.array([far - r, remainder(bearing - atan2(y, x) + self.pose[2], 2 * pi)])
        self.pose += change[:3]
        self.places += change[3:].reshape(COUNT, 2)
        self.covariance -= gain @ spread.T


failover.run(Ekf)
