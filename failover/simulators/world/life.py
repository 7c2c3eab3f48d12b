"""One lab as it lives: ticks, measurements, controllers, and the bytes of its robots' items.

The same world and seed give the same bytes at each tick, however fast it goes, while no program gives its robots orders.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import xxhash

from failover.core.board.items import Item
from failover.simulators.world.motion import WHEEL_RADIUS_M, Motion
from failover.simulators.world.parts import SENSE_EVERY, TICK_S, Lab, Robot, World
from failover.simulators.world.room import RANGE_MAX_M, Room
from failover.simulators.world.wander import Wander

NOISE_M: Final = 0.004
"""Standard deviation of an ultrasonic sensor."""
AWAY_TICKS: Final = 40
"""A robot whose engine a program commands has no other controller for two seconds."""
CONTROL_BOUND_MS: Final = 250.0
SENSOR_BOUND_MS: Final = 500.0
"""Past these ages an item is stale: five of its periods."""


def items_of(robot: Robot) -> tuple[Item, ...]:
    """The items of a robot on the board, in the order of `Life.values`."""
    battery = (Item("battery", {"volts": "f4", "level": "f4"}, bound_ms=SENSOR_BOUND_MS),) if robot.battery is not None else ()
    us = (Item("us", {"metres": f"f4[{robot.us}]"}, bound_ms=SENSOR_BOUND_MS),) if robot.us else ()
    pose = dict.fromkeys(("x", "y", "heading", "ahead", "left", "turn"), "f8")
    engines = dict.fromkeys(("duty", "speed"), f"f4[{robot.engines}]")
    return (
        Item("pose", pose, bound_ms=CONTROL_BOUND_MS),
        Item("engines", engines, bound_ms=CONTROL_BOUND_MS),
        *us,
        *battery,
    )


class Life:
    """The robots of one lab.

    Attributes:
        tick: of the newest `turn`; 0: the world has not begun.
        ranges: ``n × sensors``, as they were measured last.
        frames: of each camera.
    """

    def __init__(self, world: World, lab: Lab) -> None:
        self.robots = tuple(robot for robot in world.robots if robot.lab == lab.name)
        self.motion = Motion(self.robots)
        self.tick = 0
        self._room = Room(lab)
        self._dice = np.random.default_rng((world.seed, xxhash.xxh3_64_intdigest(lab.name.encode())))
        most = max((robot.us for robot in self.robots), default=0)
        self._angles = np.array([[2 * math.pi * n / (robot.us or 1) for n in range(most)] for robot in self.robots])
        self._wander = [Wander() for _ in self.robots]
        self._driven = [-AWAY_TICKS] * len(self.robots)
        self._digest = xxhash.xxh3_64()
        self.moves = [[0] * robot.engines for robot in self.robots]
        self.sense()

    @property
    def is_sensing(self) -> bool:
        """Whether this is a tick at which sensors measure."""
        return self.tick % SENSE_EVERY == 0

    @property
    def digest(self) -> str:
        """Of all values of all robots since the beginning."""
        return self._digest.hexdigest()

    def turn(self) -> None:
        """The next tick: the robots move, and the sensors measure if it is their turn."""
        self.tick += 1
        before = self.motion.place
        self.motion.place = self._room.stopped(before, self.motion.moved(TICK_S), self.motion.radius)
        if self.is_sensing:
            self.sense()

    def sense(self) -> None:
        """Measure all ranges."""
        motion = self.motion
        if self._angles.size:
            exact = self._room.ranges(motion.place, motion.radius, motion.heading[:, None] + self._angles)
            noisy = np.clip(exact + self._dice.normal(0.0, NOISE_M, exact.shape), 0.0, RANGE_MAX_M)
            self.ranges = np.where(exact < RANGE_MAX_M, noisy, RANGE_MAX_M)
        else:
            self.ranges = np.zeros((len(self.robots), 0))

    def control(self, robot: int) -> None:
        """One activation of a robot's controller: from its ranges to its duties."""
        one = self.robots[robot]
        if one.controller == "none" or self.tick - self._driven[robot] < AWAY_TICKS:
            return
        wanted = self._wander[robot].velocity(self.ranges[robot, : one.us].tolist())
        self.motion.duty[robot] = self.motion.duties(robot, wanted)

    def command(self, robot: int, engine: int, duty: float) -> None:
        """A program sets an engine's duty; the robot's controller stands aside for a while."""
        self._driven[robot] = self.tick
        self.motion.duty[robot, engine] = duty
        self.moves[robot][engine] += 1

    def values(self) -> Iterator[tuple[int, list[tuple[int, bytes]]]]:
        """Of each robot what is to be put at this tick: (number of the item, its bytes)."""
        motion = self.motion
        pose = np.concatenate([motion.place, motion.heading[:, None], motion.velocity], axis=1)
        speeds = (motion.rim / WHEEL_RADIUS_M).astype("f4")
        duties, ranges = motion.duty.astype("f4"), self.ranges.astype("f4")
        battery = np.stack([motion.volts, motion.level], axis=1).astype("f4")
        for robot, one in enumerate(self.robots):
            engines = duties[robot, : one.engines].tobytes() + speeds[robot, : one.engines].tobytes()
            found = [pose[robot].tobytes(), engines]
            if self.is_sensing:
                found += [ranges[robot, : one.us].tobytes()] if one.us else []
                found += [battery[robot].tobytes()] if one.battery is not None else []
            for value in found:
                self._digest.update(value)
            yield robot, list(enumerate(found))
