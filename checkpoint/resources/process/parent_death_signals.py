"""Signals that threads besides the first asked to receive when the parent of their process ends (PR_SET_PDEATHSIG).

Each thread has one of its own; that of the first thread is in `ProcessState`. When a parent ends, the kernel looks through all
threads of its child, and sends the signals that they asked for to the process as a whole.

Facts: ``descriptors`` (none); ``threads``: a list of [tid, signal].

Source: PR_SET_PDEATHSIG(2const); forget_original_parent() in kernel/exit.c.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.restore_context import numbers_of_thread

KIND: Final = "death_signals"
CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "each thread's signal at its parent's death (PR_SET_PDEATHSIG)",
        "set again; the parent is the process that restored the program, or its parent within the program",
    ),
)


def describe(told: Iterable[tuple[int, int]]) -> tuple[Resource, ...]:
    """The threads that have asked for a signal, by the ids that they know themselves.

    Args:
        told: (tid, signal) of each, 0 for none.
    """
    threads: list[Fact] = [[tid, signal] for tid, signal in told if signal > 0]
    return (Resource(KIND, "signals at the parent's death", {"descriptors": [], "threads": threads}),) if threads else ()


def rebuild(table: CallTable, resources: Iterable[Resource], tid: int) -> None:
    """Add the call by which a thread asks for its signal again; a change of user would take it back, so it comes after that."""
    for number, *_ in numbers_of_thread(resources, KIND, tid):
        lost = f"the signal at the parent's death is not kept for thread {tid}"
        table.attempt(lost, "prctl", abi.PR_SET_PDEATHSIG, number)
