"""A world as a file that a person writes: labs, walls, robots and their devices; and the worlds that come with failover."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from failover.config import strict_toml
from failover.core.naming import names, worlds
from failover.core.wire.names import ROBOT_SIZE_MAX, check_robot, text_size
from failover.errors import FileMistakeError, NameFormatError
from failover.simulators.world.parts import (
    ENGINES_MAX,
    GUESTS_MAX,
    LABS_MAX,
    RADIUS_M,
    US_MAX,
    Controller,
    Kind,
    Lab,
    Robot,
    World,
)

SHIPPED: Final = Path(__file__).parent / "worlds"
SIZE_MAX_M: Final = 1_000.0
THINGS_MAX: Final = 256
"""Walls and obstacles of one lab: each robot looks at all of them."""


@dataclass(frozen=True, slots=True)
class LabConfig:
    """``[labs.NAME]``: a room from (0, 0) to its size; lengths in metres.

    Attributes:
        walls: lines x1, y1, x2, y2. obstacles: columns x, y, radius.
    """

    size: tuple[float, float]
    walls: tuple[tuple[float, float, float, float], ...] = ()
    obstacles: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        if not all(0 < one <= SIZE_MAX_M for one in self.size):
            raise ValueError(f"size is {list(self.size)}: write width and depth in metres, up to {SIZE_MAX_M:g}")
        if len(self.walls) + len(self.obstacles) > THINGS_MAX:
            raise ValueError(f"walls and obstacles are {len(self.walls) + len(self.obstacles)}; {THINGS_MAX} are possible")
        if not all(math.isfinite(one) for wall in self.walls for one in wall):
            raise ValueError("walls must have finite ends")
        if any(wall[:2] == wall[2:] for wall in self.walls):
            raise ValueError("walls must have a length: two ends of one are equal")
        if not all(math.isfinite(x) and math.isfinite(y) and 0 < radius <= SIZE_MAX_M for x, y, radius in self.obstacles):
            raise ValueError("obstacles need finite numbers x, y, and a radius above 0")


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """``[robots.NAME]``.

    Attributes:
        at: metres from the corner of the lab. heading: degrees from the x axis.
        battery: its level at the beginning, from 0 to 1; false: it has none.
        names: of the devices: us, engines (``{}`` is the number, from 1), battery, camera.
        aliases: free text → name of a device.
    """

    lab: str
    at: tuple[float, float]
    heading: float = 0.0
    kind: Kind = "omni"
    engines: int = 4
    us: int = 8
    battery: float | bool = 1.0
    camera: bool = True
    radius: float = RADIUS_M
    controller: Controller = "wander"
    names: dict[str, str] = field(default_factory=dict)
    aliases: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        allowed = (3, ENGINES_MAX) if self.kind == "omni" else (2, ENGINES_MAX)
        if self.engines not in allowed:
            raise ValueError(f"engines is {self.engines}: {self.kind} robots have {allowed[0]} or {allowed[1]}")
        if not 0 <= self.us <= US_MAX:
            raise ValueError(f"us is {self.us}: 0 to {US_MAX} ultrasonic sensors are possible")
        if not 0 <= self.battery <= 1:
            raise ValueError(f"battery is {self.battery}: write its level from 0 to 1, or false")
        if not 0 < self.radius <= 10:
            raise ValueError(f"radius is {self.radius}: write metres, above 0 and up to 10")
        if not math.isfinite(self.heading) or not all(math.isfinite(one) for one in self.at):
            raise ValueError("at and heading must be finite numbers")
        for key, name in self.names.items():
            if key not in ("us", "engines", "battery", "camera"):
                raise ValueError(f"names.{key} is none of us, engines, battery, camera")
            if name.count("{}") != (key in ("us", "engines")) or set("{}") & set(name.replace("{}", "")):
                raise ValueError(f"names.{key} is {name!r}: us and engines have one {{}} for the number, others have none")

    def robot(self, name: str) -> Robot:
        """As the world has it."""
        said = {f"{'engine' if key == 'engines' else key}_name": value for key, value in self.names.items()}
        battery = None if self.battery is False else float(self.battery)
        plain = (self.lab, self.at, self.heading, self.kind, self.engines, self.us, battery)
        robot = Robot(name, *plain, self.camera, self.radius, self.controller, self.aliases)
        return msgspec.structs.replace(robot, **said)


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """The whole file.

    Attributes:
        path: what stands before the labs in paths; "" for nothing.
        name: of this world, if several run at once: its paths begin with ``Simulated/NAME``.
        seed: of the sensors' noise.
    """

    labs: dict[str, LabConfig]
    robots: dict[str, RobotConfig]
    path: str = "University"
    name: str = ""
    seed: int = 1

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        if not self.labs or not self.robots:
            raise ValueError(f"{'robots' if self.labs else 'labs'}: a world has one at least")
        if len(self.robots) > GUESTS_MAX or len(self.labs) > LABS_MAX:
            raise ValueError(f"robots: {GUESTS_MAX} of them in {LABS_MAX} labs are possible")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}: write a number from 0 on")

    def world(self) -> World:
        """As it is simulated."""
        labs = tuple(Lab(name, lab.size, lab.walls, lab.obstacles) for name, lab in self.labs.items())
        return World(labs, tuple(one.robot(name) for name, one in self.robots.items()), self.path, self.name, self.seed)


def read(named: str, seed: int | None = None) -> World:
    """A world: of a file, or of one that comes with failover, by its name.

    Args:
        seed: instead of the file's.

    Raises:
        FileMistakeError: it is missing or mistaken; names file, line and key.
    """
    shipped = SHIPPED / f"{named}.toml"
    path = shipped if "/" not in named and shipped.is_file() and not Path(named).exists() else Path(named)
    if not path.exists() and "/" not in named:
        known = ", ".join(sorted(one.stem for one in SHIPPED.glob("*.toml")))
        raise FileMistakeError(f"{path}: there is no such file; worlds that come with failover: {known}")
    config = strict_toml.read(path, WorldConfig)
    _check_names(path, config)
    _check_places(path, config)
    found = config.world()
    return found if seed is None else World(found.labs, found.robots, found.path, found.name, seed)


def _check_names(path: Path, config: WorldConfig) -> None:
    world = config.world()
    try:
        worlds.checked(world.prefix)
    except NameFormatError as error:
        _refuse(path, ("name",), str(error))
    for lab in config.labs:
        try:
            check_robot(lab)
        except NameFormatError as error:
            _refuse(path, ("labs", lab), str(error).replace("a robot", "a lab"))
    for robot in world.robots:
        keys = ("robots", robot.name)
        if robot.lab not in config.labs:
            _refuse(path, (*keys, "lab"), f"there is no [labs.{robot.lab}]; this world has {', '.join(config.labs)}")
        devices = [name for _, name, _ in robot.devices()]
        try:
            check_robot(robot.name)
            for device in devices:
                names.path(f"{world.place_of(robot)}/{device}")
            for alias in robot.aliases:
                names.alias(alias)
        except NameFormatError as error:
            _refuse(path, keys, str(error))
        guest = worlds.guest(world.prefix, robot.name)
        if text_size(guest) > ROBOT_SIZE_MAX:
            _refuse(path, keys, f"on the board it is called {guest}, which is longer than {ROBOT_SIZE_MAX} bytes")
        if len(set(devices)) != len(devices):
            _refuse(path, (*keys, "names"), "two of its devices have the same name")
        for target in robot.aliases.values():
            if target not in devices:
                _refuse(path, (*keys, "aliases"), f"{target!r} is none of its devices: {', '.join(devices)}")


def _check_places(path: Path, config: WorldConfig) -> None:
    for name, robot in config.robots.items():
        room, edge = config.labs[robot.lab].size, robot.radius
        if not all(edge <= at <= size - edge for at, size in zip(robot.at, room, strict=True)):
            said = f"{list(robot.at)} is not inside of {robot.lab}, which has {room[0]:g} by {room[1]:g} m"
            _refuse(path, ("robots", name, "at"), said)


def _refuse(path: Path, keys: tuple[str, ...], why: str) -> NoReturn:
    raise FileMistakeError(f"{strict_toml.place_of(path, keys)}: {why}")
