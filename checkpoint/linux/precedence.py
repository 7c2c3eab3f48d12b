"""Our thread before all ordinary ones while a program stands still for it: whoever takes the processor from us prolongs that.

What stands still must be short: a look that took long once is made at ordinary priority the next time, or the others on this
processor would wait as long. Nothing may wait without sleeping meanwhile (`checkpoint.linux.tracee.rest`): the program, which
has an ordinary priority, makes calls for us, perhaps on the same processor.

Source: sched(7), sched_setscheduler(2).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final

PRIORITY: Final = 1
"""The lowest of SCHED_RR: beats, guards and whatever else is in real time on this machine come first."""
LONG_S: Final = 0.01
"""A look that took longer is not given precedence the next time."""


class Precedence:
    """Taken and given back by one thread; where the system does not allow it, nothing happens.

    Args:
        clock: in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._is_taken = False
        self._is_refused = False
        self._was_long = False
        self._began = 0.0

    def take(self) -> None:
        """Come before all ordinary threads from now on; one that has a real-time priority already keeps it."""
        self._began = self._clock()
        if self._is_taken or self._is_refused or self._was_long:
            return
        try:
            if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_OTHER, os.SCHED_BATCH):
                os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
                self._is_taken = True
        except OSError:  # an ordinary user, or a container
            self._is_refused = True

    def give_back(self) -> None:
        """Be an ordinary thread again; also after a `take` that changed nothing."""
        self._was_long = self._clock() - self._began > LONG_S
        if self._is_taken:
            self._is_taken = False
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
