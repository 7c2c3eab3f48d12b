"""Heartbeats leave right after those of the first member, sooner and later than their period within stated parts of it."""

from __future__ import annotations

import itertools
import random

import pytest

from failover.core.beat_pace import EARLY_PART, FREE_NS, LATE_PART, URGENT_GAP_NS, BeatPace
from failover.core.types import MS

PERIOD_NS = 50 * MS
EARLIEST_NS, LATEST_NS = PERIOD_NS - PERIOD_NS // EARLY_PART, PERIOD_NS + 2 * (PERIOD_NS // LATE_PART)


def beats(pace: BeatPace, heard: list[int], until_ns: int) -> list[int]:
    """When beats leave, of a robot that hears the first member at these instants and wakes in time."""
    left = []
    for at in [*heard, until_ns]:
        while pace.next_ns < at:
            left.append(pace.next_ns)
            pace.left(pace.next_ns, PERIOD_NS)
        if at < until_ns:
            pace.follow(at, PERIOD_NS)
            pace.tick(at)
        if pace.next_ns <= at < until_ns:
            left.append(at)
            pace.left(at, PERIOD_NS)
    return left


@pytest.mark.parametrize("drift_ppm", [-300, 0, 300])
@pytest.mark.parametrize("begins_ms", [0, 1, 3, 20, 44, 49])
def test_beats_come_together_and_stay_together_though_clocks_drift_and_beats_are_lost(drift_ppm: int, begins_ms: int) -> None:
    dice = random.Random(drift_ppm + begins_ms)
    period_ns = PERIOD_NS + PERIOD_NS * drift_ppm // 1_000_000
    heard = [number * period_ns + dice.randrange(300_000) for number in range(1_000) if dice.random() > 0.01]
    left = beats(BeatPace(0, begins_ms * MS), heard, 1_000 * period_ns)
    settled = [at for at in left if at > FREE_NS + 20 * PERIOD_NS]
    together = len(set(settled) & set(heard))
    assert together > 0.95 * len(settled)
    gaps = [later - earlier for earlier, later in itertools.pairwise(left)]
    assert min(gaps) >= EARLIEST_NS and max(gaps) <= LATEST_NS


@pytest.mark.parametrize("first_period_ms", [1, 7, 20, 49, 51, 73, 1_000])
def test_no_beat_is_sooner_or_later_for_a_first_member_with_another_period(first_period_ms: int) -> None:
    left = beats(BeatPace(0, 0), list(range(0, 20_000 * MS, first_period_ms * MS)), 20_000 * MS)
    gaps = [later - earlier for earlier, later in itertools.pairwise(left)]
    assert min(gaps) >= EARLIEST_NS and max(gaps) <= LATEST_NS


def together(pace: BeatPace, at_ns: int) -> None:
    """The first member beats, and this robot right after it."""
    pace.follow(at_ns, PERIOD_NS)
    pace.tick(at_ns)
    pace.left(at_ns, PERIOD_NS)


def test_a_beat_with_a_change_is_one_more_and_robots_stay_together() -> None:
    pace = BeatPace(0, FREE_NS)
    pace.left(FREE_NS, PERIOD_NS)
    for number in range(1, 20):
        at_ns = FREE_NS + number * PERIOD_NS
        together(pace, at_ns)
        due_ns = pace.next_ns
        pace.press()
        assert pace.next_ns == at_ns + URGENT_GAP_NS
        pace.left(pace.next_ns + number * MS, PERIOD_NS)
        assert pace.next_ns == due_ns, "the regular beat leaves when it would have left anyway"


def test_a_change_of_the_first_member_draws_no_other_from_its_instant() -> None:
    pace = BeatPace(0, FREE_NS)
    together(pace, FREE_NS + PERIOD_NS)
    due_ns = pace.next_ns
    for late_ms in (1, 5, 20, 40):
        pace.follow(FREE_NS + PERIOD_NS + late_ms * MS, PERIOD_NS)
        assert pace.next_ns == due_ns
    together(pace, FREE_NS + 2 * PERIOD_NS)
    assert pace.last_ns == FREE_NS + 2 * PERIOD_NS


@pytest.mark.parametrize("apart_ms", [2, 5, 12, 24])
def test_who_beats_somewhat_before_the_first_member_waits_for_it(apart_ms: int) -> None:
    heard = [apart_ms * MS + number * PERIOD_NS for number in range(200)]
    left = beats(BeatPace(0, 0), heard, 200 * PERIOD_NS)
    free = int(FREE_NS / PERIOD_NS)
    met = next(number for number, at in enumerate(left) if number > free and at in set(heard))
    assert met - free <= apart_ms * MS // (PERIOD_NS // LATE_PART) + 2


def test_a_change_that_waits_is_not_put_off() -> None:
    pace = BeatPace(0, FREE_NS)
    pace.left(FREE_NS, PERIOD_NS)
    pace.press()
    pace.follow(FREE_NS + MS, PERIOD_NS)
    assert pace.next_ns == FREE_NS + URGENT_GAP_NS
