"""A task that agent.toml declares: the agent starts it, it keeps its times, also at the other robot when its own one is lost."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from failover.boards import SCHEDULE_NAME, SCHEDULE_PLACE
from failover.boards.schedule_file import ScheduleFile
from failover.cli.demo.robots import RobotMachine
from failover.core.schedule import layout
from tests.e2e import robots

NAME = "/lab/robot1/ticker"
PROGRAM = """
import failover
count = 0
with failover.scheduled("{name}") as task:
    for tick in task:
        print(count, flush=True)
        count += 1
"""
SETTINGS = """
[tasks."{name}"]
command = [{python}, "-c", {program}]
period_ms = 20
phase_ms = 3
after = ["odometry"]
"""


def settings() -> str:
    program = json.dumps(PROGRAM.format(name=NAME))
    return SETTINGS.format(name=NAME, python=json.dumps(sys.executable), program=program)


def scheduled(robot: RobotMachine) -> dict[str, Any]:
    """The ticker as that robot's `failover ps` shows it; empty where it has none."""
    words = ["ps", "--json", "--board", str(robot.socket.parent / SCHEDULE_PLACE)]
    shown = subprocess.run([sys.executable, "-m", "failover", *words], capture_output=True, text=True, check=False)
    if shown.stderr:
        return {}
    return next((one for one in json.loads(shown.stdout)["tasks"] if one["task"] == NAME), {})


@pytest.mark.root
def test_a_declared_task_begins_by_itself_and_keeps_its_times_over_the_loss_of_its_robot(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, settings()) as both:
        robots.until(lambda: any(robots.component(robot, "ticker").get("pid") for robot in both), "the task to begin")
        first, second = sorted(both, key=lambda robot: robots.component(robot, "ticker").get("role") != "primary")
        robots.until_protected(first, "ticker")
        robots.until(lambda: scheduled(first).get("started", 0) > 5, "its activations")
        told = scheduled(first)
        assert (told["period_ms"], told["phase_ms"], told["missing"]) == (20, 3, ["odometry"])
        assert told["state"] in ("waiting", "running")
        assert scheduled(second)["state"] == "idle"  # declared there, too
        started = scheduled(first)["started"]
        robots.counts_on_elsewhere(first, second, 20, "ticker")
        # Both robots of this test have one file system, and the program looks where it was: at the first one.
        file = ScheduleFile.open(first.socket.parent / SCHEDULE_PLACE / SCHEDULE_NAME)
        row = file.row_of(NAME)
        assert row is not None and file.is_run(row)
        live, course = layout.read_live(file.table, row), layout.read_course(file.table, row)
        assert live.counts.started > started + 20
        assert (course.anchor_ns - file.header.origin_ns) % 20_000_000 == 3_000_000
        file.close()
