"""Two robots and the controller of examples/, in C: its state travels, and its output has no gap and no repetition."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from failover.client.control import Output
from tests.e2e import robots
from tests.include.programs import STRICT, program

pytestmark = pytest.mark.compiler

STEPS = 20_000
"""More than it makes here, at 5 ms each; made beforehand without pause, they say what it must print."""
MORE = 40
"""Steps after each death."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with robots.two_robots(tmp_path) as both:
        yield both


def controller() -> Path:
    return program("controller", "examples/controller.c", flags=("-O2", *STRICT))


def lines(robot: RobotMachine) -> list[str]:
    return robots.output(robot, "controller").decode().splitlines()


def said(robot: RobotMachine) -> list[str]:
    """What it said on its standard error, with its ages left out."""
    collected = bytearray()
    with robot.control() as link:
        for reply in link.stream("logs", name="controller"):
            if isinstance(reply, Output) and reply.stream == 2:
                collected += reply.content
            elif not isinstance(reply, Output):
                break
    return [line.partition(", as of")[0] for line in collected.decode().splitlines()]


def steps_of(sayings: list[str]) -> list[int]:
    return [int(line.split(",")[0].rpartition(" ")[2]) for line in sayings]


def test_a_controller_in_c_outlives_its_robot_and_its_output_is_continuous(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    alone = tmp_path / "alone"
    alone.mkdir()
    command = [str(controller()), "0", str(STEPS)]
    ran = subprocess.run(command, env={"FAILOVER_STATE": str(alone)}, capture_output=True, text=True, check=True, timeout=60)
    expected = ran.stdout.splitlines()

    robots.run(first, "controller", str(controller()), "5", str(STEPS), cwd=str(tmp_path), engine="auto")
    robots.until_protected(first, "controller")
    robots.until(lambda: robots.component(second, "controller").get("engine") == "cooperative", "a checkpoint of its own")
    os.kill(robots.host_pid(first, robots.component(first, "controller")["pid"]), signal.SIGKILL)
    robots.until(lambda: said(first), "robot1 to resume it")
    assert said(first)[0].endswith(", restarted")
    (resumed_after,) = steps_of(said(first))
    robots.until(lambda: len(lines(first)) > resumed_after + MORE, "steps after the kill")

    robots.until_protected(first, "controller")
    known = robots.checkpoints(second, "controller")
    robots.until(lambda: robots.checkpoints(second, "controller") > known + 2, "checkpoints of its second life")
    first.cut_power()
    robots.until(lambda: len(said(second)) == 2, "robot2 to take it over")
    assert said(second)[1].endswith(", taken over")
    resumed_after = steps_of(said(second))[1]
    robots.until(lambda: len(lines(second)) > resumed_after + MORE, "steps after the power cut")

    printed = lines(second)
    assert printed == expected[: len(printed)]
    assert not list(tmp_path.glob("*.segment")), "no file beside a program that has an agent"
