"""A program goes on at the other robot with that robot's device; what a standby lacks is said while there is time."""

from __future__ import annotations

import os
import sys
import tty
from pathlib import Path
from typing import Any

import pytest

from tests.checkpoint.test_devices import DRIVER, told
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

PYTHON = getattr(sys, "_base_executable", sys.executable)


def notes(robot: RobotMachine) -> list[Any]:
    found: list[Any] = robots.component(robot, "driver").get("notes", [])
    return found


def start(robot: RobotMachine, *argv: str) -> None:
    """Start a driver, not isolated: its terminals are those of this machine."""
    with robot.control() as link:
        link.ask("run", argv=list(argv), name="driver", env={"PATH": "/usr/bin:/bin"}, cwd="/", wait=False, isolate=False)


def test_a_driver_goes_on_with_the_device_of_the_other_robot(tmp_path: Path) -> None:
    (first_line, first_end), (second_line, second_end) = os.openpty(), os.openpty()
    for ours in (first_line, second_line):
        tty.setraw(ours)
    here, there = os.ttyname(first_end), tmp_path / "there"
    rules = f'[components."/demo/robot1/driver".devices]\n"{here}" = {{ reopen = "{there}" }}\n'
    try:
        with robots.two_robots(tmp_path, rules) as (first, second):
            start(first, PYTHON, "-S", "-c", DRIVER, here, "raw")
            robots.until_protected(first, "driver")
            assert told(first_line, b"one\n") == b"got one\n"
            lack = f"robot2 lacks {there}: the program could not go on here"
            robots.until(lambda: lack in notes(second), "robot2 to say what it lacks")
            there.symlink_to(os.ttyname(second_end))
            robots.until(lambda: lack not in notes(second), "robot2 to see that it is there now")
            robots.until_protected(first, "driver")
            robots.until(lambda: robots.failover(first, "handover", "driver").returncode == 0, "a handover")
            assert told(second_line, b"three\n") == b"got three\n"
            robots.until_protected(second, "driver")
            output = robots.failover(second, "logs", "driver").stdout.splitlines()
            assert output[-1] == "heard three same 0"
    finally:
        for descriptor in (first_line, first_end, second_line, second_end):
            os.close(descriptor)
