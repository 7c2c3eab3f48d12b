"""An engine's driver that counts its moves; version 2 keeps the duty in percent, and reads the state of version 1."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta

import failover


def in_percent(state: dict[str, Any]) -> dict[str, Any]:
    """A state of version 1 as one of version 2."""
    return {"percent": state["duty"] * 100, "moves": state["moves"]}


@failover.driver("University/Lab/Robotino/Engines/3/PWM", alias="engine", rate_hz=20, version=2, migrations={1: in_percent})
class Engine:
    """One motor behind a pulse width modulator."""

    percent: float = failover.kept(default=0.0)
    moves: int = failover.kept(default=0)

    @failover.command
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> None:
        """Drive at a duty cycle, from -1 (backwards) to 1."""
        self.percent = duty * 100  # here a line would go to the device
        self.moves += 1

    @failover.query
    def read(self) -> dict[str, float]:
        """What it does now."""
        return {"duty": self.percent / 100, "percent": self.percent, "moves": self.moves}
