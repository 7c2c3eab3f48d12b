"""Robots come back with empty disks: their components come back to them, from the standby that lives or from the server.

Each time with an unprepared program and one that keeps its state itself; each of the two robots protects the other.
FAILOVER_RETURNS=all plays the returns that CI leaves out as well.
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from tests.e2e import robots, teams
from tests.e2e.teams import TeamStage
from tests.e2e.test_cooperative import COUNTER
from tests.e2e.test_orders import COUNTING

PROGRAMS = ("count", "mission")
"""One by ptrace, at robot1; one that commits, at robot2."""

KEPT = 5
"""Checkpoints at the server before anything dies."""

MORE = 20
"""Numbers that show that it goes on."""

SETTINGS = "patience_s = 1\n"
HOLD = "".join(f'[components."/demo/robot{number}/{name}"]\non_loss = "hold"\n' for number, name in enumerate(PROGRAMS, start=1))


more = pytest.mark.skipif(os.environ.get("FAILOVER_RETURNS") != "all", reason="FAILOVER_RETURNS=all plays it")


def begin(stage: TeamStage, folder: Path) -> None:
    """A protects B while B protects A; whoever keeps their checkpoints has some."""
    program = folder / "counter.py"
    program.write_text(COUNTER)
    first, second = stage.members["robot1"], stage.members["robot2"]
    robots.run(first, "count", *COUNTING)
    robots.run(second, "mission", sys.executable, str(program), cwd=str(folder), engine="cooperative")
    for robot, name in ((first, "count"), (second, "mission")):
        robots.until_protected(robot, name)
        for keeper in (one for one in stage.members.values() if one is not robot):
            robots.until(lambda: robots.checkpoints(keeper, name) >= KEPT, f"checkpoints of {name} at {keeper.name}")  # noqa: B023


def counted(robot: RobotMachine, name: str) -> list[int]:
    return [int(line) for line in robots.output(robot, name).splitlines() if not line.startswith(b"#")]


def expect_to_go_on(robot: RobotMachine, name: str, least: int) -> None:
    """It counts on at this robot from no less than what was kept; its log as a whole has no gap and no repetition."""
    robots.until(lambda: robots.component(robot, name).get("primary") == robot.name, f"{name} to be {robot.name}'s")
    robots.until(lambda: robots.component(robot, name)["state"] in ("running", "degraded"), f"{name} to run at {robot.name}")
    before = len(counted(robot, name))
    robots.until(lambda: len(counted(robot, name)) > max(before, least) + MORE, f"{name} to go on at {robot.name}")
    numbers = counted(robot, name)
    assert numbers == list(range(len(numbers))), name


@pytest.mark.parametrize("back", ["robot1", pytest.param("robot2", marks=more)])
def test_both_are_dead_and_the_server_returns_both_components_to_the_one_that_comes_back_empty(tmp_path: Path, back: str) -> None:
    with teams.acting(tmp_path, settings=SETTINGS) as stage:
        begin(stage, tmp_path)
        kept = {name: len(counted(stage.members["hall"], name)) for name in PROGRAMS}
        stage.cut_power("robot1", "robot2")
        robot = stage.switch_on(back, empty=True)
        for name in PROGRAMS:
            expect_to_go_on(robot, name, kept[name])


@more
def test_both_are_dead_and_the_one_that_comes_back_with_its_disk_goes_on_with_both(tmp_path: Path) -> None:
    with teams.acting(tmp_path, settings=SETTINGS) as stage:
        begin(stage, tmp_path)
        kept = {name: len(counted(stage.members["robot1"], name)) for name in PROGRAMS}
        stage.cut_power("robot1", "robot2")
        robot = stage.switch_on("robot1")
        for name in PROGRAMS:
            expect_to_go_on(robot, name, kept[name])


OFF_S = 8.0


def test_the_time_in_which_a_robot_was_off_is_no_lost_work(tmp_path: Path) -> None:
    with teams.acting(tmp_path, {"robot1": "robot", "robot2": "robot"}, HOLD) as stage:
        begin(stage, tmp_path)
        first = stage.members["robot1"]
        robots.until(lambda: (robots.component(first, "count").get("lag_ms") or 1e9) < 1_000, "a young checkpoint")
        stage.cut_power("robot1")
        cut = time.monotonic()
        robots.until(lambda: time.monotonic() > cut + OFF_S, "the robot to be off for a while")
        first = stage.switch_on("robot1")
        expect_to_go_on(first, "count", 0)
        told = robots.failover(first, "why", "count").stdout
        lost = [float(seconds) for seconds in re.findall(r"it lost ([\d.]+) s of its work", told)]
        assert lost and lost[-1] < OFF_S, told
        assert not [note for note in robots.component(first, "count")["notes"] if " s old" in note and "resumed" in note]


@pytest.mark.parametrize("settings", ["", HOLD], ids=["takeover", "hold"])
def test_a_robot_that_comes_back_empty_gets_its_component_from_the_standby(tmp_path: Path, settings: str) -> None:
    with teams.acting(tmp_path, {"robot1": "robot", "robot2": "robot"}, settings) as stage:
        begin(stage, tmp_path)
        second = stage.members["robot2"]
        kept = len(counted(second, "count"))
        stage.cut_power("robot1")
        if not settings:
            expect_to_go_on(second, "count", kept)
        first, before = stage.switch_on("robot1", empty=True), second.status()["pid"]
        if not settings:
            robots.until_protected(second, "count")
            moved = robots.failover(second, "failback", "count")
            assert moved.returncode == 0, moved
        expect_to_go_on(first, "count", kept)
        expect_to_go_on(second, "mission", 0)
        assert (first.status()["life"], second.status()["pid"]) == (2, before), "it is believed, and nobody had to be restarted"
        assert "its state directory is new" in first.log.read_text()


REFUSES = """[components."/demo/robot1/count".hooks]
before_resume = ["/bin/sh", "-c", 'test "$FAILOVER_ROBOT" != robot2']
must_prepare = true
"""


def test_a_robot_that_comes_back_empty_gets_its_component_from_the_standby_that_could_not_resume_it(tmp_path: Path) -> None:
    with teams.acting(tmp_path, {"robot1": "robot", "robot2": "robot"}, REFUSES) as stage:
        begin(stage, tmp_path)
        second = stage.members["robot2"]
        kept = len(counted(second, "count"))
        stage.cut_power("robot1")
        robots.until(lambda: "robot2 cannot run it: " in " ".join(robots.component(second, "count")["notes"]), "robot2 to try")
        first = stage.switch_on("robot1", empty=True)
        expect_to_go_on(first, "count", kept)
        robots.until_protected(first, "count")
        assert "robot2 gives its checkpoint back to robot1" in robots.failover(second, "why", "count").stdout
