"""The paper fleet: what is measured in virtual time, and what follows from it for larger teams."""

from __future__ import annotations

import pytest

from benchmarks import fleet


def test_values_of_larger_teams_follow_from_frames_that_grow_with_the_team() -> None:
    measured = {size: (size - 1) * (100.0 + 10 * size) for size in (2, 4, 8)}
    assert fleet._by_frames(measured, 64) == pytest.approx(63 * 740)
    assert fleet._by_frames({2: 7.8, 4: 17.2}, 64) == pytest.approx(63 * 17.2 / 3), "never less than nothing"
    rows = fleet._figures("sent", "kB/s", {size: (value, value) for size, value in measured.items()})
    assert {(row.case, row.who) for row in rows if row.who == fleet.LINE} == {
        (f"a team of {size}", fleet.LINE) for size in fleet.COMPUTED
    }


def test_robots_in_virtual_time_send_more_in_a_larger_team_and_take_over() -> None:
    small, large = (fleet._sent_kb(fleet._settled(size, 1)) for size in (2, 4))
    assert 0 < small < large
    (took_ms,) = fleet._takeovers_ms(2, quick=True)
    assert took_ms >= fleet.LEASE_MS
