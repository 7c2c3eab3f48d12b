"""A program that resumes from a state is told why: what happened to the copy before it, wherever that state was made."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_cooperative import origins, protected
from tests.e2e.test_hooks import move
from tests.e2e.test_links import TWO
from tests.robot_processes import parts

pytestmark = pytest.mark.root


def reasons(robot: RobotMachine) -> list[str]:
    """What its program was told each time that it went on, here or elsewhere."""
    return [line.split()[-1] for line in origins(robot)]


def told(robot: RobotMachine, *expected: str) -> None:
    robots.until(lambda: reasons(robot) == list(expected), f"it to be told {expected}")


def crash(robot: RobotMachine) -> None:
    pid = robots.until(lambda: robots.component(robot, "count").get("pid"), "its PID")  # it may write before the status knows it
    os.kill(robots.host_pid(robot, pid), signal.SIGSEGV)


def test_a_program_is_told_whether_it_was_handed_over_restarted_or_taken_over(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        protected(first, second, tmp_path)
        move(first, "handover")
        told(second, "handed-over")
        robots.until_protected(second)
        move(second, "failback")
        told(first, "handed-over", "handed-over")
        robots.until_protected(first)
        crash(first)
        told(first, "handed-over", "handed-over", "restarted")
        robots.until_protected(first)
        first.cut_power()
        told(second, "handed-over", "handed-over", "restarted", "taken-over")
        crash(second)
        told(second, "handed-over", "handed-over", "restarted", "taken-over", "restarted")


@pytest.mark.skipif(not robots.has_cable(), reason="robots have no networks of their own here")
def test_a_takeover_that_goes_on_from_this_robots_own_checkpoint_is_called_one(tmp_path: Path) -> None:
    """The other robot ran it for a while, and none of its checkpoints came back."""
    with robots.two_robots(tmp_path, cables=TWO) as (first, second):
        protected(first, second, tmp_path)
        main_loop = parts(first, "main_loop")
        for robot in (first, second):
            robots.cable(robot, "down")  # snapshots travel over this one alone
        for pid in main_loop:
            os.kill(pid, signal.SIGSTOP)
        robots.until_taken_over(second)
        told(second, "taken-over")
        for pid in main_loop:
            os.kill(pid, signal.SIGCONT)
        robots.until(lambda: robots.component(first, "count").get("role") == "standby", "robot1 to know who runs it")
        second.cut_power()
        robots.until(lambda: origins(first), "robot1 to go on with it")
        (line,) = origins(first)
        assert line.split()[1:] == ["robot1", str(robots.component(first, "count")["epoch"]), "taken-over"]
