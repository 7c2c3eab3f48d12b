"""A task of this process: `failover.scheduled`."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from msgspec.structs import replace

from failover.boards import SCHEDULE_NAME, boottime, directory, futex
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.boards.schedule_file import ScheduleFile
from failover.core.board.layout import ALONE
from failover.core.schedule import layout, orders
from failover.core.schedule.activation import NO_ROW, Sleep, State, Task, Tick
from failover.core.schedule.course import Overrun
from failover.core.schedule.layout import LATENESS_FIELD, LIVE_FIELD, SERIAL_FIELD, SETTLED_FIELD, Live, View
from failover.core.schedule.terms import Declaration, Kind, Terms, nanoseconds
from failover.errors import ScheduleError, ScheduleGoneError

SLICE_NS: Final = 100_000_000
"""The longest sleep on a predecessor without a look at the own row, which may have changed meanwhile."""
TURNS: Final = 100
"""Of opening a schedule that is made anew each time."""
EARLY_MAX_S: Final = 0.001
"""Longer would take a processor from others for no gain: to fill the caches takes some ten microseconds."""
LEARNT_NS_MAX: Final = 200_000
LEARNT_SHARE: Final = 50
"""A task that learns by itself how early to wake does so no earlier than this, and than this part of its period."""
LEARNT_MARGIN_NS: Final = 20_000
"""More than the wake-up takes: the look at the row after it, in cold caches."""
LEARNT_WEIGHT: Final = 8
"""A wake-up counts for one part in so many of what was learnt."""
FORMER_LIFE_S: Final = 5.0
FORMER_LIFE_POLL_S: Final = 0.01
"""A program that resumes where it has just died: the kernel gives locks back when its last thread has ended."""
PR_SET_TIMERSLACK: Final = 29
"""Source: linux/prctl.h."""
OVERRUNS: Final = {"skip": Overrun.SKIP, "queue": Overrun.QUEUE, "catch_up": Overrun.CATCH_UP}


class Opened:
    """The schedule of this robot, open in this process; a user of the board, so that its directory stays."""

    def __init__(self, place: Path, name: str) -> None:
        self.directory = place.resolve() if place.exists() else place
        self._own: MappedFile | None = None
        if not directory.is_agents_place(self.directory):
            self._own, self._index = directory.enter(self.directory, name)
        self.pid = os.getpid()
        try:
            self.file = self._schedule()
        except BaseException:
            self.close()
            raise
        self.skew_ns = boottime.skew_ns("monotonic")
        self.base = self.file.address(0)

    def _schedule(self) -> ScheduleFile:
        path = self.directory / SCHEDULE_NAME
        for _ in range(TURNS):
            try:
                return ScheduleFile.open(path)
            except FileNotFoundError:
                self._make()
        raise ScheduleError(f"cannot open {path}: others have made and removed it {TURNS} times meanwhile; try again")

    def _make(self) -> None:
        if self._own is None:
            mode, robot, flags = 0o660, directory.this_robot(), 0  # its group is that of the directory
        else:
            mode, robot, flags = 0o600, self._own.header.robot, ALONE
            if not self._own.header.flags & ALONE:
                raise ScheduleError(
                    f"the board {self.directory} has no schedule: its agent is older than this program; update it"
                )
        try:
            directory.make_schedule(self.directory, robot, flags, mode=mode)
        except FileExistsError:
            pass
        except OSError as error:
            raise ScheduleError(
                f"cannot make the schedule in {self.directory}: {error.strerror}; {directory.VARIABLE} names another place"
            ) from error

    def close(self) -> None:
        """Give all locks back; without an agent the last user removes the files."""
        if hasattr(self, "file"):
            self.file.close()
        if self._own is None:
            return
        if self.pid != os.getpid():
            self._own.close()
        elif self._own.descriptor >= 0:
            directory.leave(self.directory, self._own, self._index)

    def drop(self) -> None:
        """Close all without being the last user: the schedule is another one now, or this is a forked child."""
        self.file.close()
        if self._own is not None:
            self._own.close()


class _Holder:
    """What is open now; survives its task until that is collected, or the program ends."""

    opened: Opened | None = None
    idle: Callable[[], None] | None = None

    def leave(self) -> None:
        opened, self.opened = self.opened, None
        if opened is not None:
            if opened.pid == os.getpid() and self.idle is not None:
                self.idle()
            opened.close()


class ScheduledTask:
    """A task that this process runs; made by `scheduled`. One thread uses it.

    Attributes:
        name: of the task.
        notes: what is otherwise than it was asked for.
    """

    def __init__(self, declaration: Declaration, place: Path | None, program: str, early_ns: int | None = 0) -> None:
        """
        Args:
            early_ns: None: as early as its wake-ups have been late.
        """
        self.name = declaration.name
        self._learns = early_ns is None
        self._early_ns = early_ns or 0
        self._early_ns_max = self._asked_ns = 0
        self.notes: tuple[str, ...] = ()
        self._declaration = declaration
        self._known: Declaration | None = None
        """As it was on the schedule last: where this program resumes on another robot it is declared so there."""
        self._place = place
        self._program = program
        self._holder = _Holder()
        self._is_closed = False
        self._published = State.IDLE
        self._finalizer = weakref.finalize(self, self._holder.leave)
        self._open()
        _TASKS.add(self)

    def __enter__(self) -> ScheduledTask:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None) -> None:
        self.close()

    def __iter__(self) -> Iterator[Tick]:
        """The activations; each ends where the body does.

        They come to an end when a one-shot task has run, or the task is removed.
        """
        while (tick := self.wait_activation()) is not None:
            yield tick

    def close(self) -> None:
        """Run the task no more. It stays on the schedule, idle."""
        self._is_closed = True
        self._finalizer()

    # --- The loop ---

    def wait_activation(self) -> Tick | None:
        """End the activation under way, if one is, and sleep until the next begins.

        Returns:
            None where there is no next one: a one-shot task has run, or the task was taken off the schedule.

        Raises:
            ScheduleError: the schedule was lost and cannot be opened anew, or another process has taken the task meanwhile.
        """
        self.end()
        while True:
            opened = self._ensured()
            table, task = opened.file.table, self._task
            serial = table.ints[self._serial]
            if serial != self._adopted and not self._take_order(opened):
                return None
            now_ns = boottime.now_monotonic_ns() - opened.skew_ns
            if self._asked_ns:
                self._learn(now_ns)
            told = task.poll(now_ns, self._look, self._lives)
            if isinstance(told, Tick):
                return self._begin(opened, told)
            if task.state is State.DONE and task.terms.kind is Kind.ONE_SHOT:
                self._publish(opened)
                return None
            self._sleep(opened, told, serial)

    def end(self) -> None:
        """The activation under way has ended; `wait_activation` says it too. Nothing where none is."""
        if self._task.state is not State.RUNNING:
            return
        opened = self._ensured()
        if self._task.state is not State.RUNNING:
            return  # the schedule is another one now: nothing is under way there
        self._task.end(boottime.now_monotonic_ns() - opened.skew_ns)
        layout.count(opened.file.table, self._row, LATENESS_FIELD, self._late_ns)
        layout.count(opened.file.table, self._row, layout.DURATION_FIELD, self._task.ended_ns - self._task.started_ns)
        if self._task.course is not self._course:
            self._write_course(opened)
        self._publish(opened)
        if layout.is_awaited(opened.file.table, self._row):
            futex.wake(opened.base + layout.row_at(self._row) + SETTLED_FIELD)

    def trigger(self) -> None:
        """A sporadic task is due now: what it waits for has happened.

        Another thread may call it, too; the task then begins within 100 ms.
        """
        opened = self._ensured()
        self._task.trigger(boottime.now_monotonic_ns() - opened.skew_ns)
        futex.wake(opened.base + layout.row_at(self._row) + SERIAL_FIELD)

    @property
    def live(self) -> Live:
        """How the task is: its counts, its state."""
        return layout.read_live(self._ensured().file.table, self._row)

    # --- Parts of it ---

    def _begin(self, opened: Opened, tick: Tick) -> Tick:
        """The program waits for this: only what others must know of an activation that is under way is written here."""
        task = self._task
        self._late_ns = tick.late_ns
        if task.course is not self._course or self._published is not State.WAITING or task.terms.after:
            if task.course is not self._course:
                self._write_course(opened)
            self._publish(opened)
        else:
            if FENCE is not None:
                FENCE()
            self._write_begin(task.counts.started, task.started_ns, task.limit_ns)
            if FENCE is not None:
                FENCE()
            self._published = State.RUNNING
        return replace(tick, due_ns=tick.due_ns + opened.skew_ns) if opened.skew_ns else tick

    def _sleep(self, opened: Opened, told: Sleep, serial: int) -> None:
        row = layout.row_at(self._row)
        if told.row == NO_ROW:
            if self._published is not self._task.state:
                self._publish(opened)
            until_ns = told.until_ns if told.until_ns is not None else boottime.now_monotonic_ns() - opened.skew_ns + SLICE_NS
            if self._early_ns and told.until_ns is not None:
                until_ns -= self._early_ns
                if boottime.now_monotonic_ns() - opened.skew_ns >= until_ns:
                    return  # to look again at once: so all that is needed at the instant is in the processor's caches
            self._asked_ns = until_ns if self._learns and told.until_ns is not None else 0
            futex.wait_until(opened.base + row + SERIAL_FIELD, serial, until_ns + opened.skew_ns)
            return
        self._publish(opened)
        table, at = opened.file.table, layout.row_at(told.row) + SETTLED_FIELD
        settled = table.ints[at // 4]
        if FENCE is not None:
            FENCE()
        if self._look(told.row).has_ended(self._task.due_ns):
            return
        latest_ns = boottime.now_monotonic_ns() - opened.skew_ns + SLICE_NS
        until_ns = latest_ns if told.until_ns is None else min(told.until_ns, latest_ns)
        futex.wait_until(opened.base + at, settled, until_ns + opened.skew_ns)

    def _learn(self, now_ns: int) -> None:
        """How late this task was woken: from the instant that it has asked for to its next look at the clock."""
        late_ns, self._asked_ns = now_ns - self._asked_ns, 0
        if late_ns < 0:
            return  # woken by a change of its row
        wanted_ns = min(late_ns + LEARNT_MARGIN_NS, self._early_ns_max)
        self._early_ns += (wanted_ns - self._early_ns) // LEARNT_WEIGHT if self._early_ns else wanted_ns

    def _look(self, row: int) -> Any:
        return layout.read_predecessor(self._present().file.table, row)

    def _lives(self, row: int) -> bool:
        return self._present().file.is_run(row)

    def _present(self) -> Opened:
        """The schedule that is open: in the middle of a look at it, it is not opened anew."""
        assert self._holder.opened is not None
        return self._holder.opened

    def _publish(self, opened: Opened) -> None:
        """Write how the task is; the order of the stores is that of SCHEDULE.md."""
        task = self._task
        live = Live(
            *(task.state, self._pid, task.settled, task.number, task.due_ns, task.started_ns, task.ended_ns, task.limit_ns),
            *(task.counts, task.blamed, self._adopted),
        )
        if FENCE is not None:
            FENCE()
        layout.write_live(opened.file.table, self._row, live)
        if FENCE is not None:
            FENCE()
        self._published = task.state

    def _write_course(self, opened: Opened) -> None:
        self._course = self._task.course
        layout.write_course(opened.file.table, self._row, self._course)

    def _take_order(self, opened: Opened) -> bool:
        """Adopt the newest order; False if the task is not on the schedule any more."""
        table = opened.file.table
        if layout.name_of(table, self._row) != self.name or not layout.is_declared(table, self._row):
            self._task.leave()
            self._publish(opened)
            return False
        try:
            self._adopted, terms = layout.read_terms(table, self._row)
        except ScheduleError as error:
            self.notes = (*self.notes, f"{error}; {self.name} goes on as before")
            self._adopted = table.ints[self._serial]
            return True
        self._remember(table, terms)
        self._task.order(terms, boottime.now_monotonic_ns() - opened.skew_ns)
        if self._task.course is not self._course:
            self._write_course(opened)
        self._be_as(terms)
        self._publish(opened)
        return True

    # --- The table ---

    def _ensured(self) -> Opened:
        """The open schedule; opened anew if it was made anew: the agent's, or that of the robot where this program resumed."""
        opened = self._holder.opened
        if opened is None or opened.file.is_gone or opened.pid != os.getpid():
            if self._is_closed:
                raise ScheduleError(f"task {self.name!r} is closed; begin it again with failover.scheduled()")
            if opened is not None:
                opened.drop()
                self._holder.opened = None
            self._open()
            opened = self._holder.opened
            assert opened is not None
        return opened

    def _open(self) -> None:
        """Find or add the task's row, and become the process that runs it."""
        for _ in range(TURNS):
            opened = Opened(self._place or directory.find_schedule(), self._program)
            try:
                self._holder.opened = opened
                self._attach(opened)
                return
            except ScheduleGoneError:
                self._holder.opened = None
                opened.close()
            except BaseException:
                self._holder.opened = None
                opened.close()
                raise
        raise ScheduleError(f"the schedule was made anew {TURNS} times while task {self.name!r} began")

    def _attach(self, opened: Opened) -> None:
        file = opened.file
        if not file.is_writable:
            raise ScheduleError(f"cannot run task {self.name!r}: {file.path} may only be read by uid {os.geteuid()}")
        row = file.row_of(self.name)
        if row is not None and not self._take(file, row):
            raise self._taken(file, row)
        if row is None or self._declaration.terms != Terms():
            declared = self._known or self._declaration
            if declared.terms == Terms():
                raise ScheduleError(f"the schedule {file.path} has no task {self.name!r}; declare it, or give its period")
            outcome = file.give(
                lambda rows, held: orders.added(rows, [declared], held, _cpus_there()), -1 if row is None else row
            )
            self.notes = outcome.notes
            row = file.row_of(self.name)
            if row is None:
                raise ScheduleGoneError(f"task {self.name!r} was removed while it began")
            if not file.take_row(row):
                raise self._taken(file, row)
        self._row = row
        self._pid = os.getpid()
        self._serial = (layout.row_at(row) + SERIAL_FIELD) // 4
        self._write_begin = layout.Begin(file.table, row).write
        self._late_ns = 0
        self._adopted, terms = layout.read_terms(file.table, row)
        self._remember(file.table, terms)
        self._begin_task(opened, terms)
        self._be_as(terms)
        self._holder.idle = lambda: _set_idle(file, row)

    def _take(self, file: ScheduleFile, row: int) -> bool:
        """Become the process that runs it. One that resumes waits for an earlier life of itself to end."""
        end = time.monotonic() + (FORMER_LIFE_S if self._known is not None else 0)
        while not file.take_row(row):
            if time.monotonic() >= end:
                return False
            time.sleep(FORMER_LIFE_POLL_S)
        return True

    def _remember(self, table: View, terms: Terms) -> None:
        names = tuple(layout.name_of(table, row) for row in terms.after)
        self._known = Declaration(self.name, replace(terms, after=()), names, layout.read_modes(table, self._row))

    def _taken(self, file: ScheduleFile, row: int) -> ScheduleError:
        pid = layout.read_live(file.table, row).pid
        return ScheduleError(f"task {self.name!r} is run by pid {pid} already; end that one, or choose another name")

    def _begin_task(self, opened: Opened, terms: Terms) -> None:
        """Go on where an earlier process has left, if its course is that of the terms."""
        table = opened.file.table
        live, left = layout.read_live(table, self._row), layout.read_course(table, self._row)
        self._task = task = Task(terms, opened.file.header.origin_ns, live.counts)
        is_left = live.adopted == self._adopted and left.period_ns == terms.period_ns
        now_ns = boottime.now_monotonic_ns() - opened.skew_ns
        task.begin(now_ns, left if is_left else None, live.settled)
        self._published = State.IDLE
        self._write_course(opened)
        self._publish(opened)

    def _be_as(self, terms: Terms) -> None:
        """Processors, priority and timer slack of this thread, as far as this user may set them."""
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
        self._early_ns_max = min(LEARNT_NS_MAX, terms.period_ns // LEARNT_SHARE)
        self._early_ns = min(self._early_ns, self._early_ns_max) if self._learns else self._early_ns
        if terms.cpus:
            places = {place for place in range(terms.cpus.bit_length()) if terms.cpus >> place & 1}
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, places)
        if terms.priority:
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(terms.priority))
            except OSError as error:
                self.notes = (
                    *self.notes,
                    f"{self.name} runs at normal priority: SCHED_FIFO {terms.priority} is refused ({error.strerror}); "
                    "grant CAP_SYS_NICE, or LimitRTPRIO of its service",
                )

    def forget_after_fork(self) -> None:
        """In the child: the parent runs the task."""
        opened = self._holder.opened
        if opened is not None:
            opened.drop()


def _set_idle(file: ScheduleFile, row: int) -> None:
    if not file.is_gone:
        file.table.ints[(layout.row_at(row) + LIVE_FIELD) // 4] = State.IDLE


def _cpus_there() -> int:
    return sum(1 << place for place in os.sched_getaffinity(0)) | (1 << (os.cpu_count() or 1)) - 1


_TASKS: weakref.WeakSet[ScheduledTask] = weakref.WeakSet()


def _after_fork() -> None:
    for task in list(_TASKS):
        task.forget_after_fork()


os.register_at_fork(after_in_child=_after_fork)


def scheduled(
    name: str,
    *,
    period: float = 0,
    phase: float = 0,
    deadline: float = 0,
    after: str | tuple[str, ...] = (),
    overrun: str = "skip",
    once_in: float | None = None,
    distance: float | None = None,
    budget: float = 0,
    cpus: tuple[int, ...] = (),
    priority: int = 0,
    strict: bool = False,
    early: float | None = None,
    place: str | os.PathLike[str] | None = None,
) -> ScheduledTask:
    """Run a task of this robot's schedule in this process.

        with failover.scheduled("mapper", period=0.05, phase=0.01, deadline=0.04, after="odometry") as mapper:
            for tick in mapper:
                ...  # an activation; it ends where the body does

    Without ``period``, ``once_in`` and ``distance`` the task is one that is declared already.

    Args:
        name: of the task, on this robot.
        period: seconds from one activation to the next.
        phase: seconds from the schedule's origin to the first one; tasks with the same period keep this distance.
        deadline: seconds from the instant at which an activation is due to that at which it is to have ended; 0: the period.
        after: tasks whose activation that covers the instant must have ended first. They may have other periods.
        overrun: what becomes of activations that fall due while one is under way: "skip", "queue" or "catch_up".
        once_in: seconds from now: the task runs once.
        distance: seconds; the task runs whenever `ScheduledTask.trigger` is called, not more often than that.
        budget: seconds of a processor that an activation may take; for the judgement whether all fit.
        cpus: processors on which it may run; none: all.
        priority: of SCHED_FIFO; 0: this process's.
        strict: a predecessor that does not run holds this task for ever, not until its deadline.
        early: seconds, up to 0.001: wake so long before the instant, and be busy until it has come. Then the activation begins
            microseconds late instead of some hundred, for so much of a processor. None: as long as its own wake-ups have been
            late, and 0.02 ms; at most 0.2 ms, and a fiftieth of the period. 0: wake at the instant.
        place: the directory of the board; None: as `failover.board`.

    Raises:
        ScheduleError: the task cannot be; says why, and what to do. Nothing changed.
    """
    kind, at_ns = Kind.PERIODIC, 0
    if once_in is not None:
        kind, at_ns = Kind.ONE_SHOT, boottime.machine_ns() + nanoseconds(once_in, "once_in")
    elif distance is not None:
        kind = Kind.SPORADIC
    if early is not None and not 0 <= early <= EARLY_MAX_S:
        raise ScheduleError(
            f"early = {early!r} s: a task wakes at most {EARLY_MAX_S} s before its instant, and is busy meanwhile"
        )
    if overrun not in OVERRUNS:
        raise ScheduleError(f"overrun is {overrun!r}: choose {', '.join(OVERRUNS)}")
    terms = Terms(
        kind=kind,
        period_ns=nanoseconds(period, "period"),
        phase_ns=nanoseconds(phase, "phase"),
        deadline_ns=nanoseconds(deadline, "deadline"),
        at_ns=at_ns,
        distance_ns=nanoseconds(distance or 0, "distance"),
        budget_ns=nanoseconds(budget, "budget"),
        cpus=sum(1 << _processor(one) for one in set(cpus)),
        priority=priority,
        overrun=OVERRUNS[overrun],
        strict=strict,
    )
    named = (after,) if isinstance(after, str) else tuple(after)
    program = os.path.basename(sys.argv[0] if sys.argv else "") or "python"
    where = None if place is None else Path(place)
    early_ns = None if early is None else nanoseconds(early, "early")
    return ScheduledTask(Declaration(name, terms, named), where, program, early_ns)


def _processor(number: int) -> int:
    if not isinstance(number, int) or not 0 <= number < 64:
        raise ScheduleError(f"cpus names processor {number!r}: give numbers from 0 on, as /proc/cpuinfo has them")
    return number
