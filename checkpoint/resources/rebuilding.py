"""What every kind's ``rebuild`` knows of the restore as a whole."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from checkpoint.engine import RestoreOptions
from checkpoint.errors import RestoreError
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Clocks, Fact


@dataclass(frozen=True, slots=True)
class Rebuilding:
    """One restore.

    Attributes:
        clocks: as the program read them at the capture.
        inner_pid: what the process itself will know as its PID.
        spare: from this number on none is wanted.
        objects: files without a name that are there already: a descriptor of each, by its (device, inode) in the snapshot.
    """

    options: RestoreOptions
    clocks: Clocks
    inner_pid: int
    spare: int
    objects: dict[tuple[int, int], int] = field(default_factory=dict)

    def keep(self, table: CallTable, key: tuple[int, int], made: int) -> None:
        """Move the descriptor of an object out of the way, and remember it."""
        number = self.spare + len(self.objects)
        table.duplicate(made, number, os.O_CLOEXEC)
        table.close(made)
        self.objects[key] = number

    @property
    def elapsed_ns(self) -> int:
        """How long ago the capture was."""
        return self.options.elapsed_ns


def number_of(fact: Fact) -> int:
    """A fact that is an integer.

    Raises:
        RestoreError: it is not.
    """
    if not isinstance(fact, int):
        raise RestoreError(f"cannot restore: a resource says {fact!r} where a number belongs")
    return fact
