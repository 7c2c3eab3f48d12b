"""The lock on future mappings of a process (mlockall(2) with MCL_FUTURE); VmFlags report single locks.

The kernel does not report this lock. Pages that the tracer maps in the process show it: if they are locked, as all other pages
are, the lock is in force. A process that has locked only its existing pages (MCL_CURRENT) after the tracer mapped its pages looks
alike; it then gets both.

Facts: ``descriptors`` (none); ``on_fault``: pages are locked when they are first touched (MCL_ONFAULT).

Source: mlock(2); mm/mlock.c.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.linux.procfs.vm_flags import DROPPABLE, HUGE, LOCKED, LOCKED_ON_FAULT
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource

KIND: Final = "memory_locks"
CAPABILITIES: Final = (
    preserved(
        Area.MEMORY,
        "locked memory: mlock, also on fault, and mlockall for future mappings",
        "locked again as far as its limit and rights allow there; otherwise a note names the rest",
    ),
)
MCL_FUTURE: Final = 2
MCL_ONFAULT: Final = 4
_NEVER_LOCKED: Final = frozenset(("io", "pf", "de", HUGE, DROPPABLE))
"""Codes of mappings that the kernel leaves out."""


def describe(of_program: Iterable[Sequence[str]], of_ours: Iterable[Sequence[str]]) -> tuple[Resource, ...]:
    """Whether locking is in force, as a resource.

    Args:
        of_program: the codes of each of its mappings.
        of_ours: those of the pages that we have mapped in it.
    """
    ours = list(of_ours)
    lockable = [codes for codes in of_program if not _NEVER_LOCKED & set(codes)]
    if not ours or not lockable or not all(LOCKED in codes for codes in (*ours, *lockable)):
        return ()
    on_fault = all(LOCKED_ON_FAULT in codes for codes in ours)
    return (Resource(KIND, "locked memory", {"descriptors": [], "on_fault": on_fault}),)


def rebuild(table: CallTable, resources: Iterable[Resource]) -> None:
    """Add the call that locks all memory that is mapped from then on."""
    for held in resources:
        if held.kind == KIND:
            flags = MCL_FUTURE | (MCL_ONFAULT if held.facts["on_fault"] else 0)
            table.attempt("memory that it maps from now on is not locked", "mlockall", flags)
