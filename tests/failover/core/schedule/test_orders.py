"""Orders: what is added, changed and removed, all of it or nothing; and each mistake with its sentence."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.schedule.admission import admission, by_deadline, priorities, response_ns
from failover.core.schedule.course import Overrun
from failover.core.schedule.orders import Change, Row, added, changed, circle_of, removed
from failover.core.schedule.terms import Declaration, Kind, Mode, Terms, checked, nanoseconds
from failover.errors import ScheduleError

MS = 1_000_000


def task(name: str, period_ms: int = 10, after: tuple[str, ...] = (), **more: Any) -> Declaration:
    modes = more.pop("modes", ())
    return Declaration(name, Terms(period_ns=period_ms * MS, **more), after, modes)


def rows_of(*declarations: Declaration) -> dict[int, Row]:
    return added({}, declarations).written


# --- Declarations ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (task("a", 0), "a period of 0 s"),
        (task("a", 2 * 10**9), "a period of"),
        (task("a", deadline_ns=11 * MS), "longer than its period"),
        (task("a", budget_ns=11 * MS), "budget"),
        (task("a", priority=100), "priority 100"),
        (task("a", cpus=4), "processor 2 is not there"),
        (task("a", after=("a",)), "after itself"),
        (task("a", after=tuple("bcdefghijklmnopqr")), "17 predecessors"),
        (task(""), "a name has"),
        (task("x" * 201), "a name has"),
        (task("a", modes=tuple(Mode(f"m{n}", MS) for n in range(5))), "4 modes"),
        (task("a", modes=(Mode("eco", 0),)), "in mode 'eco'"),
    ],
)
def test_a_declaration_that_cannot_be_says_why_and_changes_nothing(wrong: Declaration, said: str) -> None:
    with pytest.raises(ScheduleError, match=said):
        added(rows_of(task("z")), [task("y"), wrong], cpus_there=3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.1, 1e7, "5", True, None])
def test_what_is_no_time_says_so(value: Any) -> None:
    with pytest.raises(ScheduleError, match="period is"):
        nanoseconds(value, "period")


def test_a_phase_beyond_the_period_and_a_deadline_beyond_it_are_told() -> None:
    told = checked(task("a", phase_ns=23 * MS, deadline_ns=15 * MS, overrun=Overrun.QUEUE))
    assert told.terms.phase_ns == 3 * MS
    assert [note.split()[0] for note in told.notes] == ["phase", "its"]


# --- Orders ----------------------------------------------------------------------------------------------------------


def test_a_predecessor_that_is_not_there_yet_is_told_and_found_when_it_comes() -> None:
    outcome = added({}, [task("mapper", after=("odometry",))])
    assert outcome.notes == ("mapper: odometry is not declared yet; mapper does not wait for it until it is",)
    rows = outcome.written
    assert rows[1] == Row("odometry")
    later = added(rows, [task("odometry")])
    assert (list(later.written), later.notes) == ([1], ())


def test_a_circle_is_refused_and_named_in_full() -> None:
    rows = rows_of(task("a", after=("b",)), task("b", after=("c",)), task("c"))
    with pytest.raises(ScheduleError, match=r"a after b after c after a|b after c after a after b|c after a after b after c"):
        changed(rows, [Change("c", after=("a",))])
    with pytest.raises(ScheduleError, match=r"x after y after x|y after x after y"):
        added(rows, [task("x", after=("y",)), task("y", after=("x",))])


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=40))
def test_a_circle_is_found_exactly_where_there_is_one(arrows: list[tuple[int, int]]) -> None:
    after: dict[int, set[int]] = {index: set() for index in range(10)}
    for one, other in arrows:
        after[one].add(other)
    rows = {index: Row(f"t{index}", Terms(after=tuple(sorted(others)))) for index, others in after.items()}
    left = dict(after)
    while free := [one for one, others in left.items() if not others & set(left)]:
        for one in free:
            del left[one]
    assert bool(circle_of(rows)) == bool(left)


def test_an_order_writes_the_rows_that_it_names_and_no_other() -> None:
    rows = rows_of(task("a"), task("b", after=("a",)), task("c"))
    outcome = changed(rows, [Change("b", {"period_ns": 20 * MS}, at_next=True)])
    assert list(outcome.written) == [1]
    terms = outcome.written[1].terms
    assert terms is not None
    assert (terms.period_ns, terms.deadline_ns, terms.after, terms.at_next) == (20 * MS, 20 * MS, (0,), True)
    assert list(removed(rows, ["a"]).written) == [0]


def test_what_is_not_declared_is_named_with_what_is_near() -> None:
    rows = rows_of(task("mapper"))
    for wrong in (lambda: changed(rows, [Change("maper")]), lambda: removed(rows, ["maper"])):
        with pytest.raises(ScheduleError, match="did you mean 'mapper'"):
            wrong()
    with pytest.raises(ScheduleError, match="no 'colour'"):
        changed(rows, [Change("mapper", {"colour": 3})])


def test_a_quality_mode_brings_its_period_budget_and_processors() -> None:
    modes = (Mode("full", 10 * MS, budget_ns=5 * MS), Mode("eco", 40 * MS, 20 * MS, MS, 2))
    rows = rows_of(task("a", modes=modes, cpus=1))
    terms = changed(rows, [Change("a", mode="eco")]).written[0].terms
    assert terms is not None
    assert (terms.period_ns, terms.deadline_ns, terms.budget_ns, terms.cpus, terms.mode) == (40 * MS, 20 * MS, MS, 2, 1)
    with pytest.raises(ScheduleError, match="it has: full, eco"):
        changed(rows, [Change("a", mode="fast")])


# --- Admission -------------------------------------------------------------------------------------------------------


def simulated_response(tasks: list[tuple[int, int]]) -> int:
    """The longest response of the last task, all due together at 0, a nanosecond at a time."""
    left = [0] * len(tasks)
    begun: list[int] = []
    worst, now, size = 0, 0, math.lcm(*(period for _, period in tasks))
    while now < size or begun:
        for index, (budget, period) in enumerate(tasks):
            if now % period == 0 and now < size:
                left[index] += budget
                if index == len(tasks) - 1:
                    begun.append(now)
        running = next((index for index, work in enumerate(left) if work), None)
        now += 1
        if running is not None:
            left[running] -= 1
            last, of = len(tasks) - 1, tasks[-1][0]
            if running == last and left[last] % of == 0:
                worst = max(worst, now - begun.pop(0))
    return worst


@given(st.lists(st.tuples(st.integers(1, 4), st.sampled_from([2, 3, 4, 6, 8, 12])), min_size=1, max_size=4))
def test_response_times_are_those_of_a_processor(tasks: list[tuple[int, int]]) -> None:
    budget, period = tasks[-1]
    found = response_ns(budget, period, tasks[:-1])
    if sum(budget / period for budget, period in tasks) > 1 + 1e-9:
        assert found is None
    elif found is not None:
        assert found == simulated_response(tasks)


def test_the_shorter_deadline_has_the_higher_priority_unless_one_is_given() -> None:
    terms = {
        "slow": Terms(period_ns=50 * MS, deadline_ns=50 * MS),
        "fast": Terms(period_ns=10 * MS, deadline_ns=10 * MS),
        "urgent": Terms(period_ns=100 * MS, deadline_ns=5 * MS),
        "own": Terms(period_ns=10 * MS, deadline_ns=10 * MS, priority=77),
        "once": Terms(kind=Kind.ONE_SHOT),
    }
    assert by_deadline(terms) == ["urgent", "fast", "own", "slow", "once"]
    assert priorities(terms, 50) == {"urgent": 50, "fast": 49, "slow": 48, "once": 47, "own": 77}
    assert priorities(terms, 2)["once"] == 1


def test_what_does_not_fit_is_told_for_each_set_of_processors() -> None:
    terms = {
        "a": Terms(period_ns=10 * MS, deadline_ns=10 * MS, budget_ns=6 * MS, cpus=1),
        "b": Terms(period_ns=14 * MS, deadline_ns=14 * MS, budget_ns=4 * MS, cpus=1),
        "c": Terms(period_ns=10 * MS, deadline_ns=10 * MS, cpus=2),
        "d": Terms(period_ns=10 * MS, deadline_ns=10 * MS, budget_ns=9 * MS),
    }
    first, second, all_ = sorted(admission(terms, {"c": 12 * MS}, 2), key=lambda load: load.cpus or 9)
    assert (first.responses, first.fits) == ({"a": 6 * MS, "b": 10 * MS}, True)
    assert (second.fits, round(second.share, 2)) == (False, 1.2)
    assert "on processor 1 need 120%" in second.sentence()
    assert (all_.fits, round(all_.share, 2), all_.sentence()) == (True, 0.45, "")
    short = {"deadline_ns": 9 * MS, "cpus": 1}
    terms = {"a": Terms(period_ns=10 * MS, budget_ns=6 * MS, **short), "b": Terms(period_ns=14 * MS, budget_ns=4 * MS, **short)}  # type: ignore[arg-type]
    (told,) = admission(terms, {}, 2)
    assert (told.late, told.fits) == (("b",), False)
    assert "b may take 0.01 s on processor 0, longer than its deadline" in told.sentence()
