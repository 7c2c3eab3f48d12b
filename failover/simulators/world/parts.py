"""What a world consists of: labs with walls and obstacles, robots with their devices. Lengths in metres, angles in degrees."""

from __future__ import annotations

import math
from typing import Final, Literal

from msgspec import Struct

from failover.core.naming.worlds import SIMULATED

TICK_S: Final = 0.05
"""From one activation of the controllers to the next; the world moves on by as much."""
SENSE_EVERY: Final = 2
"""Ticks from one measurement to the next."""

GUESTS_MAX: Final = 256
"""Robots of one world: each has a file of its own, and some fourteen names."""
LABS_MAX: Final = 64
ENGINES_MAX: Final = 4
US_MAX: Final = 16
"""Ultrasonic sensors of one robot, all around it."""

RADIUS_M: Final = 0.225
"""Of a robot. Source: Robotino, Festo Didactic: a diameter of 450 mm."""

SPACING_M: Final = 1.5
"""From robot to robot where a world is made without a file."""

Kind = Literal["omni", "differential"]
Controller = Literal["wander", "none"]
Device = Literal["us", "engine", "battery", "camera"]


class Robot(Struct, frozen=True):
    """One robot.

    Attributes:
        lab: name of its lab.
        at: of its centre; heading: to which it looks, against the clock from the x axis.
        engines: of an omnidirectional one 3 or 4, of a differential one 2 or 4: left, right, left, right.
        us: ultrasonic sensors at equal angles, the first one ahead.
        battery: its level when the world begins, from 0 to 1; None: it tells none, and is never empty.
        aliases: free text → device below the robot.
        us_name, engine_name: of the devices; ``{}`` is the number, from 1.
    """

    name: str
    lab: str
    at: tuple[float, float]
    heading: float = 0.0
    kind: Kind = "omni"
    engines: int = 4
    us: int = 8
    battery: float | None = 1.0
    camera: bool = True
    radius: float = RADIUS_M
    controller: Controller = "wander"
    aliases: dict[str, str] = {}
    us_name: str = "US/{}"
    engine_name: str = "Engines/{}/PWM"
    battery_name: str = "Battery"
    camera_name: str = "Camera"

    def devices(self) -> list[tuple[Device, str, int]]:
        """Kind, name below the robot, and number from 0 of each."""
        found: list[tuple[Device, str, int]] = [("us", self.us_name.format(n + 1), n) for n in range(self.us)]
        found += [("engine", self.engine_name.format(n + 1), n) for n in range(self.engines)]
        found += [("battery", self.battery_name, 0)] if self.battery is not None else []
        return found + ([("camera", self.camera_name, 0)] if self.camera else [])


class Lab(Struct, frozen=True):
    """A room from (0, 0) to its size, with walls around it.

    Attributes:
        walls: lines x1, y1, x2, y2 inside of it. obstacles: columns x, y, radius.
    """

    name: str
    size: tuple[float, float]
    walls: tuple[tuple[float, float, float, float], ...] = ()
    obstacles: tuple[tuple[float, float, float], ...] = ()


class World(Struct, frozen=True):
    """All of it.

    Attributes:
        path: what stands before the labs' names: ``University``.
        name: of this world, where there are several at once.
        seed: of the sensors' noise.
    """

    labs: tuple[Lab, ...]
    robots: tuple[Robot, ...]
    path: str = "University"
    name: str = ""
    seed: int = 1

    @property
    def prefix(self) -> str:
        """What FAILOVER_WORLD names."""
        return f"{SIMULATED}/{self.name}" if self.name else SIMULATED

    def place_of(self, robot: Robot) -> str:
        """The path of a robot: ``Simulated/University/Lab/Robotino``."""
        return "/".join(step for step in (self.prefix, self.path, robot.lab, robot.name) if step)

    def part(self, labs: tuple[str, ...]) -> World:
        """The same world with some of its labs."""
        return World(
            tuple(lab for lab in self.labs if lab.name in labs),
            tuple(robot for robot in self.robots if robot.lab in labs),
            self.path,
            self.name,
            self.seed,
        )


def usual(robots: int, labs: int, seed: int) -> World:
    """A world without a file: robots like Robotino in square labs, some columns between them.

    A single lab is called Lab, a single robot Robotino, and its third engine "engine"; of several each has its number.
    """
    of = [robots // labs + (number < robots % labs) for number in range(labs)]
    rooms: list[Lab] = []
    all_robots: list[Robot] = []
    for number, count in enumerate(of, 1):
        lab = "Lab" if labs == 1 else f"Lab{number}"
        columns = max(math.ceil(math.sqrt(count)), 3)
        side = (columns + 1) * SPACING_M
        between = [((n + 1.5) * SPACING_M, (n + 1.5) * SPACING_M, 0.15) for n in range(columns - 1)]
        rooms.append(Lab(lab, (side, side), (), tuple(between)))
        for n in range(count):
            name = "Robotino" if robots == 1 else f"Robotino{len(all_robots) + 1}"
            at = ((n % columns + 1) * SPACING_M, (n // columns + 1) * SPACING_M)
            aliases = {"engine": "Engines/3/PWM"} if robots == 1 else {}
            all_robots.append(Robot(name, lab, at, heading=n * 137.5 % 360, aliases=aliases))
    return World(tuple(rooms), tuple(all_robots), seed=seed)


def groups(world: World, robots_most: int) -> list[tuple[str, ...]]:
    """Labs that go into one process each: a lab is never parted, because its robots see one another."""
    found: list[tuple[str, ...]] = []
    room = 0
    for lab in world.labs:
        count = sum(robot.lab == lab.name for robot in world.robots)
        if not found or count > room:
            found.append(())
            room = robots_most
        found[-1] = (*found[-1], lab.name)
        room -= count
    return found
