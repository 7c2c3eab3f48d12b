"""Sleep until a traced thread stops: keep the signals that report stops for the thread that waits for one.

Polling is not enough. A thread with real-time priority (`checkpoint.linux.realtime_boost`) keeps the processor while it polls,
and the thread that is to stop may be waiting for that processor. A sleep of a fixed time is too long most of the time.

One signal reports many stops, and another thread of ours may take it. Polling finds a stop that no signal has reported, so such a
case costs only a little time.

Source: do_notify_parent_cldstop() and complete_signal() in kernel/signal.c.
"""

from __future__ import annotations

import signal
import time
from typing import Final

REPORT: Final = signal.SIGCHLD


class Reports:
    """Kept and given back by one thread."""

    def __init__(self) -> None:
        self._before: set[int] | None = None

    def keep(self) -> None:
        """Have `sleep_until_report` hear of every stop from now on."""
        if self._before is None:
            self._before = set(signal.pthread_sigmask(signal.SIG_BLOCK, (REPORT,)))

    def give_back(self) -> None:
        """As before; also after no `keep`. A handler for that signal runs now, for the signal tells of other children, too."""
        before, self._before = self._before, None
        if before is None or REPORT in before:
            return
        if signal.getsignal(REPORT) not in (signal.SIG_DFL, signal.SIG_IGN):
            signal.raise_signal(REPORT)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (REPORT,))


def sleep_until_report(seconds: float) -> None:
    """Sleep for so long, or until a thread has stopped for us, if reports are kept."""
    if REPORT in signal.pthread_sigmask(signal.SIG_BLOCK, ()):
        signal.sigtimedwait((REPORT,), seconds)
    else:  # it would be taken from a handler
        time.sleep(seconds)
