"""A message over three drivers on two robots whose clocks are five hours apart: ``failover path`` tells where it was."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from failover.core.naming.tree import robot_of
from failover.drivers.here import DIRECTORY, ROBOT, TEAM
from tests.e2e import robots
from tests.e2e.relay import PATHS, ROLES, SHIFTS_S
from tests.e2e.test_owners import Pair

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("relay.py")
NS_OF_MS = 1_000_000
ROUNDED_MS = 1e-4
DRIFTED_MS = 3_600
"""By which two quartzes may drift apart in five hours: bounds for the wrong instant are so much wider to each side."""

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: two robots with addresses of their own"),
    pytest.mark.skipif(not Path("/proc/self/timens_offsets").exists(), reason="needs time namespaces: Linux 5.6 or later"),
]


def true_stamps(hops: list[list[Any]]) -> list[int]:
    """Each instant at which the message came or left, by the one clock that both robots' clocks are set from."""
    return [int(stamp) - SHIFTS_S[robot_of(who)] * 1_000_000_000 for who, *stamps in hops for stamp in stamps]


def told(directory: Path, pair: Pair) -> dict[str, Any]:
    """What comes of one message over all three drivers, each of them under its robot's agent."""
    first, second = pair
    for robot in pair:
        (directory / robot.name).mkdir(mode=0o700)
    words = [str(PROGRAM), str(first.directory.parent), str(directory)]
    environment = {"PYTHONPATH": str(ROOT), ROBOT: "", TEAM: "", DIRECTORY: ""}
    for role in [*ROLES][:3]:
        at = first if ROLES[role] == first.name else second
        robots.run(at, role, sys.executable, *words, role, engine="cooperative", env=environment)
        robots.until_protected(at, role)
    found = directory / "found"
    script = f'PYTHONPATH={ROOT} "$@" >{found}.new && mv {found}.new {found}'
    robots.start_inside(first, "sh", "-c", script, "sh", sys.executable, *words, "ask")
    robots.until(found.exists, "the message to have been at all drivers")
    answer: dict[str, Any] = json.loads(found.read_text())
    return answer


def test_each_part_of_a_way_over_three_drivers_lies_within_its_bound_of_the_truth(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with robots.two_robots(tmp_path) as pair:
        answer = told(tmp_path_factory.mktemp("m"), pair)
    (hops,), (further,) = [answer["hops"]], answer["told"]["further"]
    for (who, *_), path in zip(hops[1:], PATHS, strict=True):
        assert robot_of(who) == robot_of(path.partition("/")[2]) and path.rpartition("/")[2] in who
    assert abs(hops[2][1] - hops[1][2]) > 17_000 * 1_000 * NS_OF_MS, "the clocks of the two robots are apart"
    stamps = true_stamps(hops)
    assert stamps == sorted(stamps), "and by the one clock all happened in order"
    truths = [(later - earlier) / NS_OF_MS for earlier, later in itertools.pairwise(stamps)]
    assert len(further) == len(truths) == 2 * len(hops) - 1
    for part, truth in zip(further, truths, strict=True):
        assert part["at_least_ms"] - ROUNDED_MS <= truth <= part["at_most_ms"] + ROUNDED_MS, (part, truth)
        assert part["at_most_ms"] - part["at_least_ms"] < DRIFTED_MS
        assert abs(part["took_ms"] - truth) <= (part["at_most_ms"] - part["at_least_ms"]) / 2 + ROUNDED_MS
    assert [part["who"] for part in answer["told"]["parts"][::2]] == [who for who, *_ in hops[:2]]
