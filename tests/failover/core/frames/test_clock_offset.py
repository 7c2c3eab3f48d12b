"""Bounds of ages without a common clock, in virtual time: clocks years apart that run wrong, frames that queue and get lost."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from typing import Final

import pytest

from failover.core.frames.clock_offset import MILLION, ClockOffset

MS: Final = 1_000_000
HOUR_NS: Final = 3_600_000 * MS
YEAR_NS: Final = 365 * 24 * HOUR_NS


class Clock:
    """A robot's clock: begun at another instant, and running wrong by so many ppm."""

    def __init__(self, began_ns: int, ppm: int) -> None:
        self._began_ns, self._ppm = began_ns, ppm

    def read(self, true_ns: int) -> int:
        return self._began_ns + true_ns + true_ns * self._ppm // MILLION


Delay = Callable[[random.Random], int]


def quiet(dice: random.Random) -> int:
    return 50_000 + int(dice.expovariate(1 / 20_000))


def queueing(dice: random.Random) -> int:
    """A millisecond, and in one frame of five a queue of tens of them."""
    return MS + int(dice.expovariate(1 / 100_000)) + (int(dice.expovariate(1 / (15 * MS))) if dice.random() < 0.2 else 0)


def one_sided(dice: random.Random) -> int:
    return 20 * MS + int(dice.expovariate(1 / MS))


class Trial:
    """Two robots that send each `round_ns`; what the first one learns of the age of the second one's values."""

    def __init__(self, seed: int, there: Delay, back: Delay, ppm: tuple[int, int], apart_ns: int, round_ns: int = 50 * MS):
        dice = random.Random(seed)
        ours, theirs = Clock(YEAR_NS, ppm[0]), Clock(YEAR_NS + apart_ns, ppm[1])
        self.offset = ClockOffset()
        trips: deque[int] = deque(maxlen=64)
        self.least: list[int] = []
        self.slack: list[int] = []
        self.below = self.below_by_round_trips = 0
        arrivals: list[tuple[int, int, int]] = []
        for number in range(1, HOUR_NS // round_ns):
            left = number * round_ns + dice.randrange(0, 300_000)
            if dice.random() > 0.01:
                arrivals.append((left + there(dice), number, ours.read(left)))
            answer = left + round_ns // 2
            heard = [one for one in arrivals if one[0] <= answer]
            if not heard:
                continue
            came, _, ours_left = heard[-1]
            arrivals = [one for one in arrivals if one[0] >= came]
            left_us, hold_us = theirs.read(answer) // 1000, (theirs.read(answer) - theirs.read(came)) // 1000
            if dice.random() < 0.01:
                continue
            way = back(dice)
            arrived = ours.read(answer + way)
            self.offset.heard(left_us * 1000, arrived)
            self.offset.echoed(ours_left, left_us * 1000, hold_us * 1000, arrived)
            trips.append(arrived - ours_left - hold_us * 1000)
            most = self.offset.most_ns(left_us * 1000, arrived)
            assert most is not None
            true = arrived - ours.read(answer)
            self.below += most < true
            self.slack.append(most - true)
            self.below_by_round_trips += min(trips) < true
        self.between = self.offset.between(arrived)
        self.truth = arrived - theirs.read(answer + way)


WAYS = [(quiet, quiet), (queueing, queueing), (one_sided, quiet), (quiet, one_sided)]
CLOCKS = [((0, 0), 0), ((100, -100), 3 * YEAR_NS), ((-550, 550), -YEAR_NS // 2)]


@pytest.mark.slow
@pytest.mark.parametrize(("there", "back"), WAYS)
@pytest.mark.parametrize(("ppm", "apart_ns"), CLOCKS)
def test_in_an_hour_no_frame_was_longer_on_its_way_than_its_bound(
    there: Delay, back: Delay, ppm: tuple[int, int], apart_ns: int
) -> None:
    trial = Trial(1, there, back, ppm, apart_ns)
    assert trial.below == 0
    assert trial.offset.contradicted == 0
    assert trial.between is not None
    assert trial.between[0] <= trial.truth <= trial.between[1]


def test_the_bound_is_close_where_frames_are_fast() -> None:
    trial = Trial(2, quiet, quiet, (100, -100), YEAR_NS)
    slack = sorted(trial.slack)
    assert slack[len(slack) // 2] < 250_000
    assert slack[-1] < MS


def test_the_least_of_64_round_trips_is_no_bound_for_a_frame_that_queued() -> None:
    assert Trial(3, queueing, queueing, (0, 0), 0).below_by_round_trips > 1000


def test_before_an_echo_nothing_is_known() -> None:
    offset = ClockOffset()
    offset.heard(0, 5)
    assert offset.most_ns(0, 5) is None
    assert offset.between(5) is None


def test_a_clock_that_leaps_is_noticed_and_the_bounds_begin_anew() -> None:
    offset = ClockOffset()
    offset.echoed(0, 10 * MS, MS, 20 * MS)
    for leap_ns in (HOUR_NS, -HOUR_NS, 2 * HOUR_NS):
        left = 100 * MS + leap_ns
        offset.heard(left, 105 * MS)
        offset.echoed(80 * MS, left, 10 * MS, 105 * MS)
        most = offset.most_ns(left, 105 * MS)
        assert most is not None
        assert most >= 5 * MS
    assert offset.contradicted > 0
