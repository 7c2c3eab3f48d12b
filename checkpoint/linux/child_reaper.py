"""Reap dead threads from a second thread while the tracing thread waits in the kernel, so that the two waits do not deadlock.

A thread that executes another program holds cred_guard_mutex until all other threads of its process are gone. A traced thread is
gone only when its tracer has reaped it. A tracer that seizes the next thread of that process (PTRACE_SEIZE) waits for the same
mutex, and no signal ends this wait: the kernel makes the call again by itself. So both would wait for ever. But a tracer may reap
with any of its threads. So one more thread of the tracer sleeps beside the one that seizes, and a timer wakes it only when the
seizing takes so long that something must be wrong. Setting the timer costs less than a microsecond, and nothing wakes a thread in
between.

Source: ptrace_attach() in kernel/ptrace.c, de_thread() in fs/exec.c, __exit_signal() in kernel/exit.c; waitpid(2), __WALL.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Collection, Iterator
from typing import Final

from checkpoint.linux import abi

PERIOD_NS: Final = 10_000_000
"""How long seizing may take before we look for ended threads, and how often then: usually it takes a microsecond a thread."""


def bury(tid: int) -> bool:
    """Take note of the end of a thread that we trace; False when it has not ended, is not ours, or its end is noted already.

    We look first, without taking note: the kernel tells a tracer of a stop once, also one that waits for ends only.

    Source: wait_task_stopped() in kernel/exit.c.
    """
    try:
        found = os.waitid(os.P_PID, tid, os.WEXITED | os.WNOHANG | os.WNOWAIT | abi.WALL)
        if found is None or found.si_code not in abi.ENDS:
            return False
        return os.waitid(os.P_PID, tid, os.WEXITED | os.WNOHANG | abi.WALL) is not None
    except ChildProcessError:
        return False


class Burial:
    """One sleeping thread of ours; `watching` is called from the one that traces. It ends with `close`, or with this object."""

    def __init__(self) -> None:
        self._plot = _Plot(abi.timerfd())
        self._thread = threading.Thread(target=self._plot.bury, name="burial", daemon=True)
        self._thread.start()
        self._end = weakref.finalize(self, self._plot.leave)
        self._end.atexit = False

    def close(self) -> None:
        """End the thread; a second time it does nothing."""
        self._end()
        self._thread.join()

    @contextlib.contextmanager
    def watching(self, seized: Collection[int]) -> Iterator[None]:
        """See that the body does not wait for ever.

        Args:
            seized: ids of threads that we trace, which may become more; no first ones, whose end is for their parents to note.
        """
        self._plot.seized = seized
        abi.set_timerfd(self._plot.timer, PERIOD_NS)
        try:
            yield
        finally:
            abi.set_timerfd(self._plot.timer, 0)
            self._plot.seized = ()


class _Plot:
    """The data of the thread. It does not hold its `Burial`, or that could never go."""

    def __init__(self, timer: int) -> None:
        self.timer = timer
        self.seized: Collection[int] = ()
        self._is_over = False

    def leave(self) -> None:
        """Have `bury` end."""
        self._is_over = True
        abi.set_timerfd(self.timer, 1)

    def bury(self) -> None:
        """Take note of ended threads whenever the timer goes off; the timer is closed at the end."""
        try:
            while not self._is_over:
                os.read(self.timer, 8)
                for tid in tuple(self.seized):
                    bury(tid)
        finally:
            os.close(self.timer)
