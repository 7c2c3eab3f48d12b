"""A wait of the demo: it tells every few seconds what it waits for, and what the machine does when it gives up."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final

TOLD_EVERY_S: Final = 10.0
"""How often a wait says that it still waits."""
BUSY_LOAD: Final = 2.0
"""Load for each core above which a machine is too busy to show anything."""

Tell = Callable[[str], None]


class Waiting:
    """One wait.

    Attributes:
        tell: gets a line every `TOLD_EVERY_S`.
    """

    def __init__(self, what: str, limit_s: float, tell: Tell) -> None:
        self._what = what
        self._limit_s = limit_s
        self._tell = tell
        self._began = self._told = time.monotonic()

    def is_over(self, how_far: Callable[[], str] = lambda: "") -> bool:
        """Whether it has lasted for as long as it may; tells of it meanwhile.

        Args:
            how_far: the progress, in a few words; "" if nothing is known.
        """
        now = time.monotonic()
        if now - self._told >= TOLD_EVERY_S:
            self._told = now
            far = f"; {words}" if (words := how_far()) else ""
            self._tell(f"waiting for {self._what}: {now - self._began:.0f} s of {self._limit_s:.0f} s at most{far}")
        return now - self._began > self._limit_s


def load_and_cure() -> str:
    """How busy this machine is, and what to do about a demo that failed: two sentences."""
    load, cores = os.getloadavg()[0], len(os.sched_getaffinity(0))
    figure = f"This machine has a load of {load:.1f} on {cores} core{'s' if cores > 1 else ''}"
    if load > BUSY_LOAD * cores:
        return f"{figure}: that is too much for the demo. End other programs, or wait until they have ended, and run it again."
    return f"{figure}, so that is not the cause. Run it again; if it fails again, the logs say why."
