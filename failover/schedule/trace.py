"""What the tasks of a robot did in some seconds, as a file that Perfetto and chrome://tracing open.

A task's row holds its newest activation alone. Looked at four times a period, the rows give every one; what a busy machine let
through is counted and told. Nothing is asked of the tasks.

Source: Trace Event Format of Chrome, which https://ui.perfetto.dev reads: phases X (slice), i (instant), s and f (arrow), M.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Iterable
from typing import Any, Final

from msgspec import Struct, field

from failover.boards import boottime
from failover.boards.schedule_file import ScheduleFile
from failover.core.schedule import layout
from failover.core.schedule.activation import State
from failover.core.schedule.layout import Live
from failover.core.schedule.orders import Rows

PAUSE_MIN_S: Final = 0.0005
PAUSE_MAX_S: Final = 0.02
"""Between two looks."""
_US: Final = 1000


class Activation(Struct):
    """One activation that was seen. Instants: CLOCK_MONOTONIC of the initial time namespace.

    Attributes:
        ended_ns: 0: it has not.
    """

    row: int
    number: int
    due_ns: int
    started_ns: int
    ended_ns: int = 0


class Traced(Struct):
    """What was seen.

    Attributes:
        activations: in the order in which they began, for each task.
        misses: row, instant at which a missed deadline was seen.
        unseen: row → activations that began and ended between two looks.
    """

    rows: Rows
    robot: str
    activations: list[Activation] = field(default_factory=list)
    misses: list[tuple[int, int]] = field(default_factory=list)
    unseen: dict[int, int] = field(default_factory=dict)


def watch(file: ScheduleFile, duration_s: float) -> Traced:
    """Look at the schedule for some time.

    Raises:
        ScheduleError: a row is damaged.
    """
    traced = Traced(file.rows(), file.header.robot)
    declared = {index: row for index, row in traced.rows.items() if row.terms is not None}
    periods = [row.terms.period_ns for row in declared.values() if row.terms is not None and row.terms.period_ns]
    pause_s = min(max(min(periods, default=0) / 4e9, PAUSE_MIN_S), PAUSE_MAX_S)
    looks = {index: _Look(traced, file, index) for index in declared}
    end = time.monotonic() + duration_s
    while time.monotonic() < end and not file.is_gone:
        for look in looks.values():
            look.take()
        time.sleep(pause_s)
    return traced


class _Look:
    """One task, looked at again and again."""

    def __init__(self, traced: Traced, file: ScheduleFile, index: int) -> None:
        self._traced = traced
        self._file = file
        self._index = index
        self._before = layout.read_live(file.table, index)
        self._open: Activation | None = None

    def take(self) -> None:
        """What is new since the last look."""
        live = layout.read_live(self._file.table, self._index)
        if layout.read_live(self._file.table, self._index) != live:
            return  # it is being written: the next look sees it
        began = live.counts.started - self._before.counts.started
        if self._open is not None and (began or live.state is not State.RUNNING):
            is_told = not began or (began == 1 and live.state is State.RUNNING)
            self._open.ended_ns = live.ended_ns if is_told else self._open.started_ns  # else its end was not seen
            self._open = None
        if began > 0:
            self._begin(live, began)
        if live.counts.misses > self._before.counts.misses:
            self._traced.misses.append((self._index, boottime.machine_ns()))
        self._before = live

    def _begin(self, live: Live, began: int) -> None:
        number, due_ns = live.number, live.due_ns
        if live.state is not State.RUNNING:  # it has ended already: the row tells of the next one
            course = layout.read_course(self._file.table, self._index)
            number = course.covering(live.started_ns)
            due_ns = course.due_ns(number)
        activation = Activation(self._index, number, due_ns, live.started_ns)
        self._traced.activations.append(activation)
        if live.state is State.RUNNING:
            self._open = activation
        else:
            activation.ended_ns = live.ended_ns
        if began > 1:
            self._traced.unseen[self._index] = self._traced.unseen.get(self._index, 0) + began - 1


# --- As a file -------------------------------------------------------------------------------------------------------


def as_events(traced: Traced) -> dict[str, Any]:
    """What was seen, in the Trace Event Format: a track for each task, an arrow from a predecessor's end to its successor."""
    events: list[dict[str, Any]] = [{"ph": "M", "name": "process_name", "pid": 1, "args": {"name": f"tasks of {traced.robot}"}}]
    for index, row in traced.rows.items():
        events.append({"ph": "M", "name": "thread_name", "pid": 1, "tid": index + 1, "args": {"name": row.name}})
    last_ns = max((one.ended_ns or one.started_ns for one in traced.activations), default=0)
    for one in traced.activations:
        name = traced.rows[one.row].name
        told = {"number": one.number, "late_us": (one.started_ns - one.due_ns) / _US, "has_ended": bool(one.ended_ns)}
        end_ns = one.ended_ns or last_ns
        slice_ = {"name": name, "cat": "activation", "dur": (end_ns - one.started_ns) / _US, "args": told}
        events.append({"ph": "X", **slice_, **_at(one, one.started_ns)})
    for index, instant_ns in traced.misses:
        events.append({"ph": "i", "s": "t", "name": "deadline missed", "pid": 1, "tid": index + 1, "ts": instant_ns / _US})
    for number, (before, after) in enumerate(_arrows(traced)):
        arrow = {"name": "after", "cat": "precedence", "id": number}
        events.append({"ph": "s", **arrow, **_at(before, max(before.ended_ns - 1, before.started_ns))})
        events.append({"ph": "f", "bp": "e", **arrow, **_at(after, after.started_ns)})
    unseen = {traced.rows[index].name: count for index, count in traced.unseen.items()}
    return {"traceEvents": events, "displayTimeUnit": "ms", "otherData": {"robot": traced.robot, "unseen": unseen}}


def _at(one: Activation, instant_ns: int) -> dict[str, Any]:
    return {"pid": 1, "tid": one.row + 1, "ts": instant_ns / _US}


def _arrows(traced: Traced) -> Iterable[tuple[Activation, Activation]]:
    """Of each activation the predecessors that it followed: the newest one that was due by its instant, if it had ended."""
    of_row: dict[int, list[Activation]] = {}
    for one in traced.activations:
        of_row.setdefault(one.row, []).append(one)
    for one in traced.activations:
        terms = traced.rows[one.row].terms
        for row in terms.after if terms is not None else ():
            seen = of_row.get(row, [])
            place = bisect.bisect_right(seen, one.due_ns, key=lambda other: other.due_ns)
            if place and 0 < seen[place - 1].ended_ns <= one.started_ns:
                yield seen[place - 1], one
