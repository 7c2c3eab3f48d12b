"""The mapped table of a robot's tasks, beside its board: rows as orders see them, and orders carried out."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterable
from typing import ClassVar

from failover.boards import futex, locks
from failover.boards.shared_file import SharedFile
from failover.core.schedule import layout
from failover.core.schedule.layout import ROW_LOCKS, Header, Piece, View
from failover.core.schedule.orders import Outcome, Rows
from failover.core.schedule.terms import TASKS_MAX
from failover.errors import FailoverError, ScheduleError, ScheduleGoneError

Order = Callable[[Rows, frozenset[int]], Outcome]
"""The rows, and those that a process runs → what is to be written."""


class ScheduleFile(SharedFile):
    """The table, mapped; see `SharedFile`. Its size never changes."""

    WHAT: ClassVar[str] = "schedule"
    SIZE_MIN: ClassVar[int] = layout.FILE_SIZE
    SIZE_MAX: ClassVar[int] = layout.FILE_SIZE
    ERROR: ClassVar[type[FailoverError]] = ScheduleError
    GONE_ERROR: ClassVar[type[FailoverError]] = ScheduleGoneError

    header: Header
    table: View

    def _map(self, area: mmap.mmap) -> None:
        super()._map(area)
        self.table = View(self.view)

    def read_header(self) -> Header:
        """As it is now.

        Raises:
            ScheduleGoneError, ScheduleError: see `layout.read_header`; names the file.
        """
        try:
            return layout.read_header(self.view)
        except ScheduleError as error:
            raise type(error)(f"{self.path}: {error}") from None

    def rows(self) -> Rows:
        """All tasks, as orders see them.

        Raises:
            ScheduleError: a row is damaged.
        """
        return layout.read_rows(self.table)

    def take_row(self, index: int) -> bool:
        """Become the process that runs a task; False if another one is."""
        return locks.take(self.descriptor, ROW_LOCKS + index)

    def is_run(self, index: int) -> bool:
        """Whether another opening of the file runs a task; of this one the kernel does not tell."""
        return locks.is_taken(self.descriptor, ROW_LOCKS + index)

    def give(self, order: Order, own: int = -1) -> Outcome:
        """Carry out an order: all of it, or nothing.

        Args:
            own: the row that this opening runs.

        Raises:
            ScheduleError: it cannot be; nothing changed.
        """
        if not self.is_writable:
            raise ScheduleError(f"cannot change {self.path}: this user may only read it")
        with self.changing():
            rows = self.rows()
            held = frozenset(index for index in rows if index == own or self.is_run(index))
            outcome = order(rows, held)
            for index, row in outcome.written.items():
                self.write(layout.row_pieces(self.table, index, row, rows.get(index)))
            self.write(layout.successors_pieces({**rows, **outcome.written}))
        self._wake(outcome)
        return outcome

    def write(self, pieces: Iterable[Piece]) -> None:
        """Write pieces in their order."""
        layout.apply(self.table, pieces)

    def _wake(self, outcome: Outcome) -> None:
        """Wake the tasks that sleep on their own row, or on a predecessor's."""
        base = self.address(0)
        for index, row in outcome.written.items():
            for other in (index, *(row.terms.after if row.terms else ())):
                futex.wake(base + layout.row_at(other) + layout.SETTLED_FIELD)
            futex.wake(base + layout.row_at(index) + layout.SERIAL_FIELD)

    def row_of(self, name: str) -> int | None:
        """The row of a task that is declared; None: it is not."""
        for index in range(TASKS_MAX):
            if layout.is_declared(self.table, index) and layout.name_of(self.table, index) == name:
                return index
        return None
