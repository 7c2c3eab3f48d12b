"""Facts about the restore as a whole that the ``rebuild`` of every kind receives."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct, field

from checkpoint.engine import RestoreOptions
from checkpoint.errors import RestoreError
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Clocks, Fact, Resource

NO_DEVICE: Final = -1


class Rebuilding(Struct, frozen=True):
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

    def ended(self, table: CallTable, held: Resource) -> int:
        """A descriptor of what the program holds of a process that has ended: `exited_processes` has made it."""
        made = self.objects[ended_place(held)]
        return table.obtain(f"open {held.name} again", "fcntl", made, fcntl.F_DUPFD, 0)

    @property
    def elapsed_ns(self) -> int:
        """How long ago the capture was."""
        return self.options.elapsed_ns


def ended_place(held: Resource) -> tuple[int, int]:
    """Where among the objects something is that the program holds of a process that has ended; no device has that number."""
    descriptors = held.facts["descriptors"]
    assert isinstance(descriptors, list) and isinstance(descriptors[0], list)
    return NO_DEVICE, number_of(descriptors[0][0])


def numbers_of_thread(resources: Iterable[Resource], kind: str, tid: int) -> Iterator[list[int]]:
    """The numbers that a kind tells of a thread. Its ``threads`` are lists, each with a thread's id before these numbers."""
    for held in resources:
        threads = held.facts["threads"] if held.kind == kind else []
        assert isinstance(threads, list)
        for one in threads:
            assert isinstance(one, list)
            if one[0] == tid:
                yield [number_of(fact) for fact in one[1:]]


def number_of(fact: Fact) -> int:
    """A fact that is an integer.

    Raises:
        RestoreError: it is not.
    """
    if not isinstance(fact, int):
        raise RestoreError(f"cannot restore: a resource says {fact!r} where a number belongs")
    return fact
