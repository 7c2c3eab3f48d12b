"""All tasks of a robot as a person looks at them, and orders by hand, judged before they are given."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from failover.boards import SCHEDULE_NAME, boottime, directory
from failover.boards.openings import rows_of
from failover.boards.schedule_file import Order, ScheduleFile
from failover.core.schedule import layout
from failover.core.schedule.activation import STATES, State
from failover.core.schedule.admission import admission, by_deadline
from failover.core.schedule.course import Overrun
from failover.core.schedule.hanging import has_untold_miss, past_deadline_ns
from failover.core.schedule.orders import Outcome, Rows
from failover.core.schedule.terms import KINDS, TASKS_MAX
from failover.errors import ScheduleError

LEARNT_FROM: int = 100
"""Activations after which p99 of the durations counts as a budget."""


class Seen(Struct, frozen=True, kw_only=True):
    """One task.

    Attributes:
        kind: "periodic", "one-shot" or "sporadic". state: "idle" (no process runs it), "waiting", "held", "running" or "done".
        after: its predecessors. missing: those of them that are not declared.
        late_p50_ns, late_p99_ns, took_p50_ns, took_p99_ns: bounds of the buckets of the histograms, powers of two; 0: none yet.
        pid: as the process that runs it sees itself; 0: none.
        blamed: the predecessor for which a deadline was missed last; "".
        misses: one that the task has not told yet, because its activation does not end, is among them.
        past_deadline_ns: how long its activation is past its deadline now; 0: it is not.
    """

    task: str
    kind: str
    state: str
    period_ns: int
    phase_ns: int
    deadline_ns: int
    overrun: str
    mode: str
    priority: int
    after: tuple[str, ...]
    missing: tuple[str, ...]
    pid: int
    started: int
    ended: int
    misses: int
    past_deadline_ns: int
    overruns: int
    skipped: int
    orphaned: int
    blamed: str
    late_p50_ns: int
    late_p99_ns: int
    took_p50_ns: int
    took_p99_ns: int


def open_schedule(place: Path | None = None) -> ScheduleFile:
    """The schedule of this robot, if there is one: looking at it must not make it.

    Raises:
        ScheduleError: there is none.
    """
    there = place or directory.find_schedule()
    try:
        return ScheduleFile.open(there / SCHEDULE_NAME)
    except FileNotFoundError:
        raise ScheduleError(
            f"there is no schedule in {there}: no program of this user runs a task; "
            "a program begins one with failover.scheduled()"
        ) from None


def is_none_there() -> bool:
    """Whether this robot has no schedule: no program has run a task yet."""
    return not (directory.find_schedule() / SCHEDULE_NAME).exists()


def overview(file: ScheduleFile) -> list[Seen]:
    """All tasks, most urgent first.

    Raises:
        ScheduleError: a row is damaged.
    """
    rows = file.rows()
    places = {row.name: index for index, row in rows.items()}
    terms = {row.name: row.terms for row in rows.values() if row.terms is not None}
    return [_seen(file, rows, places[name]) for name in by_deadline(terms)]


def owners(file: ScheduleFile, seen: Sequence[Seen], status: Mapping[str, Any] | None) -> dict[str, str]:
    """Task → the component whose program runs it here: by the locks of its processes, else by its name."""
    found = {}
    here = [one for one in (status or {}).get("components", ()) if one.get("primary") == (status or {}).get("robot")]
    names = {one["name"] for one in here}
    for one in here:
        rows = rows_of(one["pid"], file.identity) if one.get("pid") else set()
        found.update({row.name: one["name"] for index, row in file.rows().items() if index in rows})
    return {**{one.task: one.task for one in seen if one.task in names}, **found}


def _seen(file: ScheduleFile, rows: Rows, index: int) -> Seen:
    row, table = rows[index], file.table
    terms = row.terms
    assert terms is not None
    live, is_run = layout.read_live(table, index), file.is_run(index)
    late = layout.read_histogram(table, index, layout.LATENESS_FIELD)
    took = layout.read_histogram(table, index, layout.DURATION_FIELD)
    after = [rows[one] for one in terms.after if one in rows]
    counts, now_ns = live.counts, boottime.machine_ns()
    return Seen(
        task=row.name,
        kind=KINDS[terms.kind],
        state=STATES[live.state if is_run else State.DONE if live.state is State.DONE else State.IDLE],
        period_ns=terms.period_ns,
        phase_ns=terms.phase_ns,
        deadline_ns=terms.deadline_ns,
        overrun=Overrun(terms.overrun).name.lower(),
        mode=row.modes[terms.mode].name if terms.mode < len(row.modes) else "",
        priority=terms.priority,
        after=tuple(one.name for one in after),
        missing=tuple(one.name for one in after if one.terms is None),
        pid=live.pid if is_run else 0,
        started=counts.started,
        ended=counts.ended,
        misses=counts.misses + (is_run and has_untold_miss(live, terms, now_ns)),
        past_deadline_ns=past_deadline_ns(live, terms, now_ns) if is_run else 0,
        overruns=counts.overruns,
        skipped=counts.skipped,
        orphaned=counts.orphaned,
        blamed=rows[live.blamed].name if live.blamed in rows else "",
        late_p50_ns=layout.percentile_ns(late, 0.5),
        late_p99_ns=layout.percentile_ns(late, 0.99),
        took_p50_ns=layout.percentile_ns(took, 0.5),
        took_p99_ns=layout.percentile_ns(took, 0.99),
    )


def judged(file: ScheduleFile, order: Order, force: bool) -> Callable[[Rows, frozenset[int]], Outcome]:
    """An order that is refused if not all tasks fit then, unless it is forced. What is told besides is among its notes."""

    def give(rows: Rows, held: frozenset[int]) -> Outcome:
        outcome = order(rows, held)
        after = {row.name: row.terms for row in {**rows, **outcome.written}.values() if row.terms is not None}
        loads = admission(after, _learnt(file, rows), os.cpu_count() or 1)
        told = [load.sentence() for load in loads if load.sentence()]
        refused = [load.sentence() for load in loads if not load.fits]
        if refused and not force:
            raise ScheduleError(refused[0])
        return Outcome(outcome.written, (*outcome.notes, *told))

    return give


def _learnt(file: ScheduleFile, rows: Rows) -> Mapping[str, int]:
    """Task → p99 of its durations, of those that have run often enough."""
    found = {}
    for index, row in rows.items():
        took = layout.read_histogram(file.table, index, layout.DURATION_FIELD)
        if index < TASKS_MAX and sum(took) >= LEARNT_FROM:
            found[row.name] = layout.percentile_ns(took, 0.99)
    return found
