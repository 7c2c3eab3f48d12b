"""Timed turns in an asyncio loop; `failover.kept_state.loop` is the same for a thread."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import signal
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

from failover.kept_state.api import Task
from failover.kept_state.period import FINISHED, Activations, Step


async def turns(task: Task, period_ns: int) -> AsyncIterator[int]:
    """The turns of an ``async for``, see `failover.kept_state.loop.Turns`."""
    stopped = asyncio.Event()
    task.activations = Activations(period_ns, time.monotonic_ns())
    with _sigterm(stopped):
        while not stopped.is_set():
            yield task.activations.steps
            task.commit()
            left = task.activations.next_ns(time.monotonic_ns()) - time.monotonic_ns()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stopped.wait(), max(left, 0) / 1e9)


def run_steps_in_loop(task: Task, step: Step, on_resume: Step | None, period_ns: int) -> None:
    """As `failover.kept_state.loop.run_steps`, for a step that is a coroutine."""
    asyncio.run(_run_steps(task, step, on_resume, period_ns))


async def _run_steps(task: Task, step: Step, on_resume: Step | None, period_ns: int) -> None:
    async for turn in turns(task, period_ns):
        if turn == 0 and on_resume is not None:
            await _finished(on_resume())
        if await _finished(step()) is FINISHED:
            task.commit()
            return


async def _finished(outcome: object) -> object:
    return await outcome if inspect.isawaitable(outcome) else outcome


@contextmanager
def _sigterm(stopped: asyncio.Event) -> Iterator[None]:
    is_ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    loop = asyncio.get_running_loop()
    if is_ours:
        loop.add_signal_handler(signal.SIGTERM, stopped.set)
    try:
        yield
    finally:
        if is_ours:
            loop.remove_signal_handler(signal.SIGTERM)
