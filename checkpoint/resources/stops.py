"""That a child process is stopped by a signal (SIGSTOP, job control), or goes on after that and its parent has not been told yet.

It is told of children only, and only while the first process runs: a component that stands still as a whole was stopped by
somebody else, who may be gone by the time that it is brought back.

Facts: ``descriptors`` (none); ``signal`` by which it is stopped, 0 if it runs; ``untold``: what wait(2) still has to tell its
parent (CLD_STOPPED 5, CLD_CONTINUED 6), 0 if nothing.

Source: wait(2); do_signal_stop() and prepare_signal() in kernel/signal.c; do_task_stat() in fs/proc/array.c.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.model import Resource
from checkpoint.resources.rebuilding import number_of

KIND: Final = "stops"
CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "child processes that are stopped (SIGSTOP, job control)",
        "stopped again, and their parent is told what it had not been told; a component that is stopped as a whole runs on",
    ),
)
CLD_STOPPED: Final = 5
CLD_CONTINUED: Final = 6


def describe(stopped_by: int, exit_code: int, *, is_continued: bool = False) -> tuple[Resource, ...]:
    """How a child stands, as a resource; none for one that simply runs.

    Args:
        stopped_by: the signal by which it stood before we stopped it; 0: it ran.
        exit_code: of /proc/PID/stat, where a stop stands until the parent has been told.
        is_continued: its parent has not been told yet that it goes on.
    """
    if stopped_by:
        return (_resource(stopped_by, CLD_STOPPED if exit_code else 0),)
    return (_resource(0, CLD_CONTINUED),) if is_continued else ()


def _resource(signal: int, untold: int) -> Resource:
    return Resource(KIND, "stopped", {"descriptors": [], "signal": signal, "untold": untold})


def stop_of(resources: Iterable[Resource]) -> tuple[int, int] | None:
    """The signal, and what is untold; None for one that simply runs."""
    for held in resources:
        if held.kind == KIND:
            return number_of(held.facts["signal"]), number_of(held.facts["untold"])
    return None
