"""Captures between two activations: a program that runs tasks of the schedule stands still when none of them is under way.

Loaded by a keeper (`checkpoint.keeper.server`), which waits here itself, between its last copy of pages and the freeze: a message
from another process would come when the short time between two activations is over. `failover.core.schedule.slack` has the rule.
The kernel tells which tasks a program runs: the process that runs a task holds a lock on its row.

Two keepers whose programs share a processor do not freeze at the same time: each locks the processors of its program in the
schedule.

Source: SCHEDULE.md.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from checkpoint.keeper.messages import Slack
from failover.boards import boottime, futex, locks
from failover.boards.fence import FENCE
from failover.boards.openings import Opening, openings_of
from failover.boards.unmapped_schedule import UnmappedSchedule
from failover.core.schedule import layout
from failover.core.schedule.activation import State
from failover.core.schedule.layout import CPU_LOCKS, SETTLED_FIELD
from failover.core.schedule.slack import Choice, Freezes, TaskSeen, Wait
from failover.core.schedule.terms import CPUS_MAX, Kind
from failover.errors import FailoverError

LOOK_NS: Final = 1_000_000_000
"""Between two looks which tasks a program runs: that reads a link of each of its descriptors."""
SLICE_NS: Final = 50_000_000
"""The longest wait before the pages that the program wrote meanwhile are copied again: else the freeze would grow."""
BUSY_NS: Final = 200_000
"""Between two tries while another keeper's program stands still on a processor of ours."""
READINGS: Final = 8
"""Of a row whose activation just begins or ends."""

UNKNOWN: Final = (State.IDLE, State.DONE)
"""States without a next activation that could be foreseen."""


class SlackGate:
    """See `checkpoint.keeper.server.WaitingGate`; of one component."""

    def __init__(self) -> None:
        self._skew_ns = boottime.skew_ns("monotonic")
        self._freezes = Freezes()
        self._file: UnmappedSchedule | None = None
        self._rows: tuple[int, ...] = ()
        self._cpus: tuple[int, ...] = ()
        self._looked_ns = 0
        self._lag_ns = 0
        self._wait: Wait | None = None
        self._opened_ns = 0
        self._is_squeezed = False
        self._outcome: Slack | None = None

    @property
    def outcome(self) -> Slack | None:
        """How the last capture met the activations; None: the program runs no tasks."""
        return self._outcome

    def begin(self, lag_ns: int) -> None:
        """A capture begins, which may wait for so long."""
        self._lag_ns, self._wait, self._outcome = lag_ns, None, None

    def opens(self, pids: tuple[int, ...]) -> bool:
        """See `checkpoint.engine.Gate.opens`."""
        try:
            return self._opens_for(pids, self._now_ns())
        except (FailoverError, OSError):  # there is no waiting on this machine: captures go on as of any other program
            self._wait = None
            return True

    def _opens_for(self, pids: tuple[int, ...], now_ns: int) -> bool:
        if not self._looked_ns or now_ns - self._looked_ns >= LOOK_NS or (self._file is not None and self._file.is_gone):
            self._look(pids)
            self._looked_ns = now_ns
        file = self._file
        if file is None:
            return True
        if self._wait is None:
            self._wait = Wait(now_ns, self._lag_ns, self._freezes.expected_ns)
        with self._listening(file):
            return self._opens(file, self._wait, now_ns + SLICE_NS)

    def closes(self, *, stood_still: bool) -> None:
        """See `checkpoint.engine.Gate.closes`."""
        file, wait = self._file, self._wait
        if file is None or wait is None or not self._opened_ns:
            return
        ended_ns = self._now_ns()
        self._unlock(file, self._cpus)
        self._freezes.note(ended_ns - self._opened_ns if stood_still else 0)
        slack_ns = wait.slack_ns if wait.slack_ns is not None else 0
        opened_ns, self._opened_ns = self._opened_ns, 0
        with contextlib.suppress(FailoverError):  # a file that cannot be read tells of no task
            task, period_ns = self._first_due(file)
            self._outcome = Slack(
                *(task, period_ns, opened_ns, ended_ns, opened_ns - wait.asked_ns),
                *(slack_ns, wait.freeze_ns, self._is_squeezed and stood_still),
            )

    # --- The wait ---

    def _opens(self, file: UnmappedSchedule, wait: Wait, until_ns: int) -> bool:
        base = file.address(0)
        while True:
            file.refresh(self._rows)
            ends = {row: file.table.ints[(layout.row_at(row) + SETTLED_FIELD) // 4] for row in self._rows}
            if FENCE is not None:
                FENCE()
            tasks = {row: _seen(file, row) for row in self._rows}
            now_ns = self._now_ns()
            choice = wait.choose(tasks.values(), now_ns)
            if choice is not Choice.WAIT:
                if self._lock(file) or now_ns - wait.asked_ns >= 2 * wait.lag_ns:
                    self._opened_ns, self._is_squeezed = now_ns, choice is Choice.SQUEEZE
                    return True
                next_ns = now_ns + BUSY_NS
            else:
                next_ns = until_ns
            if now_ns >= until_ns:
                return False
            row = _next_to_end(tasks)
            futex.wait_until(base + layout.row_at(row) + SETTLED_FIELD, ends[row], min(next_ns, until_ns) + self._skew_ns)

    @contextlib.contextmanager
    def _listening(self, file: UnmappedSchedule) -> Iterator[None]:
        """The ends of activations wake us."""
        if not file.is_writable:
            yield  # others' file: they do not wake us, and we look each slice
            return
        file.write(layout.listening_piece(row, True) for row in self._rows)
        try:
            yield
        finally:
            with contextlib.suppress(FailoverError):  # a flag that stays costs a program one call at each end, and no more
                file.write(layout.listening_piece(row, False) for row in self._rows)

    def _lock(self, file: UnmappedSchedule) -> bool:
        """Have the processors of the program, all or none."""
        if not file.is_writable:
            return True
        for place, cpu in enumerate(self._cpus):
            if not locks.take(file.descriptor, CPU_LOCKS + cpu):
                self._unlock(file, self._cpus[:place])
                return False
        return True

    def _unlock(self, file: UnmappedSchedule, cpus: tuple[int, ...]) -> None:
        if file.is_writable:
            for cpu in cpus:
                locks.give(file.descriptor, CPU_LOCKS + cpu)

    def _now_ns(self) -> int:
        return boottime.now_monotonic_ns() - self._skew_ns

    def _first_due(self, file: UnmappedSchedule) -> tuple[str, int]:
        """Name and period of the task that a longer freeze would delay first."""
        file.refresh(self._rows)
        row = min(self._rows, key=lambda one: layout.read_live(file.table, one).due_ns or 1 << 63)
        period_ns = 0
        with contextlib.suppress(FailoverError):  # its own program reports a damaged row
            terms = layout.read_terms(file.table, row)[1]
            period_ns = terms.period_ns if terms.kind is Kind.PERIODIC else 0
        return layout.name_of(file.table, row), period_ns

    # --- Which tasks ---

    def _look(self, pids: tuple[int, ...]) -> None:
        """Find the tasks that these processes run. Those of one component are on one schedule: that of the first is taken."""
        openings = [opening for pid in pids for opening in openings_of(pid)]
        if not openings:
            self._close()
            return
        if self._file is None or self._file.is_gone:
            self._close()
            self._file = _opened(openings[0])
        if self._file is not None:
            self._rows = tuple(sorted({row for opening in openings for row in opening.rows}))
            self._cpus = self._processors(self._file, {opening.pid for opening in openings})

    def _processors(self, file: UnmappedSchedule, pids: set[int]) -> tuple[int, ...]:
        """Those on which its tasks run: as they are declared, else as the kernel has it."""
        declared = 0
        file.refresh(self._rows)
        for row in self._rows:
            with contextlib.suppress(FailoverError):
                declared |= layout.read_terms(file.table, row)[1].cpus
        if declared:
            return tuple(cpu for cpu in range(CPUS_MAX) if declared >> cpu & 1)
        found: set[int] = set()
        for pid in pids:
            with contextlib.suppress(OSError):  # it has ended
                found |= os.sched_getaffinity(pid)
        return tuple(sorted(cpu for cpu in found if cpu < CPUS_MAX))

    def _close(self) -> None:
        file, self._file, self._rows = self._file, None, ()
        if file is not None:
            file.close()


def gate() -> SlackGate:
    """A gate for one component."""
    return SlackGate()


def _seen(file: UnmappedSchedule, row: int) -> TaskSeen:
    """A task between two of its stores; one that cannot be read so is taken for one that runs."""
    for _ in range(READINGS):
        file.refresh((row,))
        before = layout.read_pulse(file.table, row)
        if FENCE is not None:
            FENCE()
        file.refresh((row,))
        if layout.read_pulse(file.table, row) == before:
            state, _, due_ns, ended_ns = before
            return TaskSeen(state == State.RUNNING, ended_ns, None if state in UNKNOWN else due_ns)
    return TaskSeen(True, 0, None)


def _next_to_end(tasks: dict[int, TaskSeen]) -> int:
    """The row whose end to wait for: of one that runs, else of the one that is due first."""
    return min(tasks, key=lambda row: (not tasks[row].is_running, tasks[row].due_ns or 1 << 63))


def _opened(opening: Opening) -> UnmappedSchedule | None:
    """The very file that a process has open, whatever its name leads to by now; None: it cannot be used."""
    try:
        if not stat.S_ISREG(os.stat(opening.path).st_mode):
            return None
        try:
            descriptor, is_writable = os.open(opening.path, os.O_RDWR | os.O_CLOEXEC), True
        except PermissionError:
            descriptor, is_writable = os.open(opening.path, os.O_RDONLY | os.O_CLOEXEC), False
    except OSError:
        return None
    found = os.fstat(descriptor)
    try:
        if found.st_size < layout.FILE_SIZE:
            raise ValueError("it is too short")
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if is_writable else 0)
        area = mmap.mmap(descriptor, layout.FILE_SIZE, mmap.MAP_SHARED, protection)
        return UnmappedSchedule(Path(opening.path), area, is_writable, descriptor, (found.st_dev, found.st_ino))
    except (FailoverError, OSError, ValueError):
        os.close(descriptor)
        return None
