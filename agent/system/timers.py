"""The agent's timer: a descriptor that becomes readable at an instant of CLOCK_BOOTTIME. The only timerfd of the agent.

poll(2) and epoll_wait(2) count their patience in whole milliseconds, rounded up, and in the time that the machine was awake: a
loop that sleeps by it turns half a millisecond late on average, and after a sleep of the machine it waits for the rest.
Source: timerfd_create(2), epoll_wait(2); `fs/timerfd.c` (a timer that is set anew forgets that it rang).
"""

from __future__ import annotations

import ctypes
import os
import time
from typing import Final

TFD_TIMER_ABSTIME: Final = 1
TFD_NONBLOCK: Final = os.O_NONBLOCK
TFD_CLOEXEC: Final = os.O_CLOEXEC
NS_PER_S: Final = 1_000_000_000

_Times = ctypes.c_long * 4
"""struct itimerspec: seconds and nanoseconds of the interval, then of the first time."""

_libc = ctypes.CDLL(None, use_errno=True)
_libc.timerfd_settime.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.POINTER(ctypes.c_long), ctypes.c_void_p)


class Alarm:
    """A descriptor that is readable from an instant of CLOCK_BOOTTIME on, until another instant is set; a sleep counts."""

    def __init__(self) -> None:
        """
        Raises:
            OSError: no descriptor is left.
        """
        self._descriptor = int(_libc.timerfd_create(time.CLOCK_BOOTTIME, TFD_NONBLOCK | TFD_CLOEXEC))
        check(self._descriptor, "timerfd_create")
        self._times = _Times()
        self._at_ns: int | None = None

    def fileno(self) -> int:
        """For poll(2)."""
        return self._descriptor

    def set(self, at_ns: int | None) -> None:
        """Ring at this instant, at once if it is over; None: not at all. The instant that is set already costs no system call."""
        if at_ns == self._at_ns:
            return
        self._times[2], self._times[3] = divmod(max(at_ns, 1), NS_PER_S) if at_ns is not None else (0, 0)
        check(_libc.timerfd_settime(self._descriptor, TFD_TIMER_ABSTIME, self._times, None), "timerfd_settime")
        self._at_ns = at_ns

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._descriptor)


def check(result: int, what: str) -> None:
    """Raises OSError: a call of the C library has failed; ``what`` names it."""
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
