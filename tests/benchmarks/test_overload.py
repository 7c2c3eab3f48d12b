"""What the benchmark of false alarms counts as a false alarm."""

from __future__ import annotations

import pytest

from benchmarks import overload
from benchmarks.figures import Figure


@pytest.mark.parametrize("what", [overload.TAKEOVERS, overload.TAKEN_FOR_DEAD])
def test_a_robot_that_is_taken_for_dead_is_a_false_alarm_even_if_nobody_takes_over(what: str) -> None:
    quiet = [Figure(one, "any", "", (0.0,)) for one in (overload.TAKEOVERS, overload.TAKEN_FOR_DEAD)]
    long_silence = Figure("longest silence between two beats", "any", "ms", (35.0,))
    assert overload.alarms([*quiet, long_silence]) == 0
    assert overload.alarms([*quiet, long_silence, Figure(what, "another", "", (2.0,))]) == 2
