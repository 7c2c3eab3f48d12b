"""The rules of one task and of those that it runs after, in virtual time."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from failover.core.schedule.activation import State, Task, Tick
from failover.core.schedule.course import Course, Overrun
from failover.core.schedule.terms import Kind, Terms
from tests.failover.core.schedule.virtual import MS, ORIGIN, World, mutant


def periodic(period_ms: float, phase_ms: float = 0, **more: object) -> Terms:
    deadline_ms = more.pop("deadline_ms", period_ms)
    return Terms(
        period_ns=round(period_ms * MS), phase_ns=round(phase_ms * MS), deadline_ns=round(deadline_ms * MS), **more  # type: ignore[arg-type,call-overload]
    )  # fmt: skip


# --- Instants --------------------------------------------------------------------------------------------------------


def test_lateness_of_one_activation_moves_no_later_one() -> None:
    dice = random.Random(7)
    world = World({"a": periodic(10, 2)}, late=lambda *_: dice.randrange(3 * MS))
    world.run_until(ORIGIN + 1000 * MS)
    assert [ran.tick.due_ns - ORIGIN for ran in world.of("a")] == [(2 + 10 * n) * MS for n in range(100)]
    assert [ran.started_ns - ran.tick.due_ns for ran in world.of("a")] == [ran.tick.late_ns for ran in world.of("a")]
    assert any(ran.tick.late_ns for ran in world.of("a"))


def test_a_task_that_begins_late_keeps_to_the_numbers_of_its_origin() -> None:
    world = World({"a": periodic(10, 2)}, now_ns=ORIGIN + 1234 * MS)
    world.run_until(ORIGIN + 1250 * MS)
    assert [(ran.tick.number, ran.tick.due_ns - ORIGIN) for ran in world.of("a")] == [(124, 1242 * MS)]


@given(st.integers(-50, 50), st.integers(-(10**6), 10**6), st.integers(1, 1000), st.integers(-(10**6), 10**6))
def test_what_covers_an_instant_is_due_before_it_and_the_next_one_after(
    number: int, anchor: int, period: int, instant: int
) -> None:
    course = Course(number, anchor, period)
    found, first = course.covering(instant), course.first_from(instant)
    if instant >= anchor:
        assert course.due_ns(found) <= instant < course.due_ns(found + 1)
        assert course.due_ns(first - 1) < instant <= course.due_ns(first) or first == number
    else:
        assert (found, first) == (number - 1, number)


# --- Overruns and deadlines ------------------------------------------------------------------------------------------


def long_first(_task: str, number: int) -> int:
    return 35 * MS if number == 0 else MS


@pytest.mark.parametrize(
    ("overrun", "numbers", "skipped"), [("SKIP", [0, 4, 5], 3), ("QUEUE", [0, 3, 4, 5], 2), ("CATCH_UP", [0, 1, 2, 3, 4, 5], 0)]
)
def test_what_falls_due_meanwhile_is_skipped_queued_or_caught_up(overrun: str, numbers: list[int], skipped: int) -> None:
    world = World({"a": periodic(10, overrun=Overrun[overrun])}, takes=long_first)
    world.run_until(ORIGIN + 55 * MS)
    assert [ran.tick.number for ran in world.of("a")] == numbers
    counts = world.task("a").counts
    assert (counts.overruns, counts.skipped) == (3, skipped)
    assert sum(ran.tick.missed for ran in world.of("a")) == skipped
    assert all(ran.tick.due_ns == ORIGIN + ran.tick.number * 10 * MS for ran in world.of("a"))


def test_an_activation_that_ends_late_is_one_miss() -> None:
    world = World({"a": periodic(10, deadline_ms=4)}, takes=lambda _, number: (5 if number % 2 else 4) * MS)
    world.run_until(ORIGIN + 99 * MS)
    assert world.task("a").counts.misses == 5


# --- Predecessors ----------------------------------------------------------------------------------------------------


def test_a_slow_task_waits_for_the_newest_activation_of_a_fast_one_and_a_fast_one_for_the_slow_ones_that_covers_it() -> None:
    terms = {"fast": periodic(10), "slow": periodic(30, after=(0,)), "quick": periodic(10, 5, after=(1,))}
    world = World(terms, takes=lambda name, _: {"fast": 3, "slow": 4, "quick": 1}[name] * MS)
    world.run_until(ORIGIN + 299 * MS)
    assert [ran.started_ns - ORIGIN for ran in world.of("slow")] == [(30 * n + 3) * MS for n in range(10)]
    starts = [(ran.started_ns - ORIGIN) // MS for ran in world.of("quick")]
    assert starts == [30 * n + first for n in range(10) for first in (7, 15, 25)]
    assert [world.task(name).counts.misses for name in terms] == [0, 0, 0]


def test_a_skipped_activation_holds_nobody() -> None:
    terms = {"a": periodic(10), "b": periodic(10, 1, after=(0,), deadline_ms=9)}
    world = World(terms, takes=lambda name, number: (25 if (name, number) == ("a", 0) else 1) * MS)
    world.run_until(ORIGIN + 100 * MS)
    assert [ran.started_ns - ORIGIN for ran in world.of("b")][:3] == [25 * MS, 31 * MS, 41 * MS]


def test_a_predecessor_that_died_releases_its_successors_at_their_deadline_unless_they_are_strict() -> None:
    terms = {"a": periodic(10), "b": periodic(10, after=(0,), deadline_ms=6), "c": periodic(10, after=(0,), strict=True)}
    world = World(terms, takes=lambda *_: MS)
    world.at(ORIGIN + 25 * MS, lambda: world.kill("a"))
    world.run_until(ORIGIN + 59 * MS)
    assert [(ran.started_ns - ORIGIN) // MS for ran in world.of("b")] == [1, 11, 21, 36, 46, 56]
    assert (world.task("b").counts.orphaned, world.task("b").counts.misses, world.task("b").blamed) == (3, 3, 0)
    assert [(ran.started_ns - ORIGIN) // MS for ran in world.of("c")] == [1, 11, 21]
    assert world.task("c").state is State.HELD


def test_a_predecessor_that_is_late_but_runs_is_waited_for_and_blamed() -> None:
    terms = {"a": periodic(40), "b": periodic(40, after=(0,), deadline_ms=6)}
    world = World(terms, takes=lambda name, _: (20 if name == "a" else 1) * MS)
    world.run_until(ORIGIN + 39 * MS)
    counts = world.task("b").counts
    assert [(ran.started_ns - ORIGIN) // MS for ran in world.of("b")] == [20]
    assert (counts.misses, counts.orphaned, world.task("b").blamed) == (1, 0, 0)


PERIODS = (10, 20, 40)


def graph_of_twelve(seed: int) -> dict[str, Terms]:
    """Twelve tasks of three periods; each runs after up to three earlier ones."""
    dice = random.Random(seed)
    terms = {}
    for place in range(12):
        after = tuple(sorted(dice.sample(range(place), min(place, dice.randrange(4)))))
        period = PERIODS[place % 3]
        terms[f"t{place}"] = periodic(period, dice.randrange(period), after=after, deadline_ms=period * 2, overrun=Overrun.QUEUE)
    return terms


def disorders(rounds: int, seed: int = 1) -> list[str]:
    """What ran in a wrong order in so many rounds of the longest period; judged from the log and the arithmetic
    of periods alone.
    """
    dice = random.Random(seed)
    terms = graph_of_twelve(seed)
    world = World(terms, takes=lambda *_: dice.randrange(100_000, 900_000), late=lambda *_: dice.randrange(200_000))
    end_ns = ORIGIN + rounds * 40 * MS
    world.run_until(end_ns + 10 * MS)
    ended: dict[tuple[str, int], int] = {(ran.task, ran.tick.number): ran.ended_ns for ran in world.ran}
    wrong = []
    for ran in world.ran:
        for row in terms[ran.task].after:
            name = world.names[row]
            of = terms[name]
            number = (ran.tick.due_ns - ORIGIN - of.phase_ns) // of.period_ns
            if number >= 0 and ended.get((name, number), end_ns * 2) > ran.started_ns:
                wrong.append(f"{ran.task} {ran.tick.number} before {name} {number}")
    for name, of in terms.items():
        wanted = range((rounds * 40 * MS - of.phase_ns) // of.period_ns)
        wrong += [f"{name} {number} did not run" for number in wanted if (name, number) not in ended]
    return wrong


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_twelve_tasks_of_three_periods_run_in_order_in_ten_thousand_rounds() -> None:
    assert disorders(10_000) == []


@pytest.mark.parametrize("seed", range(20))
def test_other_graphs_run_in_order_too(seed: int) -> None:
    assert disorders(100, seed) == []


# --- Changes ---------------------------------------------------------------------------------------------------------


def test_a_change_leaves_the_activation_under_way_as_it_was() -> None:
    world = World({"a": periodic(100, deadline_ms=50)}, takes=lambda *_: 40 * MS)
    world.at(ORIGIN + 20 * MS, lambda: world.order("a", periodic(60, deadline_ms=30)))
    world.run_until(ORIGIN + 99 * MS)
    assert world.task("a").counts.misses == 0
    assert [ran.tick.due_ns - ORIGIN for ran in world.of("a")] == [0]
    world.run_until(ORIGIN + 199 * MS)
    assert [ran.tick.due_ns - ORIGIN for ran in world.of("a")] == [0, 60 * MS, 120 * MS]
    assert world.task("a").counts.misses == 2


def test_a_new_period_goes_on_from_the_last_instant_at_once_or_with_the_next_activation() -> None:
    for at_next, dues in ((False, [0, 100, 130, 160, 190]), (True, [0, 100, 200, 230, 260])):
        world = World({"a": periodic(100)}, takes=lambda *_: MS)
        new = replace(periodic(30), at_next=at_next)
        world.at(ORIGIN + 120 * MS, lambda world=world, new=new: world.order("a", new))  # type: ignore[misc]
        world.run_until(ORIGIN + 1000 * MS)
        assert [(ran.tick.due_ns - ORIGIN) // MS for ran in world.of("a")][:5] == dues
        assert [ran.tick.number for ran in world.of("a")][:5] == [0, 1, 2, 3, 4]
        assert world.task("a").counts.overruns == 0


def test_a_shorter_period_long_after_the_last_instant_skips_what_would_lie_in_the_past() -> None:
    world = World({"a": periodic(1000)}, takes=lambda *_: MS)
    world.at(ORIGIN + 905 * MS, lambda: world.order("a", periodic(10)))
    world.run_until(ORIGIN + 925 * MS)
    assert [(ran.tick.due_ns - ORIGIN) // MS for ran in world.of("a")] == [0, 910, 920]
    assert (world.task("a").counts.overruns, world.of("a")[1].tick.missed) == (0, 0)


def test_a_changed_phase_counts_from_the_origin() -> None:
    world = World({"a": periodic(100)}, takes=lambda *_: MS)
    world.at(ORIGIN + 120 * MS, lambda: world.order("a", periodic(100, 70)))
    world.run_until(ORIGIN + 300 * MS)
    assert [(ran.tick.due_ns - ORIGIN) // MS for ran in world.of("a")] == [0, 100, 170, 270]


def test_a_changed_phase_at_the_next_activation_leaves_that_one_where_it_is() -> None:
    world = World({"a": periodic(100)}, takes=lambda *_: MS)
    world.at(ORIGIN + 120 * MS, lambda: world.order("a", replace(periodic(100, 70), at_next=True)))
    world.run_until(ORIGIN + 400 * MS)
    assert [(ran.tick.due_ns - ORIGIN) // MS for ran in world.of("a")] == [0, 100, 200, 270, 370]


def test_a_change_of_one_task_moves_no_other() -> None:
    terms = {name: periodic(10, phase) for phase, name in enumerate("abcd")}
    world = World(terms, takes=lambda *_: MS)
    for turn in range(50):
        world.at(ORIGIN + turn * 7 * MS, lambda turn=turn: world.order("a", periodic(5 + turn % 9)))  # type: ignore[misc]
    world.run_until(ORIGIN + 1000 * MS)
    for phase, name in list(enumerate("abcd"))[1:]:
        assert [ran.tick.due_ns for ran in world.of(name)] == [ORIGIN + (phase + 10 * n) * MS for n in range(100)]
        assert world.task(name).counts.misses == 0


# --- Once, and whenever ----------------------------------------------------------------------------------------------


def test_a_one_shot_task_runs_once_and_once_more_when_it_is_ordered() -> None:
    world = World({"a": Terms(kind=Kind.ONE_SHOT, at_ns=ORIGIN + 5 * MS)}, takes=lambda *_: MS)
    world.run_until(ORIGIN + 50 * MS)
    assert world.task("a").state is State.DONE
    world.order("a", Terms(kind=Kind.ONE_SHOT, at_ns=ORIGIN + 60 * MS))
    world.run_until(ORIGIN + 200 * MS)
    assert [(ran.tick.number, ran.started_ns - ORIGIN) for ran in world.of("a")] == [(0, 5 * MS), (1, 60 * MS)]


def test_a_one_shot_task_runs_after_what_covers_its_instant() -> None:
    terms = {
        "a": periodic(10),
        "b": Terms(kind=Kind.ONE_SHOT, at_ns=ORIGIN + 20 * MS, after=(0,)),
        "c": periodic(10, 1, after=(1,)),
    }
    world = World(terms, takes=lambda *_: 3 * MS)
    world.run_until(ORIGIN + 40 * MS)
    assert [ran.started_ns - ORIGIN for ran in world.of("b")] == [23 * MS]
    assert [(ran.started_ns - ORIGIN) // MS for ran in world.of("c")] == [1, 11, 26, 31]


def test_a_sporadic_task_runs_when_triggered_and_keeps_its_distance() -> None:
    world = World({"a": Terms(kind=Kind.SPORADIC, distance_ns=10 * MS)}, takes=lambda *_: MS)
    for instant in (3, 4, 5, 30):
        world.at(ORIGIN + instant * MS, lambda: world.trigger("a"))
    world.run_until(ORIGIN + 99 * MS)
    assert [(ran.started_ns - ORIGIN) // MS for ran in world.of("a")] == [3, 13, 30]
    assert world.task("a").counts.skipped == 0


def test_a_task_that_goes_on_in_another_process_repeats_no_number() -> None:
    world = World({"a": periodic(10)}, takes=lambda *_: MS)
    world.run_until(ORIGIN + 25 * MS)
    before = world.task("a")
    after = Task(before.terms, ORIGIN)
    after.begin(ORIGIN + 25 * MS, before.course, before.settled)
    assert (after.number, after.due_ns) == (3, ORIGIN + 30 * MS)
    for kind, state in ((Kind.ONE_SHOT, State.DONE), (Kind.SPORADIC, State.DONE)):
        again = Task(Terms(kind=kind, at_ns=ORIGIN), ORIGIN)
        again.begin(ORIGIN, Course(4, ORIGIN, 0), 5)
        assert (again.state, again.settled) == (state, 5)
    unfinished = Task(Terms(kind=Kind.ONE_SHOT, at_ns=ORIGIN), ORIGIN)
    unfinished.begin(ORIGIN + 1, Course(4, ORIGIN, 0), 4)
    assert isinstance(unfinished.poll(ORIGIN + 1, None, None), Tick)  # type: ignore[arg-type]


# --- The mistakes that these tests must see --------------------------------------------------------------------------


def in_order() -> None:
    assert disorders(50) == []


@pytest.mark.parametrize(
    ("name", "seen_by"),
    [
        ("lateness_accumulates", test_lateness_of_one_activation_moves_no_later_one),
        ("precedence_by_count", in_order),
        (
            "precedence_by_count",
            test_a_slow_task_waits_for_the_newest_activation_of_a_fast_one_and_a_fast_one_for_the_slow_ones_that_covers_it,
        ),
        ("changes_within_an_activation", test_a_change_leaves_the_activation_under_way_as_it_was),
    ],
)
def test_a_mistake_is_seen(name: str, seen_by: Callable[[], None]) -> None:
    seen_by()
    with mutant(name), pytest.raises(AssertionError):
        seen_by()
