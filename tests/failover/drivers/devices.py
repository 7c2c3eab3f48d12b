"""Drivers that tests run."""

from __future__ import annotations

import threading
import time
from typing import Annotated, Any

from msgspec import Meta

import failover

ENGINE = "Lab/Robotino/Engines/3/PWM"


@failover.driver(ENGINE, alias="engine")
class Engine:
    def __init__(self) -> None:
        self.duty = 0.0
        self.heard: list[float] = []
        self.gate = threading.Event()
        self.gate.set()

    @failover.command
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> None:
        self.gate.wait()
        self.duty = duty
        self.heard.append(duty)

    @failover.command
    def stall(self) -> None:
        raise RuntimeError("the bridge is hot")

    @failover.query
    def read(self) -> dict[str, float]:
        return {"duty": self.duty}

    @failover.query
    def odd(self) -> Any:
        return object()

    @failover.query
    def huge(self) -> int:
        return 1 << 60

    @failover.query
    def picture(self, size: int = 1_100_000, kind: str = "") -> str:
        if kind == "error":
            raise RuntimeError("x" * size)
        return "x" * size

    @failover.stream(rate_hz=200)
    def film(self) -> str:
        return "x" * 1_100_000

    @failover.stream(rate_hz=200)
    def current(self) -> float:
        return self.duty * 2


@failover.driver("Lab/Robotino/Arm", alias="arm")
class Arm:
    @failover.query
    def read(self) -> str:
        return "folded"


@failover.driver("Lab/robot2/Camera")
class Camera:
    @failover.query
    def read(self) -> int:
        return 7


DEVICE_HZ = 20


@failover.driver("Lab/Robotino/Slow", alias=("slow", "slow one"), rate_hz=DEVICE_HZ)
class Slow:
    """A device that takes 50 ms a command."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.seen: list[tuple[str, Any]] = []
        self.starts: list[float] = []

    @failover.command(coalesce="latest")
    def move(self, x: float | None = None, y: float | None = None) -> None:
        self.starts.append(time.monotonic())
        self.values |= {name: value for name, value in (("x", x), ("y", y)) if value is not None}
        self.seen.append(("move", (x, y)))

    @failover.command
    def step(self, number: int) -> int:
        self.starts.append(time.monotonic())
        self.seen.append(("step", number))
        return number

    @failover.query
    def read(self) -> dict[str, float]:
        return self.values
