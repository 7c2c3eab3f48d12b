"""`failover.scheduled`: tasks of several processes on one table, with the real clock. Nothing here depends on
how late a wake-up is.
"""

from __future__ import annotations

import os
import signal
import struct
import time
from pathlib import Path

import pytest

import failover
from failover import ScheduleError
from failover.boards import SCHEDULE_NAME
from failover.boards.directory import make_schedule
from failover.boards.schedule_file import ScheduleFile
from failover.core.schedule import layout, orders
from failover.core.schedule.activation import State
from failover.core.schedule.orders import Change
from failover.core.schedule.terms import Declaration, Terms
from tests.failover.boards.programs import program

MS = 1_000_000

TASK = """
with failover.scheduled({name!r}, {terms}) as task:
    for tick in task:
        say(tick.number, tick.due_ns, tick.missed, time.monotonic_ns())
        {body}
say("over")
"""


def text(name: str, terms: str, body: str = "pass") -> str:
    return TASK.format(name=name, terms=terms, body=body)


def opened(place: Path) -> ScheduleFile:
    """The table as any other process opens it."""
    return ScheduleFile.open(place / SCHEDULE_NAME)


def change(place: Path, *changes: Change) -> None:
    file = opened(place)
    file.give(lambda rows, held: orders.changed(rows, changes, held))
    file.close()


def test_activations_are_due_a_period_apart_and_the_last_user_leaves_nothing(place: Path) -> None:
    with failover.scheduled("a", period=0.005, phase=0.002) as task:
        ticks = [tick for tick, _ in zip(task, range(6), strict=False)]
        assert (place / SCHEDULE_NAME).exists()
        file = opened(place)
        origin = file.header.origin_ns
        assert all(tick.due_ns == origin + 2 * MS + tick.number * 5 * MS for tick in ticks)
        assert all(tick.late_ns >= 0 for tick in ticks)
        live = task.live
        assert (live.state, live.pid, live.counts.started, live.counts.ended) == (State.RUNNING, os.getpid(), 7, 6)
        assert sum(layout.read_histogram(file.table, 0, layout.LATENESS_FIELD)) == 6  # the one under way is told at its end
        assert sum(layout.read_histogram(file.table, 0, layout.DURATION_FIELD)) == 6
        file.close()
    assert not place.exists()


def test_a_task_that_wakes_early_begins_at_its_instant(place: Path) -> None:
    with failover.scheduled("a", period=0.005, early=0.001) as task:
        ticks = [tick for tick, _ in zip(task, range(10), strict=False)]
        assert all(tick.late_ns >= 0 for tick in ticks)
        assert all(tick.due_ns == ticks[0].due_ns + (tick.number - ticks[0].number) * 5 * MS for tick in ticks)
    for early in (-0.001, 0.002, float("nan")):
        with pytest.raises(ScheduleError, match="early = "):
            failover.scheduled("a", period=0.005, early=early)


def test_a_task_learns_how_early_to_wake_within_its_bounds_and_begins_at_no_instant_too_soon(place: Path) -> None:
    with failover.scheduled("a", period=0.005) as task:
        assert task._early_ns == 0, "there is nothing to learn from before its first wake-up"
        ticks = [tick for tick, _ in zip(task, range(20), strict=False)]
        assert all(tick.late_ns >= 0 for tick in ticks)
        assert 0 < task._early_ns <= 5 * MS // 50
    with failover.scheduled("b", period=0.005, early=0) as task:
        assert [tick for tick, _ in zip(task, range(5), strict=False)]
        assert task._early_ns == 0


def test_a_one_shot_task_runs_once_and_its_loop_ends(place: Path) -> None:
    with failover.scheduled("once", once_in=0.001) as task:
        assert [tick.number for tick in task] == [0]
        assert task.live.state is State.DONE
    with failover.scheduled("stay", period=1), failover.scheduled("once", once_in=0) as task:
        assert len(list(task)) == 1


def test_a_sporadic_task_runs_when_it_is_triggered(place: Path) -> None:
    with failover.scheduled("when", distance=0.001) as task:
        for number in (1, 2, 3):
            task.trigger()
            tick = task.wait_activation()
            assert tick is not None and tick.number == number


def test_a_task_runs_after_the_activation_of_another_process_that_covers_its_own(place: Path) -> None:
    slow = text("slow", "period=0.02, overrun='queue'", "time.sleep(0.004); say('end', tick.number, time.monotonic_ns())")
    fast = text("fast", "period=0.01, phase=0.001, deadline=5, overrun='queue', after='slow'")
    with failover.scheduled("keep", period=1), program(slow) as first:
        first.hear()
        with program(fast) as second:
            begun = []
            ended: dict[int, int] = {}
            for _ in range(20):
                _, due, _, began = second.hear().split()
                begun.append((int(due), int(began)))
            origin = opened(place).header.origin_ns
            covering = [(due - origin) // (20 * MS) for due, _ in begun]
            while max(ended, default=-1) < max(covering):
                words = first.hear().split()
                if words[0] == "end":
                    ended[int(words[1])] = int(words[2])
            judged = [(began, ended[number]) for number, (_, began) in zip(covering, begun, strict=True) if number in ended]
            assert judged and all(began >= at for began, at in judged)


def test_a_change_wakes_a_sleeping_task_and_leaves_the_others(place: Path) -> None:
    with failover.scheduled("other", period=0.005) as other, program(text("sleeper", "period=1000")) as sleeper:
        while True:
            file = opened(place)
            row = file.row_of("sleeper")
            if row is not None and layout.read_live(file.table, row).state is State.WAITING:
                break
            file.close()
        before = layout.serial_of(file.table, file.row_of("other") or 0)
        change(place, Change("sleeper", {"period_ns": 10 * MS}))
        assert len(sleeper.hear().split()) == 4
        assert len(sleeper.hear().split()) == 4
        assert layout.serial_of(file.table, file.row_of("other") or 0) == before
        file.close()
        assert other.wait_activation() is not None


def test_a_task_that_is_removed_ends_its_loop(place: Path) -> None:
    with failover.scheduled("keep", period=1), program(text("a", "period=1000")) as running:
        while True:
            file = opened(place)
            row = file.row_of("a")
            if row is not None and layout.read_live(file.table, row).state is State.WAITING:
                break
            file.close()
        file.give(lambda rows, _: orders.removed(rows, ["a"]))
        file.close()
        assert running.hear() == "over"


def test_a_successor_goes_on_at_its_deadline_when_its_predecessor_was_killed_and_with_it_when_it_is_back(place: Path) -> None:
    with failover.scheduled("b", period=0.01, deadline=0.005, after="a") as after:
        with program(text("a", "period=0.01")) as before:
            before.hear()
            assert after.wait_activation() is not None
            os.kill(before.pid, signal.SIGKILL)
            before.process.wait()
        while after.live.counts.orphaned < 3:
            assert after.wait_activation() is not None
        with program(text("a", "period=0.01")) as before:
            first = int(before.hear().split()[0])
            assert first > 0
            orphaned = after.live.counts.orphaned
            for _ in range(5):
                assert after.wait_activation() is not None
            assert after.live.blamed != -1 and after.live.counts.orphaned >= orphaned


def test_one_process_runs_a_task_and_another_is_told_which(place: Path) -> None:
    with failover.scheduled("a", period=1), pytest.raises(ScheduleError, match=f"run by pid {os.getpid()} already"):
        failover.scheduled("a", period=2)
    with failover.scheduled("keep", period=1), failover.scheduled("a", period=1) as task:
        with pytest.raises(ScheduleError):
            failover.scheduled("a", period=2)
        file = opened(place)
        assert layout.read_terms(file.table, task._row)[1].period_ns == 1000 * MS
        file.close()


def test_a_mistake_is_one_sentence_and_leaves_nothing(place: Path) -> None:
    for terms, said in [
        ({"period": -1.0}, "period is -1"),
        ({"period": float("nan")}, "period is nan"),
        ({"period": 0.01, "deadline": 0.02}, "longer than its period"),
        ({"period": 0.01, "overrun": "drop"}, "overrun is 'drop'"),
        ({"period": 0.01, "cpus": (63,)}, "processor 63 is not there"),
        ({"period": 0.01, "after": "a"}, "after itself"),
        ({}, "has no task 'a'; declare it, or give its period"),
    ]:
        with pytest.raises(ScheduleError, match=said):
            failover.scheduled("a", **terms)  # type: ignore[arg-type]
    assert not place.exists()


def test_terms_that_another_program_spoils_are_told_and_the_task_goes_on(place: Path) -> None:
    with failover.scheduled("a", period=0.005) as task, failover.scheduled("b", period=0.005) as other:
        assert task.wait_activation() is not None
        file = opened(place)
        serial = layout.serial_of(file.table, 0)
        bank = layout.row_at(0) + layout.TERMS_FIELDS[(serial + 1) % 2]
        struct.pack_into("<Q", file.table.octets, bank + 8, 2**64 - 1)
        file.table.ints[(layout.row_at(0) + layout.SERIAL_FIELD) // 4] = serial + 1
        assert task.wait_activation() is not None
        assert "damaged: row 0" in task.notes[-1]
        assert other.wait_activation() is not None
        file.close()


def test_a_schedule_that_is_made_anew_is_opened_anew_and_the_task_goes_on(place: Path) -> None:
    with failover.board(), failover.scheduled("a", period=0.005, phase=0.001) as task:
        assert task.wait_activation() is not None
        file = opened(place)
        (place / SCHEDULE_NAME).unlink()
        make_schedule(place, "robot2", layout.ALONE)
        file.words[layout.GENERATION_AT // 8] = layout.GONE
        file.close()
        assert task.wait_activation() is not None
        fresh = opened(place)
        assert (fresh.header.robot, fresh.row_of("a")) == ("robot2", 0)
        fresh.close()


def test_a_forked_child_runs_no_task_and_keeps_no_lock(place: Path) -> None:
    task = failover.scheduled("a", period=0.005)
    child = os.fork()
    if child == 0:
        time.sleep(600)
        os._exit(0)
    try:
        task.close()
        with failover.scheduled("a", period=0.005) as again:
            assert again.wait_activation() is not None
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_task_that_others_declared_takes_its_terms_along_to_another_schedule(place: Path) -> None:
    with failover.scheduled("keep", period=1) as keep:
        file = opened(place)
        declared = Declaration("mapper", Terms(period_ns=5 * MS, phase_ns=2 * MS), ("odometry",))
        file.give(lambda rows, held: orders.added(rows, [declared], held))
        with failover.scheduled("mapper") as mapper:
            assert mapper.wait_activation() is not None
            change(place, Change("mapper", {"period_ns": 10 * MS}))
            assert mapper.wait_activation() is not None
            file.words[layout.GENERATION_AT // 8] = layout.GONE  # as where the program resumes on another robot
            (place / SCHEDULE_NAME).unlink()
            file.close()
            assert mapper.wait_activation() is not None
            assert keep.wait_activation() is not None
            file = opened(place)
            rows = {row.name: row for row in file.rows().values()}
            assert set(rows) == {"mapper", "odometry", "keep"}
            terms = rows["mapper"].terms
            assert terms is not None and (terms.period_ns, terms.phase_ns) == (10 * MS, 2 * MS)
            file.close()
        with pytest.raises(ScheduleError, match="has no task 'other'; declare it, or give its period"):
            failover.scheduled("other")
