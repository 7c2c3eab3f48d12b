"""The robot that ran a program is away for a while, and not dead: its copy stands still, and is ended when it is back."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint import format
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, numbers, parts

pytestmark = pytest.mark.root

EVERYBODY = ("heart", "lanes", "keeper")
MORE = 30
"""Numbers that show that it counts on."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def protected_count(pair: Pair) -> int:
    """A counting program at the first robot, protected by the second; its process here."""
    first, second = pair
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until(lambda: robots.checkpoints(second, "count") >= 3, "checkpoints at robot2")
    return robots.host_pid(first, robots.component(first, "count")["pid"])


def written(robot: RobotMachine) -> bytes:
    """All that its copy wrote, shown to anybody or not."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    return log.read_bytes()


def runs_at(robot: RobotMachine) -> bool:
    shown = robots.component(robot, "count")
    return shown.get("role") == "primary" and shown.get("state") in ("running", "degraded")


def expect_one_history(pair: Pair) -> None:
    """Both robots agree that the second one runs it, and show the same output: no gap, no repetition, nothing of the old copy."""
    first, second = pair
    robots.until(lambda: robots.component(first, "count").get("primary") == "robot2", "robot1 to know who runs it")
    robots.until(lambda: robots.component(second, "count").get("protection") == "protected", "robot1 to protect it")
    before = len(numbers(robots.output(second, "count")))
    robots.until(lambda: len(numbers(robots.output(first, "count"))) > before + MORE, "checkpoints to travel home")
    for robot in pair:
        counted = numbers(robots.output(robot, "count"))
        assert counted == list(range(len(counted))), robot.name


def expect_kept_aside(robot: RobotMachine) -> None:
    """What the old copy had become is there for inspection."""
    (kept,) = (robot.directory / "state" / "lost").glob("*.snapshot")
    assert format.verify(kept).component == "/demo/robot1/count"


def test_a_stopped_agent_and_keeper_leave_a_frozen_program_and_wake_up_stale(pair: Pair) -> None:
    first, second = pair
    program = protected_count(pair)
    stopped = [pid for name in EVERYBODY for pid in parts(first, name)]
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    try:
        robots.until(lambda: runs_at(second), "robot2 to take over")
        standing = written(first)
        before = len(robots.output(second, "count"))
        robots.until(lambda: len(robots.output(second, "count")) > before + MORE, "robot2 to count on")
        assert written(first) == standing, "the old copy stood still before the new one ran"
        assert Path(f"/proc/{program}").exists()
    finally:
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
    robots.until(lambda: not Path(f"/proc/{program}").exists(), "the old copy to be ended")
    expect_one_history(pair)
    expect_kept_aside(first)
