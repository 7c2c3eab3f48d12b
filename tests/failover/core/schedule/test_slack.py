"""When a capture may freeze a program that runs at its times."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.schedule.slack import (
    FREEZE_NS_AT_FIRST,
    FREEZE_NS_MIN,
    FREEZES_KEPT,
    FREEZES_TELLING,
    FRESH_NS,
    MARGIN_NS,
    Choice,
    Freezes,
    TaskSeen,
    Wait,
    remark,
    window,
)

MS = 1_000_000
LAG = 2_500 * MS

instants = st.integers(0, 20 * MS)
tasks = st.lists(st.builds(TaskSeen, st.booleans(), instants, st.none() | instants), max_size=4)
freezes = st.integers(FREEZE_NS_MIN, 5 * MS)
lags = st.integers(1, 10 * MS)


@given(tasks, freezes, instants, instants, lags)
def test_a_capture_that_fits_touches_no_activation(
    seen: list[TaskSeen], freeze_ns: int, asked_ns: int, waited_ns: int, lag_ns: int
) -> None:
    now_ns = asked_ns + waited_ns
    if Wait(asked_ns, lag_ns, freeze_ns).choose(seen, now_ns) is Choice.CAPTURE:
        assert not any(task.is_running for task in seen)
        assert all(task.ended_ns <= now_ns for task in seen)
        assert all(task.due_ns is None or now_ns + freeze_ns + MARGIN_NS <= task.due_ns for task in seen)


@given(tasks, freezes, instants, instants, lags)
def test_only_a_capture_that_fits_ends_the_wait_early_and_none_waits_for_ever(
    seen: list[TaskSeen], freeze_ns: int, asked_ns: int, waited_ns: int, lag_ns: int
) -> None:
    choice = Wait(asked_ns, lag_ns, freeze_ns).choose(seen, asked_ns + waited_ns)
    if waited_ns < lag_ns:
        assert choice is not Choice.SQUEEZE
    if waited_ns >= 2 * lag_ns:
        assert choice is not Choice.WAIT
    elif choice is Choice.SQUEEZE:
        now_ns, last_ns = asked_ns + waited_ns, max((task.ended_ns for task in seen), default=0)
        assert not any(task.is_running for task in seen)
        is_overdue = any(task.due_ns is not None and task.due_ns <= now_ns for task in seen)
        assert is_overdue or 0 <= now_ns - last_ns <= FRESH_NS


@given(tasks, freezes, instants, lags)
def test_where_nothing_stands_against_it_a_capture_does_not_wait(
    seen: list[TaskSeen], freeze_ns: int, asked_ns: int, lag_ns: int
) -> None:
    is_free = all(
        not task.is_running
        and task.ended_ns <= asked_ns
        and (task.due_ns is None or asked_ns + freeze_ns + MARGIN_NS <= task.due_ns)
        for task in seen
    )
    assert (Wait(asked_ns, lag_ns, freeze_ns).choose(seen, asked_ns) is Choice.CAPTURE) == is_free


def test_all_tasks_of_a_family_have_ended() -> None:
    wait = Wait(0, LAG, 1 * MS)
    assert wait.choose([TaskSeen(False, 1, 50 * MS), TaskSeen(True, 0, 40 * MS)], 2) is Choice.WAIT
    assert wait.choose([TaskSeen(False, 1, 50 * MS), TaskSeen(False, 3, 40 * MS)], 4) is Choice.CAPTURE
    assert wait.choose([TaskSeen(False, 1, 5 * MS), TaskSeen(False, 3, 40 * MS)], 4 * MS) is Choice.WAIT
    assert window([]) is not None


@pytest.mark.parametrize(
    ("now_ns", "choice"),
    [
        (LAG - 1, Choice.WAIT),
        (LAG + MS, Choice.SQUEEZE),  # right after the end at LAG + MS
        (LAG + MS + FRESH_NS + 1, Choice.WAIT),
        (2 * LAG, Choice.SQUEEZE),
    ],
)
def test_a_capture_that_never_fits_waits_and_then_begins_right_after_an_end(now_ns: int, choice: Choice) -> None:
    wait = Wait(0, LAG, 9 * MS)
    ended_ns = LAG + MS if now_ns > LAG else now_ns
    assert wait.choose([TaskSeen(False, ended_ns, ended_ns + 8 * MS)], now_ns) is choice
    assert wait.slack_ns == 8 * MS - MARGIN_NS


def test_a_task_that_is_held_or_late_costs_a_capture_no_second_lag() -> None:
    """None of its activations ends soon, and no window is near."""
    wait, held = Wait(0, LAG, 1 * MS), TaskSeen(False, 1 * MS, 50 * MS)
    assert wait.choose([held], LAG - 1) is Choice.WAIT
    assert wait.choose([held], LAG) is Choice.SQUEEZE
    assert wait.choose([held, TaskSeen(True, 0, 40 * MS)], LAG) is Choice.WAIT, "the end of the other one is worth waiting for"
    assert wait.choose([TaskSeen(False, 1 * MS, LAG + 1)], LAG) is Choice.WAIT, "it begins soon, and ends"


def test_a_freeze_is_expected_to_take_as_long_as_all_but_the_longest_of_many() -> None:
    freezes = Freezes()
    assert freezes.expected_ns == FREEZE_NS_AT_FIRST
    freezes.note(100_000)
    assert freezes.expected_ns == FREEZE_NS_MIN
    freezes.note(2 * MS)
    assert freezes.expected_ns == 2_400_000
    for _ in range(FREEZES_KEPT - 2):
        freezes.note(MS)
    assert freezes.expected_ns == 1_200_000
    freezes.note(3 * MS)
    assert freezes.expected_ns == 2_400_000  # the one of 3 ms does not count, that of 2 ms does
    for _ in range(FREEZES_KEPT):
        freezes.note(400_000)
    assert freezes.expected_ns == 480_000


def test_one_long_freeze_does_not_spoil_the_captures_after_it() -> None:
    freezes = Freezes()
    freezes.note(80 * MS)
    for _ in range(FREEZES_TELLING - 2):
        freezes.note(MS)
    assert freezes.expected_ns == 96 * MS, "too few to tell"
    freezes.note(MS)
    assert freezes.expected_ns == 1_200_000


def test_the_sentence_tells_state_delay_and_cure() -> None:
    assert remark("mapper", 59_200_000, 400_000, 900_000, 500 * MS) == (
        "slack 0.4 ms, freeze 0.9 ms: captures delay mapper by 0.5 ms every 500 ms; a period of 60 ms would do"
    )
    assert remark("once", 0, 400_000, 900_000, 500 * MS).endswith("captures delay once by 0.5 ms every 500 ms")
    without = remark("busy", 59_200_000, 0, 900_000, 500 * MS)
    assert without.endswith("captures delay busy by 0.9 ms every 500 ms"), "no window was seen: no period is known to help"


def test_the_window_is_from_the_last_end_to_the_first_due() -> None:
    assert window([TaskSeen(True, 0, 5)]) is None
    found = window([TaskSeen(False, 10 * MS, 40 * MS), TaskSeen(False, 12 * MS, 30 * MS)], margin_ns=MS)
    assert found is not None and (found.begin_ns, found.end_ns) == (12 * MS, 29 * MS)
    assert (found.holds(12 * MS, 17 * MS), found.holds(13 * MS, 17 * MS), found.holds(11 * MS, 1)) == (True, False, False)
    forever = window([TaskSeen(False, 1, None)])
    assert forever is not None and forever.holds(5, 10**12)
