"""Fig. 6: the shape is seen where it is, and missed where it is not; a record comes back; the picture names who is who."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from benchmarks import fig6
from benchmarks.fig6 import JITTER, NOISES_MS, NONE, RA_TDMA, Run, draw, flaws, play, read, table, write
from tests.simulation.mutants import mistaken
from tests.simulation.slots_mutants import no_adaptation

SPAN_S = 120

pytestmark = pytest.mark.timeout(600)  # of a machine that is busy; alone they take seconds


def run(way: str, noise_ms: int, p50_ms: float, p99_ms: float) -> Run:
    return Run(way, noise_ms, 1, 540, 43_200, 43, p50_ms, p50_ms, p99_ms, p99_ms, {int(p50_ms / fig6.BIN_MS): 43_157}, 1.0)


GOOD = [
    *(run(RA_TDMA, noise_ms, 5.0, p99_ms) for noise_ms, p99_ms in zip(NOISES_MS, (5.6, 7.4, 7.8), strict=True)),
    *(run(NONE, noise_ms, 5.4, p99_ms) for noise_ms, p99_ms in zip(NOISES_MS, (16.0, 19.1, 19.7), strict=True)),
]


def test_the_shape_is_that_ra_tdma_is_narrow_and_timers_are_wide() -> None:
    assert flaws(GOOD) == []


@pytest.mark.parametrize(
    ("place", "p99_ms", "told"), [(0, 8.1, "more than 1.6"), (3, 13.0, "less than 2.5"), (1, 8.8, "widens RA-TDMA")]
)
def test_another_shape_is_told(place: int, p99_ms: float, told: str) -> None:
    found = flaws([replace(one, p99_ms=p99_ms) if number == place else one for number, one in enumerate(GOOD)])
    assert any(told in flaw for flaw in found), found


def test_two_minutes_of_a_team_have_the_shape() -> None:
    runs = [play(way, noise_ms, 1, SPAN_S) for way in (RA_TDMA, JITTER) for noise_ms in (0, 5)]
    assert flaws(runs) == []
    quiet, noisy, *timers = runs
    assert quiet.lost == 0
    assert quiet.longest_ms < 8, "they begin at different times"
    assert 50 < quiet.round_ms < noisy.round_ms < 58.3, "the reference stretches its round by two thirds of a slot at most"
    assert all(timer.p99_ms > 2 * quiet.p99_ms for timer in timers)


def test_robots_that_spread_at_the_start_and_do_not_adapt_lose_the_shape() -> None:
    with mistaken(no_adaptation):
        assert flaws([play(RA_TDMA, 0, 2, 3 * SPAN_S)]) != []


def test_a_seed_gives_the_same_figures_twice() -> None:
    one, other = (play(RA_TDMA, 10, 3, 10) for _ in range(2))
    assert replace(one, took_s=0) == replace(other, took_s=0)


def test_a_record_comes_back_and_is_drawn(tmp_path: Path) -> None:
    write(tmp_path / "record.json", GOOD)
    assert read(tmp_path / "record.json") == GOOD
    assert read(tmp_path / "none.json") == []
    draw(GOOD, tmp_path / "plots" / "radio.svg")
    picture = (tmp_path / "plots" / "radio.svg").read_text()
    assert all(word in picture for word in (RA_TDMA, "quiet", "echo each 5 ms"))


def test_the_table_stands_beside_the_reference() -> None:
    lines = table(GOOD).splitlines()
    assert lines[2].startswith("| RA-TDMA | 5.00 / 5.00 / 5.60 / 5.6, 0.10% (round 50.0 ms) |")
    assert "5.03 / 5.39 / 5.57 / 6.05" in lines[3]
