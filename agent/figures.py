"""What this robot knows of one component beside the core's own view: counts, times and reasons, for ``failover status``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from agent.component import Captured
from checkpoint.engine import PTRACE
from checkpoint.model import Position

REASONS_TOLD: Final = 3
"""Of the reasons why it cannot be captured, in one sentence of the core; ``status --json`` has them all."""


@dataclass(slots=True)
class Figures:
    """What ``failover status`` shows of one component on this robot; None where it is not known."""

    snapshots: int = 0
    restores: int = 0
    crashes: int = 0
    freeze_us: int | None = None
    freeze_us_max: int | None = None
    snapshot_size: int | None = None
    dirty_bytes: int | None = None
    newest: Position | None = None
    exit_status: int | None = None
    outage_ms: float | None = None
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    engine: str = PTRACE

    def captured(self, captured: Captured) -> None:
        """Count one snapshot that was taken here."""
        self.snapshots += 1
        self.freeze_us = captured.freeze_us
        self.freeze_us_max = max(self.freeze_us_max or 0, captured.freeze_us)
        self.snapshot_size, self.dirty_bytes = captured.size, captured.dirty_bytes
        self.newest = captured.position
        self.notes = captured.notes

    def stored(self, position: Position, size: int, engine: str) -> None:
        """Count one snapshot that came from the primary."""
        self.snapshots += 1
        self.newest, self.snapshot_size, self.engine = position, size, engine


def shortened(reasons: tuple[str, ...]) -> str:
    """The first reasons as one sentence, and how many there are besides."""
    more = len(reasons) - REASONS_TOLD
    return "; ".join(reasons[:REASONS_TOLD]) + (f"; and {more} more" if more > 0 else "")
