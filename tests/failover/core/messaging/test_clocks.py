"""Offsets and the parts of a path lie within what is said, for any clocks and any traffic."""

from __future__ import annotations

import random
from itertools import pairwise
from typing import Any

import pytest

from failover.core.messaging import clocks
from failover.core.messaging.clocks import Bounds, ClockPair, parts
from failover.core.messaging.envelope import Hop

MS = 1_000_000
SECOND = 1_000 * MS
NAMES = ("a", "b", "c", "d")


class Clock:
    """A clock set wrong by up to 5 s that runs up to 100 ppm too fast or slow."""

    def __init__(self, rolled: random.Random) -> None:
        self.wrong_ns = rolled.randrange(-5 * SECOND, 5 * SECOND) + 10 * SECOND
        self.ppm = rolled.choice([-100, 100, rolled.randrange(-100, 101)])

    def at(self, true_ns: int) -> int:
        return self.wrong_ns + true_ns + true_ns * self.ppm // 1_000_000


class Way:
    """Four processes in a row, messages between neighbours all the time, and one that goes all the way now and then."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.clocks = {name: Clock(self.random) for name in NAMES}
        self.pairs = {pair: ClockPair() for pair in pairwise(NAMES)}
        self.least = {
            pair: (self.random.randrange(MS // 10, 2 * MS), self.random.randrange(MS // 10, 20 * MS)) for pair in self.pairs
        }
        self.true_ns = 0

    def chat(self, *, back: bool = True) -> None:
        for (one, other), pair in self.pairs.items():
            least_there, least_back = self.least[one, other]
            left_ns, took_ns = self.true_ns, least_there + self.random.randrange(5 * MS) * self.random.randrange(2)
            pair.forward(self.clocks[one].at(left_ns), self.clocks[other].at(left_ns + took_ns))
            if back:
                took_ns = least_back + self.random.randrange(5 * MS) * self.random.randrange(2)
                pair.backward(self.clocks[other].at(left_ns), self.clocks[one].at(left_ns + took_ns))
        self.true_ns += self.random.randrange(SECOND)

    def offset(self, one: str, other: str, at_ns: int) -> Bounds:
        return self.pairs[one, other].offset(at_ns)

    def travel(self) -> tuple[list[Hop], list[int]]:
        """The stamps of a message, and how long each part truly took."""
        hops, truth = [], []
        now_ns = self.true_ns
        for place, name in enumerate(NAMES):
            waited_ns = self.random.randrange(50 * MS)
            hops.append(Hop(name, self.clocks[name].at(now_ns), self.clocks[name].at(now_ns + waited_ns)))
            truth.append(waited_ns)
            now_ns += waited_ns
            if place + 1 < len(NAMES):
                took_ns = self.least[name, NAMES[place + 1]][0] + self.random.randrange(10 * MS)
                truth.append(took_ns)
                now_ns += took_ns
        return hops, truth


def lies_within(bounds: Bounds, true_ns: int) -> bool:
    return (bounds.low_ns is None or bounds.low_ns - 2 <= true_ns) and (bounds.high_ns is None or true_ns <= bounds.high_ns + 2)


def check(seed: int) -> None:
    way = Way(seed)
    for _ in range(30):
        way.chat()
        hops, truth = way.travel()
        found = parts(hops, way.offset)
        assert [(one.who, one.to) for one in found] == [
            ("a", ""),
            ("a", "b"),
            ("b", ""),
            ("b", "c"),
            ("c", ""),
            ("c", "d"),
            ("d", ""),
        ]
        for part, true_ns in zip(found, truth, strict=True):
            assert lies_within(part.took, true_ns), f"seed {seed}: {part} took {true_ns}"


def check_all() -> None:
    for seed in range(60):
        check(seed)


def test_each_part_of_a_path_over_three_hops_is_right_within_its_bound() -> None:
    check_all()


def test_the_error_is_at_most_half_of_what_the_fastest_messages_took() -> None:
    for seed in range(30):
        way = Way(seed)
        for _ in range(50):
            way.chat()
        for (one, other), pair in way.pairs.items():
            at_ns = way.clocks[one].at(way.true_ns)
            offset = pair.offset(at_ns)
            true_ns = way.clocks[other].at(way.true_ns) - at_ns
            half_ns, middle_ns = offset.half_ns, offset.middle_ns
            assert half_ns is not None and middle_ns is not None and abs(middle_ns - true_ns) <= half_ns
            assert half_ns <= (sum(way.least[one, other]) + 10 * MS) // 2 + 60 * SECOND * 201 // 1_000_000


def test_order_of_events_is_told_right_where_it_is_told() -> None:
    way = Way(3)
    for _ in range(20):
        way.chat()
    hops, _ = way.travel()
    pair, first, second = way.pairs["a", "b"], hops[0], hops[1]
    offset = pair.offset(first.left_ns or 0)
    assert offset.high_ns is not None
    assert second.left_ns is not None and second.left_ns - offset.high_ns >= (first.left_ns or 0) - 20 * MS


def test_messages_of_one_direction_bound_one_side_only() -> None:
    way = Way(4)
    way.chat(back=False)
    hops, truth = way.travel()
    took = parts(hops, way.offset)[1].took
    assert took.high_ns is None and took.half_ns is None and took.middle_ns is None
    assert lies_within(took, truth[1])
    assert ClockPair().offset(0) == Bounds()


def test_a_bound_that_is_old_is_wide_and_a_tighter_one_replaces_it() -> None:
    pair = ClockPair()
    pair.forward(0, 10 * MS)
    pair.forward(SECOND, SECOND + 20 * MS)
    assert pair.offset(SECOND).high_ns == 10 * MS + 201_000
    pair.forward(100 * SECOND, 100 * SECOND + 20 * MS)
    assert pair.offset(100 * SECOND).high_ns == 20 * MS


def no_drift() -> tuple[str, Any]:
    return "_widened", lambda _: 0


def the_newest_counts() -> tuple[str, Any]:
    """Keeps the newest bound as if it were the offset itself: the middle of a slow message."""
    return "_widened", lambda ns: -abs(ns) // 1_000


@pytest.mark.parametrize("mutant", [no_drift, the_newest_counts])
def test_a_mistake_in_the_clocks_is_seen(mutant: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    name, wrong = mutant()
    monkeypatch.setattr(clocks, name, wrong)
    with pytest.raises(AssertionError):
        check_all()
