"""Steps at their times, each followed by a commit: in a thread, or in an asyncio loop where the step is a coroutine."""

from __future__ import annotations

import asyncio
import enum
import inspect
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from failover.client.task import Task
from failover.client.task_rhythm import Activations


class Finished(enum.Enum):
    """What a step returns when it was the last one."""

    FINISHED = "finished"


FINISHED: Final = Finished.FINISHED

Step = Callable[[], object]


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


def run_steps(task: Task, step: Step, on_resume: Step | None, period_ns: int) -> None:
    """Call ``on_resume``, then the step again and again, committing each, until it returns `FINISHED` or SIGTERM comes."""
    task.activations = Activations(period_ns, time.monotonic_ns())
    if inspect.iscoroutinefunction(step):
        asyncio.run(_run_in_loop(task, step, on_resume))
        return
    stopping = _Stopping()
    with stopping.listening():
        if on_resume is not None:
            on_resume()
        while True:
            outcome = step()
            task.commit()
            if outcome is FINISHED:
                return
            stopping.is_between_steps = True
            if stopping.is_asked:  # it came during the step
                return
            _sleep_until(task.activations.next_ns(time.monotonic_ns()))
            stopping.is_between_steps = False


def _sleep_until(deadline_ns: int) -> None:
    left = deadline_ns - time.monotonic_ns()
    if left > 0:
        time.sleep(left / 1e9)


async def _run_in_loop(task: Task, step: Step, on_resume: Step | None) -> None:
    stopped = asyncio.Event()
    with _asyncio_sigterm(stopped):
        if on_resume is not None:
            await _finished(on_resume())
        while not stopped.is_set():
            outcome = await _finished(step())
            task.commit()
            if outcome is FINISHED:
                return
            left = task.activations.next_ns(time.monotonic_ns()) - time.monotonic_ns()
            try:
                await asyncio.wait_for(stopped.wait(), max(left, 0) / 1e9)
            except TimeoutError:
                continue


async def _finished(outcome: object) -> object:
    return await outcome if inspect.isawaitable(outcome) else outcome


@contextmanager
def _asyncio_sigterm(stopped: asyncio.Event) -> Iterator[None]:
    is_ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    loop = asyncio.get_running_loop()
    if is_ours:
        loop.add_signal_handler(signal.SIGTERM, stopped.set)
    try:
        yield
    finally:
        if is_ours:
            loop.remove_signal_handler(signal.SIGTERM)
