"""Odometry and mapper: one program says 100 times a second where the robot is, the other draws a map of it 20 times a second.

    python pipeline.py odometry &
    python pipeline.py mapper       for ever; start them in any order, kill either at any time, and start it again

The schedule times both: the mapper begins when the odometry of the same instant has ended. The pose goes by the board.
Each program keeps its own state. While no odometry runs, the mapper goes on with the last pose.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

import failover

PERIOD_S, SPEED, TURN = 0.01, 1.0, 0.5  # s, m/s and rad/s: a circle of 2 m
CELL, COUNT = 0.5, 20  # metres that a cell of the map is wide; cells in a row


@dataclass
class Pose:
    """Where the robot is, in metres and radians, and the instant for which that holds. The odometry keeps it, too."""

    step: int = 0
    due_ns: int = 0
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0


@dataclass
class Map:
    """How often the robot was seen in each cell; it begins in the middle."""

    number: int = 0
    cells: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((COUNT, COUNT), np.uint32))


def odometry() -> None:
    pose = failover.resume("odometry", default=Pose())
    if resumed := failover.resumed():
        print(f"goes on after step {pose.step}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
    board = failover.board()
    out = board.add(failover.Item("pose", Pose))
    with failover.scheduled("odometry", period=PERIOD_S, overrun="catch_up") as task:  # a step that is late counts, too
        for tick in task:
            pose.step, pose.due_ns = pose.step + 1, tick.due_ns
            pose.heading += TURN * PERIOD_S  # a real one reads its wheels here
            pose.x += SPEED * PERIOD_S * cos(pose.heading)
            pose.y += SPEED * PERIOD_S * sin(pose.heading)
            out.put(pose)
            failover.commit()


def mapper() -> None:
    seen = failover.resume("mapper", default=Map())
    if resumed := failover.resumed():
        print(f"goes on after map {seen.number}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
    board = failover.board()
    poses = board.add(failover.Item("pose", Pose))
    poses.wait(after=0)  # for the first pose, if there is none yet
    with failover.scheduled("mapper", period=0.05, deadline=0.04, after="odometry") as task:
        for tick in task:
            pose: Pose = poses.get().value
            seen.number += 1
            seen.cells[int(pose.y // CELL) + COUNT // 2, int(pose.x // CELL) + COUNT // 2] += 1
            older_ms = max(tick.due_ns - pose.due_ns, 0) / 1e6  # than the map: 0, unless there is no odometry
            print(f"{seen.number} step {pose.step} at {pose.x:+.3f} {pose.y:+.3f}, {older_ms:.0f} ms older", flush=True)
            failover.commit()


{"odometry": odometry, "mapper": mapper}[sys.argv[1]]()
