"""What a soak test computes from its samples."""

from __future__ import annotations

import math

from benchmarks import soak


def test_growth_is_the_slope_after_the_first_quarter() -> None:
    minutes = [float(minute) for minute in range(61)]
    settled = [100.0 if minute < 15 else 40 + minute / 10 for minute in minutes]
    assert math.isclose(soak.slope_an_hour(minutes, settled), 6.0)
    settled[30] = math.nan  # it could not be looked at just then
    assert math.isclose(soak.slope_an_hour(minutes, settled), 6.0)


def test_what_comes_and_goes_is_no_row_and_what_comes_later_is_aligned() -> None:
    samples = soak.Samples()
    for minute in range(20):
        seen = {"main loop": (20.0, 9.0)} | ({"late": (float(minute), 3.0)} if minute >= 2 else {})
        samples.add(minute, seen | ({"short": (5.0, 5.0)} if minute == 7 else {}))
    figures = {(figure.benchmark, figure.case): figure for figure in soak.figures_of(samples)}
    assert figures[soak.MEMORY, "main loop"].values == (20.0,) * 20
    assert figures[soak.MEMORY, "late"].values == tuple(map(float, range(2, 20)))
    assert math.isclose(figures[soak.MEMORY_GROWTH, "late"].median, 60.0)
    assert abs(figures[soak.DESCRIPTOR_GROWTH, "main loop"].median) < 1e-9
    assert (soak.MEMORY, "short") not in figures
