"""The board as rows of text."""

from __future__ import annotations

import pytest

from failover.cli.output.board_tree import bar, rate, shortened, span


@pytest.mark.parametrize(
    ("age_ns", "bound_ns", "said"),
    [
        (0, 100, "[..........] 0.00 ms"),
        (12_000_000, 120_000_000, "[#.........] 120 ms"),
        (12_000_001, 120_000_000, "[##........] 120 ms"),
        (120_000_000, 120_000_000, "[##########] 120 ms"),
        (10**15, 120_000_000, "[##########] 120 ms"),
        (None, 120_000_000, "[##########] 120 ms"),
        (5, 0, ""),
    ],
)
def test_a_bar_shows_how_much_of_its_bound_an_age_has_used(age_ns: int | None, bound_ns: int, said: str) -> None:
    assert bar(age_ns, bound_ns) == said


def test_spans_and_rates_are_told_in_the_unit_that_fits() -> None:
    assert [span(value) for value in (None, 310_000, 98_000_000, 4_200_000_000)] == ["–", "0.31 ms", "98 ms", "4.2 s"]
    assert [rate(value) for value in (None, 0, 0.5, 20.4)] == ["", "0/s", "0.5/s", "20/s"]


def test_a_long_value_is_shortened() -> None:
    assert len(shortened("x" * 100)) == 60
