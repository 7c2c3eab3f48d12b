"""An engine's driver that counts its moves; version 1."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

import failover


@failover.driver("University/Lab/Robotino/Engines/3/PWM", alias="engine", rate_hz=20)
class Engine:
    """One motor behind a pulse width modulator."""

    duty: float = failover.kept(default=0.0)
    moves: int = failover.kept(default=0)

    @failover.command
    def set(self, duty: Annotated[float, Meta(ge=-1, le=1)]) -> None:
        """Drive at a duty cycle, from -1 (backwards) to 1."""
        self.duty = duty  # here a line would go to the device
        self.moves += 1

    @failover.query
    def read(self) -> dict[str, float]:
        """What it does now."""
        return {"duty": self.duty, "moves": self.moves}
