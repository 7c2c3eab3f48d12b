"""The pipeline of examples/ on two robots: its programs resume at the standby in the order of their tasks, at their times."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from failover.schedule.overview import open_schedule, overview
from tests.e2e import robots

EXAMPLE = Path(__file__).parents[2] / "examples" / "pipeline.py"
MAPS = 20
SETTINGS = """
[tasks."/lab/robot1/odometry"]
command = [{python}, {example}, "odometry"]
environment = {{ FAILOVER_BOARD = {board} }}

[tasks."/lab/robot1/mapper"]
command = [{python}, {example}, "mapper"]
environment = {{ FAILOVER_BOARD = {board} }}
after = ["/lab/robot1/odometry"]
"""
ACTS = re.compile(r"/lab/robot1/(\w+): it acts again")


def maps(robot: RobotMachine) -> list[tuple[int, int, int]]:
    """Number, step of the odometry, and age of its pose in ms, of each map."""
    lines = robots.output(robot, "mapper").decode().splitlines()
    return [(int(words[0]), int(words[2]), int(words[6])) for words in (line.split() for line in lines) if len(words) == 9]


@pytest.mark.root
@pytest.mark.timeout(400)  # four starts of numpy, at worst on a machine that gives them little
def test_the_pipeline_resumes_in_the_order_of_its_tasks(tmp_path: Path) -> None:
    place = tmp_path / "board"
    settings = SETTINGS.format(python=json.dumps(sys.executable), example=json.dumps(str(EXAMPLE)), board=json.dumps(str(place)))
    with robots.two_robots(tmp_path, settings) as both:
        for name in ("odometry", "mapper"):
            robots.until(lambda name=name: any(robots.component(robot, name).get("pid") for robot in both), f"{name} to begin")
        first, second = sorted(both, key=lambda robot: robots.component(robot, "mapper").get("role") != "primary")
        for name in ("odometry", "mapper"):
            robots.until_protected(first, name)
        robots.until(lambda: len(maps(first)) > MAPS, "some maps")
        first.cut_power()
        for name in ("odometry", "mapper"):
            robots.until_taken_over(second, name)
        before = len(maps(second))
        robots.until(lambda: len(maps(second)) > before + MAPS, "maps at the standby")
        seen = maps(second)
        assert [number for number, _, _ in seen] == list(range(1, len(seen) + 1)), "each map once"
        acted = ACTS.findall(second.log.read_text())
        assert acted.index("odometry") < acted.index("mapper")
        file = open_schedule(place)
        tasks = {one.task: one for one in overview(file)}
        file.close()
        assert (tasks["odometry"].period_ns, tasks["mapper"].period_ns) == (10_000_000, 50_000_000)
        assert tasks["mapper"].phase_ns == tasks["odometry"].phase_ns == 0
        assert tasks["mapper"].after == ("odometry",)
