"""An engine's driver, and a program that calls it; nothing else has to run.

    python engine.py                 the driver, until Ctrl-C
    python engine.py drive engine    beside it: call it by its alias
    failover names                   who is there
    failover call engine set '{"duty": 0.4}'

The engine here is simulated: it takes 20 commands a second, and its speed follows the duty cycle.
"""

from __future__ import annotations

import sys
from typing import Annotated

from msgspec import Meta

import failover


@failover.driver("University/Lab/Robotino/Engines/3/PWM", alias="engine", rate_hz=20)
class Engine:
    """One motor behind a pulse width modulator."""

    duty = 0.0
    moves = 0

    @failover.command(coalesce="latest")
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> None:
        """Drive at a duty cycle, from -1 (backwards) to 1."""
        self.duty = duty  # here a line would go to the device
        self.moves += 1

    @failover.query
    def read(self) -> dict[str, float]:
        """What it does now."""
        return {"duty": self.duty, "rpm": round(self.duty * 3_000, 1), "moves": self.moves}

    @failover.stream(rate_hz=10)
    def current(self) -> float:
        """The current in amperes."""
        return round(abs(self.duty) * 2.5, 3)


def drive(name: str) -> None:
    """Speed up in ten steps, and tell what the engine says."""
    with failover.proxy(name) as engine:
        for step in range(1, 11):
            engine.call("set", duty=step / 10)
        print(engine.call("read"), flush=True)
        for _, amperes in zip(range(3), engine.stream("current"), strict=False):
            print(f"{amperes} A", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["drive"]:
        drive(*sys.argv[2:])
    else:
        failover.run(Engine)
