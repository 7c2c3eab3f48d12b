"""Restore the state of a process that a signal has stopped (SIGSTOP, job control).

If the component has a guard, the state is recorded only for children, and only while the first process runs. The guard may hold
the whole component by SIGSTOP, and after a restore it is another guard.

A child may have resumed without its parent having been told yet (WCONTINUED). The capture asks the parent itself, and so learns
of one such child only.

Facts: ``descriptors`` (none); ``signal`` by which it is stopped, 0 if it has resumed and its parent is to be told; ``untold``:
the code that wait(2) still has to report to its parent for the stop (CLD_STOPPED, 5), 0 if nothing.

Source: wait(2); do_signal_stop() and prepare_signal() in kernel/signal.c; do_task_stat() in fs/proc/array.c.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from checkpoint.capability import Area, by_rule, preserved
from checkpoint.model import Resource
from checkpoint.resources.restore_context import number_of

KIND: Final = "stops"
CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "processes that are stopped (SIGSTOP, job control)",
        "stopped again, and their parent learns what it had not been told yet. Exception: the first process of a program "
        "under an agent runs on, and then all others do",
    ),
    by_rule(
        Area.PROCESS,
        "a continued child of which its parent has not been told (WCONTINUED); processor time of ended children "
        "(RUSAGE_CHILDREN)",
        "the parent is told of one such child only; the time begins at zero",
    ),
)
CLD_STOPPED: Final = 5


def describe(stopped_by: int, exit_code: int) -> tuple[Resource, ...]:
    """How a child stands, as a resource; none for one that simply runs.

    Args:
        stopped_by: the signal by which it stood before we stopped it; 0: it ran.
        exit_code: of /proc/PID/stat, where a stop stands until the parent has been told.
    """
    if not stopped_by:
        return ()
    return (Resource(KIND, "stopped", {"descriptors": [], "signal": stopped_by, "untold": CLD_STOPPED if exit_code else 0}),)


def going_on() -> Resource:
    """A child that runs again after a stop, of which its parent has not been told."""
    return Resource(KIND, "goes on", {"descriptors": [], "signal": 0, "untold": 0})


def stop_of(resources: Iterable[Resource]) -> tuple[int, int] | None:
    """The facts ``signal`` and ``untold`` of a stopped or continued process; None for one that simply runs."""
    for held in resources:
        if held.kind == KIND:
            return number_of(held.facts["signal"]), number_of(held.facts["untold"])
    return None
