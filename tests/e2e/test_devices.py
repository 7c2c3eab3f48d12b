"""A program resumes at the other robot with that robot's device; a standby reports what it lacks while there is time."""

from __future__ import annotations

import os
import sys
import tty
from pathlib import Path
from typing import Any

import pytest

from tests.checkpoint.resources.devices.test_stateless import DRIVER, told
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

PYTHON = getattr(sys, "_base_executable", sys.executable)


def notes(robot: RobotMachine) -> list[Any]:
    found: list[Any] = robots.component(robot, "driver").get("notes", [])
    return found


CAMERA = """
import os, signal, sys, time, tty
path = sys.argv[1]
line = os.open(path, os.O_RDWR | os.O_NOCTTY)
def on_resume(*_):
    again = os.open(path, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(again)
    os.dup2(again, line)
    os.close(again)
    print("opened anew", flush=True)
signal.signal(signal.SIGHUP, on_resume)
tty.setraw(line)
print("ready", flush=True)
while True:
    try:
        said = os.read(line, 100)
    except OSError:
        said = b""
    if said:
        os.write(line, b"got " + said)
    else:
        time.sleep(0.05)
"""
"""Opens its device anew when it is told to by SIGHUP."""


def logged(robot: RobotMachine) -> list[str]:
    """What no takeover can take back of the driver's output."""
    return robots.failover(robot, "logs", "driver").stdout.splitlines()


def start(robot: RobotMachine, *argv: str, **wanted: Any) -> None:
    """Start a driver, not isolated: its terminals are those of this machine."""
    with robot.control() as link:
        environment = {"PATH": "/usr/bin:/bin"}
        link.ask("run", argv=list(argv), name="driver", env=environment, cwd="/", wait=False, isolate=False, **wanted)


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
            lack = f"the device {there}, open as fd 3, is missing here"
            robots.until(lambda: any(lack in note for note in notes(second)), "robot2 to say what it lacks")
            for order in (("handover", "driver"), ("prefer", "driver", "robot2")):
                refused = robots.failover(first, *order)
                assert refused.returncode == 1 and lack in refused.stderr, refused
            assert "robot2 could not resume it" in robots.failover(first, "status").stdout
            assert f"could not resume here: {lack}" in robots.failover(second, "check").stdout
            assert told(first_line, b"two\n") == b"got two\n", "it was never stopped"
            there.symlink_to(os.ttyname(second_end))
            robots.until_protected(first, "driver")
            robots.until(lambda: robots.failover(first, "handover", "driver").returncode == 0, "a handover")
            assert told(second_line, b"three\n") == b"got three\n"
            robots.until_protected(second, "driver")
            robots.until(lambda: logged(second)[-1:] == ["heard three same 0"], "what it said")
    finally:
        for descriptor in (first_line, first_end, second_line, second_end):
            os.close(descriptor)


def test_a_program_that_opens_its_device_anew_is_told_to_by_the_hook(tmp_path: Path) -> None:
    line, end = os.openpty()
    tty.setraw(line)
    path = os.ttyname(end)
    told_by = ["/bin/sh", "-c", "kill -HUP $FAILOVER_PID"]
    try:
        with robots.two_robots(tmp_path) as (first, second):
            start(first, PYTHON, "-S", "-c", CAMERA, path, devices={path: "hook"}, hooks={"after_resume": told_by})
            robots.until_protected(first, "driver")
            assert told(line, b"one\n") == b"got one\n"
            robots.until(lambda: robots.failover(first, "handover", "driver").returncode == 0, "a handover")
            assert told(line, b"two\n") == b"got two\n"
            robots.until_protected(second, "driver")
            robots.until(lambda: logged(second) == ["ready", "opened anew"], "what it said")
    finally:
        os.close(end)
        os.close(line)
