"""The fencing token reaches a program that nobody prepared: each copy knows the epoch under which it runs, and no other."""

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


def newest(robot: RobotMachine) -> int:
    """What the program said last, as far as it was seen."""
    return robots.numbers(robot, "token")[-1]


def test_the_epoch_of_a_program_grows_with_a_handover_and_a_takeover(pair: Pair) -> None:
    first, second = pair
    environment = {"PYTHONPATH": os.getcwd(), "FAILOVER_EPOCH": "17"}
    robots.run(first, "token", *PROGRAM, env=environment)
    robots.until_protected(first, "token")
    robots.until(lambda: newest(second) == epoch(first), "the first epoch to be told")
    for _ in range(2):
        robots.until(lambda: robots.failover(first, "handover", "token").returncode == 0, "a handover")
        there = first if robots.component(first, "token")["role"] == "primary" else second
        robots.until_protected(there, "token")
        robots.until(lambda there=there: newest(there) == epoch(there), "the next epoch to be told")  # type: ignore[misc]
    first.cut_power()
    robots.until_taken_over(second, "token")
    robots.until(lambda: newest(second) == epoch(second), "the last epoch to be told")
    told = robots.numbers(second, "token")
    assert told == sorted(told) and len(set(told)) == 4
