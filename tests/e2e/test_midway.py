"""A peer that is lost in the middle of a snapshot: no half of one is kept, no whole one is lost."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

SLOW = "link_mbit_s = 40\n"
"""A snapshot of 16 MB is under way for three seconds."""

GROWING = """
import os, sys, time
number, held = 0, []
while True:
    print(number, flush=True)
    number += 1
    time.sleep(0.01)
    if not held and os.path.exists(sys.argv[1]):
        held.append(os.urandom(16 << 20))
"""
"""Counts, and needs much more memory as soon as a file exists."""

MIDDLE = 2 << 20
"""Bytes of a snapshot that have come: some chunks, not yet all."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    """A protected program at robot1 whose next snapshot is half at robot2."""
    with robots.two_robots(tmp_path, SLOW) as both:
        flag = tmp_path / "flag"
        robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", GROWING, str(flag))
        robots.until(lambda: robots.component(both[0], "count").get("protection") == "protected", "a checkpoint at robot2")
        flag.touch()
        robots.until(lambda: any(size > MIDDLE for size in arriving(both[1])), "the middle of a snapshot")
        yield both


def worker_of(robot: RobotMachine) -> int:
    return robots.host_pid(robot, robot.status()["lanes_pid"])


def arriving(robot: RobotMachine) -> list[int]:
    """Sizes of the unnamed files in the robot's store: what is coming in. An empty one is the spare file of a keeper."""
    found = []
    for descriptor in Path(f"/proc/{worker_of(robot)}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            path = os.readlink(descriptor)
            if path.startswith(str(robot.directory / "state" / "store")) and path.endswith(" (deleted)"):
                found.append(descriptor.stat().st_size)
    return [size for size in found if size]


def left_over(robot: RobotMachine) -> list[str]:
    """Files in its store that are no snapshots: one that it writes right now, or one that stays."""
    files = (path for path in (robot.directory / "state" / "store").rglob("*") if path.is_file())
    return [path.name for path in files if path.suffix not in (".base", ".delta") and path.name != "lock"]


def test_a_primary_that_goes_in_the_middle_is_taken_over_from_the_last_whole_snapshot(pair: Pair) -> None:
    first, second = pair
    kept = len(robots.numbers(second))
    first.cut_power()
    robots.until(lambda: robots.component(second, "count").get("state") == "running", "robot2 to take over")
    robots.until(lambda: len(robots.numbers(second)) > kept + 10, "the program to go on")
    counted = robots.numbers(second)
    assert counted == list(range(len(counted)))
    robots.until(lambda: arriving(second) == [], "the half snapshot to be dropped")
    robots.until(lambda: left_over(second) == [], "the store to hold snapshots only")


def test_a_standby_that_goes_in_the_middle_is_named_and_gets_all_when_it_is_back(pair: Pair) -> None:
    first, second = pair
    os.kill(worker_of(second), signal.SIGKILL)  # its main loop beats on, and starts another
    before = len(robots.numbers(first))
    signs = "the connection was lost", "is not connected"  # the latter where that snapshot had just arrived
    robots.until(lambda: any(sign in robots.failover(first, "why", "count").stdout for sign in signs), "the loss to be told")
    robots.until(lambda: len(robots.numbers(first)) > before, "the program to run on")
    robots.until(lambda: robots.answers(second), "its other half to be back")
    stored = robots.checkpoints(second, "count")
    robots.until(lambda: robots.answers(second) and robots.checkpoints(second, "count") > stored + 1, "checkpoints to arrive")
    robots.until(lambda: robots.component(first, "count").get("protection") == "protected", "it to be protected again")
    robots.until(lambda: left_over(second) == [], "the store to hold snapshots only")
    counted = robots.numbers(first)
    assert counted == list(range(len(counted)))
