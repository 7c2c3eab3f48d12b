"""Where am I? A robot drives in a circle, sees landmarks, and keeps its estimate: an extended Kalman filter with its map.

    python ekf.py [STEPS]       for ever, or so many steps; kill it at any time, and start it again

Pose, map and covariance survive; and so do the dice that stand for the noise of the sensors, so that every run is the same.
"""

from __future__ import annotations

import sys
from math import atan2, cos, hypot, pi, remainder, sin

import numpy as np
from numpy.typing import NDArray

import failover

LAST = int(sys.argv[1]) if len(sys.argv) > 1 else None
COUNT = 50  # landmarks; the covariance of so many is kept as what was changed in it
LANDMARKS = np.random.default_rng(7).uniform(-12, 12, (COUNT, 2))
PERIOD_S, SPEED, TURN, SIGHT = 0.01, 4.0, 0.5, 5.0  # s, m/s and rad/s (a circle of 8 m), m
ODOMETRY = np.array([0.02, 0.002])  # noise of metres and radians driven in a step
SENSOR = np.array([0.1, 0.02])  # noise of a range and a bearing
Vector = NDArray[np.float64]


@failover.component(name="ekf", every=PERIOD_S)
class Ekf:
    """Mean and covariance of the pose (x, y, heading) and of every landmark's place."""

    number: int = failover.kept(default=0)
    pose: Vector = failover.kept(factory=lambda: np.array([8.0, 0.0, pi / 2]))
    places: Vector = failover.kept(shape=(COUNT, 2), dtype=np.float64)
    covariance: Vector = failover.kept(factory=lambda: np.diag([0.0] * 3 + [1e6] * (2 * COUNT)))
    dice: np.random.Generator = failover.kept(factory=lambda: np.random.default_rng(1))

    def on_resume(self, resumed: failover.Resumed) -> None:
        print(f"goes on after step {self.number}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)

    def step(self) -> object:
        if self.number == LAST:
            return failover.FINISHED
        self.number += 1
        angle = TURN * PERIOD_S * self.number
        true = (8 * cos(angle), 8 * sin(angle), angle + pi / 2)
        self.predict(*self.dice.normal((SPEED * PERIOD_S, TURN * PERIOD_S), ODOMETRY))
        for mark, (x, y) in enumerate(LANDMARKS - true[:2]):
            if hypot(x, y) < SIGHT:
                self.correct(mark, *self.dice.normal((hypot(x, y), atan2(y, x) - true[2]), SENSOR))
        x, y, heading = self.pose
        print(f"{self.number} at {x:+.3f} {y:+.3f} {heading:.3f}, {hypot(x - true[0], y - true[1]):.3f} m off", flush=True)
        return None

    def predict(self, way: float, turn: float) -> None:
        """Move by what the wheels say."""
        heading = self.pose[2] + turn / 2
        self.pose += (way * cos(heading), way * sin(heading), turn)
        move = np.array([[1, 0, -way * sin(heading)], [0, 1, way * cos(heading)], [0, 0, 1]])
        drive = np.array([[cos(heading), 0], [sin(heading), 0], [0, 1]])
        self.covariance[:3] = move @ self.covariance[:3]
        self.covariance[:, :3] = self.covariance[:, :3] @ move.T
        self.covariance[:3, :3] += drive @ np.diag(ODOMETRY**2) @ drive.T

    def correct(self, mark: int, far: float, bearing: float) -> None:
        """Take in that a landmark was seen so far away, and where."""
        if not self.places[mark].any():  # seen for the first time
            self.places[mark] = self.pose[:2] + far * np.array([cos(self.pose[2] + bearing), sin(self.pose[2] + bearing)])
        x, y = self.places[mark] - self.pose[:2]
        r = hypot(x, y)
        slope = np.array([[-x / r, -y / r, 0, x / r, y / r], [y / r**2, -x / r**2, -1, -y / r**2, x / r**2]])
        here = [0, 1, 2, 3 + 2 * mark, 4 + 2 * mark]
        spread = self.covariance[:, here] @ slope.T
        gain = spread @ np.linalg.inv(slope @ spread[here] + np.diag(SENSOR**2))
        change = gain @ np.array([far - r, remainder(bearing - atan2(y, x) + self.pose[2], 2 * pi)])
        self.pose += change[:3]
        self.places += change[3:].reshape(COUNT, 2)
        self.covariance -= gain @ spread.T


failover.run(Ekf)
