"""The devices of simulated robots as drivers, with the verbs that programs know of real ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final

from msgspec import Meta

from failover.core.naming.worlds import SIMULATED
from failover.drivers.declare import command, declaration_of, driver, query, stream
from failover.drivers.many import Device, device
from failover.simulators.world.life import Life
from failover.simulators.world.motion import WHEEL_RADIUS_M
from failover.simulators.world.parts import SENSE_EVERY, TICK_S, World
from failover.simulators.world.parts import Device as Kind

AMPERES: Final = 2.5
"""Of an engine at full duty."""
SENSE_HZ: Final = 1 / (SENSE_EVERY * TICK_S)


class _Of:
    """Of one robot of one lab; ``number``: of the device, from 0."""

    def __init__(self, life: Life, robot: int, number: int = 0) -> None:
        self._life, self._robot, self._number = life, robot, number


@driver(f"{SIMULATED}/Engine", rate_hz=1 / TICK_S)
class Engine(_Of):
    """A motor behind a pulse width modulator."""

    @command(coalesce="latest")
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> None:
        """Drive at a duty cycle, from -1 (backwards) to 1."""
        self._life.command(self._robot, self._number, duty)

    @query
    def read(self) -> dict[str, float]:
        """What it does now."""
        rpm = self._life.motion.rim[self._robot, self._number] / WHEEL_RADIUS_M * 60 / (2 * math.pi)
        moves = self._life.moves[self._robot][self._number]
        return {"duty": self._duty, "rpm": round(float(rpm), 1), "moves": moves}

    @stream(rate_hz=SENSE_HZ)
    def current(self) -> float:
        """The current in amperes."""
        return round(abs(self._duty) * AMPERES, 3)

    @property
    def _duty(self) -> float:
        return float(self._life.motion.duty[self._robot, self._number])


@driver(f"{SIMULATED}/US")
class Ultrasonic(_Of):
    """An ultrasonic sensor."""

    @query
    def read(self) -> dict[str, float]:
        """The distance of what is nearest, in metres."""
        return {"metres": self.metres()}

    @stream(rate_hz=SENSE_HZ)
    def metres(self) -> float:
        """The same, each time that it was measured."""
        return round(float(self._life.ranges[self._robot, self._number]), 3)


@driver(f"{SIMULATED}/Battery")
class Battery(_Of):
    """Two accumulators in a row."""

    @query
    def read(self) -> dict[str, float]:
        """Its voltage, and its level from 0 to 1."""
        motion = self._life.motion
        return {"volts": round(float(motion.volts[self._robot]), 2), "level": round(float(motion.level[self._robot]), 4)}

    @stream(rate_hz=1.0)
    def level(self) -> float:
        """From 0 to 1."""
        return round(float(self._life.motion.level[self._robot]), 4)


@driver(f"{SIMULATED}/Camera")
class Camera(_Of):
    """The stub of a camera: it counts pictures, and has none."""

    @query
    def read(self) -> dict[str, int]:
        """Number and size of the newest picture."""
        return {"frame": self._life.tick // SENSE_EVERY, "width": 320, "height": 240}

    @stream(rate_hz=SENSE_HZ)
    def frame(self) -> int:
        """Its number."""
        return self._life.tick // SENSE_EVERY


_CLASSES: Final[Mapping[Kind, type]] = {"us": Ultrasonic, "engine": Engine, "battery": Battery, "camera": Camera}
_DECLARED: Final = {kind: declaration_of(cls) for kind, cls in _CLASSES.items()}


def devices(world: World, life: Life) -> Iterator[Device]:
    """Those of a lab's robots."""
    for robot, one in enumerate(life.robots):
        place = world.place_of(one)
        for kind, name, number in one.devices():
            aliases = [alias for alias, target in one.aliases.items() if target == name]
            fields = {"life": life, "robot": robot, "number": number}
            yield device(_CLASSES[kind], _DECLARED[kind], f"{place}/{name}", aliases, **fields)


def process(path: str, figures: Any) -> type:
    """The driver that stands for a process of simulated robots; ``figures``: returns what it tells of itself."""

    class Simulator:
        @query
        def figures(self) -> dict[str, Any]:
            """Activations, misses and lateness of its robots' controllers until now."""
            return dict(figures())

    return driver(path)(Simulator)
