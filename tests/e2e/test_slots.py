"""Four agents that take turns on one medium: they agree on K, each sends once a round in its order, and a crash makes K = 3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import Pace, RobotMachine
from tests.e2e import bridged, robots
from tests.e2e.bridged import SwitchStage
from tests.e2e.test_takeover import COUNT

pytestmark = pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: run as root")

SETTINGS = f"""
[media.{bridged.CABLE}]
slots = true
"""
PACE = Pace(20, 400)
COUNTER = ("/usr/bin/python3", "-S", "-c", COUNT.format(limit=1_000_000))


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[SwitchStage]:
    with bridged.on_one_switch(tmp_path, 4, SETTINGS, pace=PACE) as four:
        yield four


def slots(robot: RobotMachine) -> dict[str, Any]:
    found = bridged.medium(robot)["slots"]
    assert isinstance(found, dict)
    return found


def agree(members: list[RobotMachine]) -> bool:
    """Whether exactly these share the round, at each of them, and the first of them gives the phase."""
    names = [robot.name for robot in members]
    views = [slots(robot) for robot in members]
    return all(
        (view["own"], view["members"], view["reference"], view["place"]) == ("running", names, names[0], place)
        for place, view in enumerate(views)
    )


def rounds_in_order(stage: SwitchStage, ranks: list[int]) -> bool:
    """Whether the frames that come to the last robot in two seconds are rounds of one frame each of these, in this order."""
    came = [one for one in bridged.frames_at(stage.robots[-1], 2.0) if one.medium and one.to.startswith("239.77.")]
    order = [one.rank for one in came]
    begins = order.index(ranks[0]) if ranks[0] in order else 0
    whole = order[begins : begins + (len(order) - begins) // len(ranks) * len(ranks)]
    return len(whole) > 5 * len(ranks) and whole == ranks * (len(whole) // len(ranks))


def test_all_agree_and_each_sends_once_a_round_in_its_order_and_a_crash_is_shared(stage: SwitchStage) -> None:
    first, second, third, fourth = stage.robots
    robots.until(lambda: agree([first, second, third, fourth]), "K = 4 at all four")
    robots.until(lambda: rounds_in_order(stage, [0, 1, 2]), "rounds of one frame of each other robot, in their order")
    bridged.run_at_last(second, "count", *COUNTER)
    robots.until_protected(second)
    robots.until(lambda: len(robots.numbers(second)) > 20, "some numbers")
    second.cut_power()
    left = [first, third, fourth]
    robots.until(lambda: agree(left), "K = 3 at the three that are left")
    robots.until(lambda: any(robots.component(robot, "count").get("role") == "primary" for robot in left), "a takeover")
    robots.until(lambda: rounds_in_order(stage, [0, 2]), "rounds of those that are left")
