"""Give our thread precedence over ordinary threads while a program is frozen, because losing the processor prolongs the freeze.

Work at a real-time priority must be short, because other threads wait for it. After a capture that used the processor for long
(200 threads take 20 ms), the next one runs with a high weight instead: it gets nearly all of a processor that others want as
well, and cannot keep them from it. So does the first one, whose length is unknown. Every wait must sleep meanwhile
(`checkpoint.linux.trace.tracee.rest`): the program, which has an ordinary priority, makes calls for us, perhaps on the same
processor.

Source: sched(7), sched_setscheduler(2), setpriority(2).
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable
from typing import Final

PRIORITY: Final = 1
"""The lowest there is: beats, guards and all other real-time threads of this machine come first."""
NICE: Final = -20
"""87 times the weight of an ordinary thread."""
LONG_S: Final = 0.01
"""After a look that used the processor for longer the next one is not in real time."""


class Precedence:
    """Taken and given back by one thread; where the system does not allow it, nothing happens.

    Args:
        clock: of the time that this thread has used the processor, in seconds: waiting takes nothing from others.
    """

    def __init__(self, clock: Callable[[], float] = time.thread_time) -> None:
        self._clock = clock
        self._is_taken = False
        self._weighs_more = False
        self._is_refused = False
        self._was_long = True
        self._began = 0.0
        self._before = os.SCHED_OTHER
        self._nice = 0

    def take(self) -> None:
        """Come before all ordinary threads from now on; one that has a real-time priority already keeps it."""
        self._began = self._clock()
        if self._is_taken or self._weighs_more or self._is_refused:
            return
        try:
            before = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
            if before not in (os.SCHED_OTHER, os.SCHED_BATCH):
                return
            if self._was_long or _ends_us():
                self._nice = os.getpriority(os.PRIO_PROCESS, 0)
                os.setpriority(os.PRIO_PROCESS, 0, NICE)
                self._weighs_more = True
            else:
                os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
                self._is_taken, self._before = True, before
        except OSError:  # an ordinary user, or a container
            self._is_refused = True

    def give_back(self) -> None:
        """Be an ordinary thread again; also after a `take` that changed nothing."""
        self._was_long = self._clock() - self._began > LONG_S
        if self._weighs_more:
            self._weighs_more = False
            os.setpriority(os.PRIO_PROCESS, 0, self._nice)
        if self._is_taken:
            self._is_taken = False
            os.sched_setscheduler(0, self._before | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def _ends_us() -> bool:
    """Whether the kernel ends a thread that is in real time for long (RLIMIT_RTTIME, by SIGXCPU): a program waits for us."""
    return resource.getrlimit(resource.RLIMIT_RTTIME)[0] != resource.RLIM_INFINITY
