"""A program that runs at its times is captured between two activations, by either engine."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from tests.e2e import robots

NAME = "/lab/robot1/steady"
CAPTURES = 12
PROGRAMS = {
    "ptrace": """
import time, failover
with failover.scheduled("{name}") as task:
    for tick in task:
        begun = time.monotonic_ns()
        time.sleep(0.2)
        print(begun, time.monotonic_ns(), flush=True)
""",
    "cooperative": """
import time, failover
count = failover.resume("steady", default={{"n": 0}})
with failover.scheduled("{name}") as task:
    for tick in task:
        begun = time.monotonic_ns()
        count["n"] += 1
        time.sleep(0.1)
        failover.commit()  # there is something new to capture, in the middle of the activation
        time.sleep(0.1)
        print(begun, time.monotonic_ns(), flush=True)
""",
}
SETTINGS = """
[tasks."{name}"]
command = [{python}, "-c", {program}]
period_ms = {period}
overrun = "queue"
"""


def settings(engine: str, period: int) -> str:
    program = json.dumps(PROGRAMS[engine].format(name=NAME))
    return SETTINGS.format(name=NAME, python=json.dumps(sys.executable), program=program, period=period)


def began(robot: RobotMachine, count: int) -> set[int]:
    """When the freezes of so many captures began, by the machine's CLOCK_MONOTONIC."""
    found: set[int] = set()

    def is_enough() -> bool:
        slack = robots.component(robot, "steady").get("slack")
        if slack is not None and not slack["squeezed"]:
            found.add(slack["began_ns"])
        return len(found) >= count

    robots.until(is_enough, f"{count} captures between two activations")
    return found


@pytest.mark.root
@pytest.mark.parametrize("engine", PROGRAMS)
def test_each_capture_falls_between_two_activations(tmp_path: Path, engine: str) -> None:
    with robots.two_robots(tmp_path, settings(engine, 400)) as both:
        robots.until(lambda: any(robots.component(robot, "steady").get("pid") for robot in both), "the task to begin")
        first = min(both, key=lambda robot: robots.component(robot, "steady").get("role") != "primary")
        robots.until_protected(first, "steady")
        frozen = began(first, CAPTURES)
        assert robots.component(first, "steady")["engine"] == engine
        lines = robots.output(first, "steady").split(b"\n")[:-1]
        activations = [(int(begun), int(ended)) for begun, ended in (line.split() for line in lines)]
        wrong = [(instant - begun) / 1e6 for instant in frozen for begun, ended in activations if begun <= instant < ended]
        assert not wrong, f"captures began in the middle of an activation: so many ms after its beginning: {wrong}"
        last = max(ended for _, ended in activations)
        assert sum(instant < last for instant in frozen) >= CAPTURES // 2, "the instants are of one clock"


@pytest.mark.root
def test_a_capture_that_does_not_fit_is_told_with_its_cure(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, settings("ptrace", 200)) as both:  # it is never idle
        robots.until(lambda: any(robots.component(robot, "steady").get("pid") for robot in both), "the task to begin")
        first = min(both, key=lambda robot: robots.component(robot, "steady").get("role") != "primary")
        robots.until(lambda: (robots.component(first, "steady").get("slack") or {}).get("squeezed"), "a capture without a window")
        robots.until(lambda: f"captures delay {NAME} by" in robots.failover(first, "status").stdout, "its sentence in the status")
