"""Ends a guard or keeper that owes an answer and was stopped or hangs, so that it is replaced.

A guard that stands still freezes nothing when its program's lease ends. A keeper that stands still takes no snapshots, and may
stand in the middle of one, with the program. failover tolerates the loss of both: the program is resumed, or gets another keeper.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable
from typing import Final

STEP_S: Final = 1.0
"""Between two looks at a process that owes an answer."""

STEPS_MAX: Final = 4
"""Looks in a row, after the first one, at which it has done nothing; then it is ended. A guard answers within two seconds, even
while it waits."""

LATE_S: Final = 0.5
"""A look that comes so late says that we stood still, too: it does not count."""

UNKNOWN: Final = ""
WAITS_FOR_DISK: Final = "D"
WAITS_FOR_PROCESSOR: Final = "R"
"""Of one that has used none meanwhile: others kept it from running, and would keep the one in its place."""

NOT_SEEN: Final[tuple[object, str, int]] = (None, UNKNOWN, 0)

log = logging.getLogger("failover.component")


class Watchman:
    """Looks at one process from time to time, for as long as it owes an answer. Lives in one loop."""

    def __init__(self, pid: int, whom: str, owed: Callable[[], object]) -> None:
        """
        Args:
            whom: for the log.
            owed: the answer of it that was awaited first and has not come; None where it owes none.
        """
        self._pid, self._whom, self._owed = pid, whom, owed
        self._next_look: asyncio.TimerHandle | None = None
        self._seen = NOT_SEEN
        self._steps = 0

    def awaits(self) -> None:
        """An answer is awaited from now on."""
        if self._next_look is None:
            self._seen, self._steps = NOT_SEEN, 0  # nearly all answers come before the first look
            self._plan()

    def close(self) -> None:
        """Look no more."""
        if self._next_look is not None:
            self._next_look.cancel()
        self._owed = lambda: None

    def _sight(self) -> tuple[object, str, int]:
        return self._owed(), *activity(self._pid)

    def _plan(self) -> None:
        loop = asyncio.get_running_loop()
        at = loop.time() + STEP_S
        self._next_look = loop.call_at(at, self._look, at)

    def _look(self, planned: float) -> None:
        self._next_look = None
        before, self._seen = self._seen, self._sight()
        owed, state, _ = self._seen
        if owed is None:
            return
        is_late = asyncio.get_running_loop().time() - planned > LATE_S
        is_idle = before == self._seen and state not in (UNKNOWN, WAITS_FOR_DISK, WAITS_FOR_PROCESSOR)
        self._steps = self._steps + 1 if is_idle and not is_late else 0
        if self._steps < STEPS_MAX:
            self._plan()
            return
        self.end(f"it does nothing (state {state}) and owes an answer")

    def end(self, why: str) -> None:
        """End the process."""
        log.error("ending %s, pid %d: %s", self._whom, self._pid, why)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)


def activity(pid: int) -> tuple[str, int]:
    """State of a process, and the processor time that it has used, in clock ticks; `UNKNOWN` and 0 if it is not to be seen.

    Source: proc_pid_stat(5).
    """
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            fields = file.read().rpartition(")")[2].split()
        return fields[0], int(fields[11]) + int(fields[12])
    except OSError:
        return UNKNOWN, 0
