"""Timed turns, each followed by a commit: of the program's own loop, or the steps of a component."""

from __future__ import annotations

import inspect
import signal
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Final

from failover.errors import TaskError
from failover.kept_state.api import PROCESS, Task
from failover.kept_state.period import FINISHED, Activations, Step

LONGEST_PERIOD_S: Final = 1e6


class _StopError(BaseException):
    """SIGTERM came between two steps."""


class _Stopping:
    """Whether SIGTERM has come; between two steps it ends the wait at once."""

    def __init__(self) -> None:
        self.is_asked = False
        self.is_between_steps = False

    def ask(self, *_: object) -> None:
        self.is_asked = True
        if self.is_between_steps:
            raise _StopError

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take SIGTERM, unless the program has its own plans for it."""
        is_ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        if is_ours:
            signal.signal(signal.SIGTERM, self.ask)
        try:
            yield
        except _StopError:
            self.is_between_steps = False
        finally:
            if is_ours:
                signal.signal(signal.SIGTERM, signal.SIG_DFL)


class Turns:
    """The turns of a loop at their times: each is committed when its body has come to its end. See `every`.

    Iterated by ``for`` or by ``async for``; a turn yields its number in this run, from 0. SIGTERM ends the loop after the
    turn under way, committed like the others. A body that raises, or leaves the loop by itself, is not committed.
    """

    def __init__(self, task: Task, period_ns: int) -> None:
        self._task = task
        self._period_ns = period_ns

    def __iter__(self) -> Iterator[int]:
        task, stopping = self._task, _Stopping()
        task.activations = Activations(self._period_ns, time.monotonic_ns())
        with stopping.listening():
            while True:
                yield task.activations.steps
                task.commit()
                stopping.is_between_steps = True
                if stopping.is_asked:  # it came during the turn
                    return
                _sleep_until(task.activations.next_ns(time.monotonic_ns()))
                stopping.is_between_steps = False

    def __aiter__(self) -> AsyncIterator[int]:
        from failover.kept_state.asyncio_loop import (
            turns,  # which takes its time to load: only a program with an asyncio loop pays
        )

        return turns(self._task, self._period_ns)


def every(period: float) -> Turns:
    """A loop that is committed at the end of each turn: ``for _ in failover.every(0.1):``, or ``async for`` in an asyncio loop.

    It is the same as a commit at the end of the body, and a sleep until the next turn is due. A body that takes longer than its
    period misses beginnings, which `failover.activations` counts. SIGTERM ends the loop after the turn under way. A turn that
    raises or is left by ``break`` or ``return`` is not committed: call `failover.commit` there if it should be.

    Args:
        period: seconds from the beginning of a turn to that of the next one; 0: at once.

    Raises:
        TaskError: this process keeps no state yet, or the period is none.
    """
    task = PROCESS.the_task("commit each turn of a loop")
    if not 0 <= period < LONGEST_PERIOD_S:
        raise TaskError(f"every({period}) is no period: say how many seconds lie between the beginnings of two turns; 0: at once")
    return Turns(task, round(period * 1e9))


def run_steps(task: Task, step: Step, on_resume: Step | None, period_ns: int) -> None:
    """Call ``on_resume``, then the step again and again, committing each, until it returns `FINISHED` or SIGTERM comes."""
    if inspect.iscoroutinefunction(step):
        from failover.kept_state.asyncio_loop import run_steps_in_loop

        run_steps_in_loop(task, step, on_resume, period_ns)
        return
    for turn in Turns(task, period_ns):
        if turn == 0 and on_resume is not None:
            on_resume()
        if step() is FINISHED:
            task.commit()
            return


def _sleep_until(deadline_ns: int) -> None:
    left = deadline_ns - time.monotonic_ns()
    if left > 0:
        time.sleep(left / 1e9)
