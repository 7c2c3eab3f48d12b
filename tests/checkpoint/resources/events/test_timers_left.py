"""Time left of a timerfd after some time: the arithmetic alone."""

from __future__ import annotations

import pytest

from checkpoint.resources.events.timerfd import Left, left_after


@pytest.mark.parametrize(
    ("value_ns", "interval_ns", "ticks", "elapsed_ns", "left"),
    [
        (0, 0, 0, 50, Left(0, 0)),
        (0, 0, 1, 50, Left(0, 1)),
        (80, 0, 0, 50, Left(30, 0)),
        (80, 20, 3, 50, Left(30, 3)),
        (50, 0, 0, 50, Left(1, 0)),
        (50, 20, 0, 50, Left(20, 1)),
        (10, 20, 2, 55, Left(15, 5)),
    ],
)
def test_what_is_left_of_a_timer_after_a_while(value_ns: int, interval_ns: int, ticks: int, elapsed_ns: int, left: Left) -> None:
    assert left_after(value_ns, interval_ns, ticks, elapsed_ns) == left
