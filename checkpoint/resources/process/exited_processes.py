"""References of the program to processes that have ended: a pidfd, a file of /proc, its working directory there.

Such a descriptor answers like that of any ended process; which process it was cannot be queried any more. So a restore makes the
vessel create a child that never runs, opens the wanted files of it, ends it, and reaps it
(`checkpoint.engines.ptrace.restore.process`). Nothing is read meanwhile, not even by lseek(2), because that would leave facts
about another process in the kernel's buffer.

Fact of both kinds: ``ended``: a number that pidfds, or files, of the same process have in common.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources.events import pidfd
from checkpoint.resources.files import proc_and_sys
from checkpoint.resources.restore_context import ended_place, number_of

WALL: Final = 0x40000000
"""Wait for children that send no signal at their end, too. Source: wait4(2)."""

Descriptors = dict[tuple[int, int], int]
"""A descriptor of each open file that was made, by its place among the nameless objects of `restore_context.Rebuilding`."""


class Departed(Struct, frozen=True):
    """One process that has ended.

    Attributes:
        held: what the program holds of it.
        directory: where the program works in /proc, with ``{ended}`` for the number; "" if it does not.
    """

    held: tuple[Resource, ...]
    directory: str = ""

    def open(self, table: CallTable, pid: int) -> Descriptors:
        """Add the calls that open all of it, and enter its directory.

        Args:
            pid: of the child that stands for it, as the vessel knows it.
        """
        if self.directory:
            place = table.place_path(proc_and_sys.of_ended(self.directory, pid))
            table.call(f"enter the working directory {self.directory}", "chdir", place)
        return {ended_place(one): _opened(table, one, pid) for one in self.held}


def of(resources: Iterable[Resource], directory: str) -> tuple[Departed, ...]:
    """The processes of which a process holds something though they have ended.

    Args:
        directory: where it works.
    """
    found: dict[tuple[str, int], list[Resource]] = {}
    for held in resources:
        if held.kind in (pidfd.KIND, proc_and_sys.KIND) and (ended := number_of(held.facts.get("ended", 0))):
            found.setdefault((held.kind, ended), []).append(held)
    left = (Departed((), place),) if (place := proc_and_sys.left_by_ended(directory)) else ()
    return (*(Departed(tuple(group)) for group in found.values()), *left)


def _opened(table: CallTable, held: Resource, pid: int) -> int:
    flags = number_of(held.facts["flags"])
    if held.kind == pidfd.KIND:
        return table.obtain(f"open the pidfd of {held.name}", "pidfd_open", pid, flags & os.O_NONBLOCK)
    return table.open(proc_and_sys.of_ended(str(held.facts["path"]), pid), flags)


def forget(table: CallTable, pid: int) -> None:
    """Add the call by which the vessel takes note of the end of the child that stood for one."""
    table.call(f"take note of the end of {pid}", "wait4", pid, 0, WALL, 0)
