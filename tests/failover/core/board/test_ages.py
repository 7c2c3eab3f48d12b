"""Ages: the lower bound is never above the true age, the upper one never below it, whatever the two clocks say."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.board import ages

MS = 1_000_000
HOUR_US = 3_600_000_000


def test_the_papers_example_and_the_stretched_one() -> None:
    paper = ages.effective_round_ns(50 * MS, robots=4, epsilon=Fraction(0))
    assert ages.bound_ns(1, 33 * MS, 5 * MS, paper) == 88 * MS
    stretched = ages.effective_round_ns(50 * MS, robots=4)
    assert ages.bound_ns(1, 33 * MS, 5 * MS, stretched) == pytest.approx(96.33 * MS, abs=0.01 * MS)
    assert ages.effective_round_ns(50 * MS, robots=1) == 50 * MS


def test_slow_items_and_lost_frames() -> None:
    assert ages.bound_ns(3, 33 * MS, 5 * MS, 50 * MS) == (33 + 5 + 150) * MS
    assert ages.bound_ns(3, 1000 * MS, 5 * MS, 50 * MS, lost=2) == (150 + 5 + 150 + 300) * MS


def test_stale_is_past_the_bound_and_never_without_one() -> None:
    assert ages.is_stale(101, 100)
    assert not ages.is_stale(100, 100)
    assert not ages.is_stale(ages.UNBOUNDED_NS, 0)


instants = st.integers(0, 10**18)


@given(
    made=instants,
    held=st.integers(0, HOUR_US * 1000),
    transit=st.integers(0, 5_000_000_000),
    slack=st.integers(0, 10_000),
    skew=st.integers(-(10**17), 10**17),
    later=st.integers(0, 10**12),
)
def test_the_true_age_lies_between_the_bounds(made: int, held: int, transit: int, slack: int, skew: int, later: int) -> None:
    """``made`` and all that follows by the sender's clock; the receiver's differs by ``skew``."""
    sent = ages.sent_age_us(made, made + held)
    transit_max_us = -(-transit // 1000) + slack
    stamp, error_us = ages.received(sent, made + held + transit + skew, transit_max_us)
    true = held + transit + later
    age = made + true + skew - stamp
    assert age <= true <= ages.age_max_ns(age, error_us)


def test_an_age_that_is_too_large_to_travel_has_no_upper_bound() -> None:
    sent = ages.sent_age_us(0, 5 * HOUR_US * 1000)
    assert sent == ages.AGE_MAX_US
    _, error_us = ages.received(sent, 10**15, 100)
    assert ages.age_max_ns(0, error_us) == ages.UNBOUNDED_NS


def test_an_unknown_transit_has_no_upper_bound() -> None:
    assert ages.received(1000, 10**15, ages.NO_ERROR_BOUND)[1] == ages.NO_ERROR_BOUND
    assert ages.received(1000, 10**15, 5, ages.NO_ERROR_BOUND)[1] == ages.NO_ERROR_BOUND
