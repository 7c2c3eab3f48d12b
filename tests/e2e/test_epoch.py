"""The fencing token reaches an unprepared program: each copy knows the epoch under which it runs, and no other."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

IN_PYTHON = """
import time
import failover
while True:
    print(failover.epoch(), flush=True)
    time.sleep(0.01)
"""
PROGRAM = (sys.executable, "-c", IN_PYTHON)

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def epoch(robot: RobotMachine) -> int:
    return int(robots.component(robot, "token")["epoch"])


def until_told(primary: RobotMachine, *seers: RobotMachine) -> None:
    """Until the program has said its epoch there, and these robots have it: the standby with the next checkpoint."""
    for robot in seers:
        robots.until(lambda at=robot: robots.numbers(at, "token")[-1:] == [epoch(primary)], "its epoch to be told")  # type: ignore[misc]


def test_the_epoch_of_a_program_grows_with_a_handover_and_a_takeover(pair: Pair) -> None:
    first, second = pair
    environment = {"PYTHONPATH": os.getcwd(), "FAILOVER_EPOCH": "17"}
    robots.run(first, "token", *PROGRAM, env=environment)
    robots.until_protected(first, "token")
    until_told(first, first, second)
    for _ in range(2):
        robots.until(lambda: robots.failover(first, "handover", "token").returncode == 0, "a handover")
        there = first if robots.component(first, "token")["role"] == "primary" else second
        robots.until_protected(there, "token")
        until_told(there, first, second)
    first.cut_power()
    robots.until_taken_over(second, "token")
    until_told(second, second)
    told = robots.numbers(second, "token")
    assert told == sorted(told) and len(set(told)) == 4
