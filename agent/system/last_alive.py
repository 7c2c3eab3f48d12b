"""A sign of life on the disk: after a power cut it tells for how long this robot was off, in which no program worked."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Final

from msgspec import Struct

SIGN_S: Final = 1.0
"""Between two signs while a program runs here: an agent knows this closely when its earlier life ended."""


FILE_NAME: Final = "last_alive"
"""Below the state directory."""


class LastAlive(Struct):
    """The sign of this agent's earlier life, and that of this one. Times by this machine's calendar, in nanoseconds.

    Attributes:
        path: of a file whose time of change is the sign; nothing is in it.
        before_ns: when the earlier life gave its last sign; 0: not known.
        began_ns: when this life began.
    """

    path: Path
    before_ns: int
    began_ns: int

    @classmethod
    def found(cls, path: Path) -> LastAlive:
        """Read the sign of the earlier life."""
        try:
            before_ns = path.stat().st_mtime_ns
        except OSError:
            before_ns = 0
        return cls(path, before_ns, time.time_ns())

    def sign(self) -> None:
        """Tell the next life that this one was alive now. A full disk keeps the old sign."""
        with contextlib.suppress(OSError):
            self.path.touch()

    def off_ns(self, age_ns: int) -> int:
        """For how long this robot was off, at least, since a checkpoint that is so old now: 0 if it was taken in this life."""
        now_ns = time.time_ns()
        if now_ns - age_ns >= self.began_ns or not self.before_ns:
            return 0
        ended_ns = min(self.before_ns + int(SIGN_S * 1e9), self.began_ns)
        return max(0, min(now_ns - ended_ns, age_ns))
