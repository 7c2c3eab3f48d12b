"""A drill moves a component away and back, says what it measured, and leaves a component alone that is not protected."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_orders import COUNTING, counted

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def drill(robot: RobotMachine, *arguments: str, name: str = "count") -> subprocess.CompletedProcess[str]:
    return robots.failover(robot, "drill", name, *arguments)


def test_a_component_moves_away_and_back_with_figures_and_is_left_alone_once_it_is_not_protected(pair: Pair) -> None:
    first, second = pair
    robots.run(first, "count", *COUNTING)
    robots.until_protected(first)
    epoch = robots.component(first, "count")["epoch"]

    asked = drill(second)
    assert asked.returncode == 1 and "is left as it is; --yes" in asked.stderr
    assert "moves from robot1 to robot2" in asked.stderr, "it is said before"
    assert robots.component(first, "count")["epoch"] == epoch, "nothing was done without a yes"

    done = drill(second, "--yes", "--json")
    assert done.returncode == 0, done
    report = json.loads(done.stdout)
    assert (report["runs_at"], report["kept"], report["missed"]) == ("robot1", True, [])
    there, back = report["legs"]
    assert [(leg["source"], leg["target"]) for leg in (there, back)] == [("robot1", "robot2"), ("robot2", "robot1")]
    assert epoch < there["epoch"] < back["epoch"] == robots.component(first, "count")["epoch"]
    for leg in (there, back):
        assert 0 < leg["stood_still_ms"] + leg["doubt_ms"] <= leg["took_ms"] + leg["doubt_ms"], "it stood still inside the order"
        assert leg["output"][0] <= leg["output"][1]
    numbers = counted(first)
    assert numbers == list(range(len(numbers))), "each number once, in order"

    second.cut_power()
    robots.until(lambda: robots.component(first, "count")["protection"] != "protected", "the loss to be seen")
    refused, unknown = drill(first, "--yes"), drill(first, "--yes", name="nothing")
    assert refused.returncode == unknown.returncode == 1
    assert "no drill of /demo/robot1/count: it is NOT PROTECTED: " in refused.stderr
    assert "no component is called 'nothing'; this team protects /demo/robot1/count" in unknown.stderr
