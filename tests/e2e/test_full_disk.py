"""The standby's disk is really full: a small file system of its own. Its content stays, status says so, space heals it."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

DISK = "size=48m"
COUNT = "import time\nfor i in range(1000000):\n    print(i, flush=True)\n    time.sleep(0.01)\n"
TRIES_A_SECOND = 3
"""Of a snapshot that does not arrive; the core's own pause is a second."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    """robot2 keeps everything that survives a power cut on a disk of its own; a program of robot1's is protected."""
    disk = tmp_path / "stage" / "robot2" / "state"

    def mount(_: Path) -> None:
        disk.mkdir(parents=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, "disk", str(disk)], check=True)

    try:
        with robots.two_robots(tmp_path, prepare=mount) as both:
            robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
            robots.until(lambda: robots.component(both[0], "count").get("protection") == "protected", "a checkpoint at robot2")
            yield both
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


@contextlib.contextmanager
def full(robot: RobotMachine) -> Iterator[None]:
    """Somebody else's file takes all the room that the disk has."""
    path = robot.directory / "state" / "somebody's film"
    with path.open("wb", buffering=0) as film:
        fill(film.fileno())
        yield
    path.unlink()


def fill(descriptor: int) -> None:
    for size in (1 << 20, 1 << 12):
        with contextlib.suppress(OSError):
            while True:
                os.write(descriptor, bytes(size))


def test_a_full_standby_is_named_with_the_age_of_what_it_holds_and_mends_itself(pair: Pair) -> None:
    first, second = pair
    with full(second):
        robots.until_status(first, 1, "degraded", "No space left on device", "the last checkpoint is")
        robots.until_status(second, 1, "degraded", "No space left on device")
        robots.until(lambda: robots.component(first, "count")["lag_ms"] > 3_000, "the checkpoint to grow old")
        age_s = robots.component(first, "count")["lag_ms"] / 1_000
        tries = first.log.read_text().count("No space left") + second.log.read_text().count("No space left")
        assert tries < 2 * TRIES_A_SECOND * age_s, f"{tries} tries in {age_s:.1f} s"
        before = len(robots.numbers(first))
    for robot in pair:
        robots.until_status(robot, 0)
    robots.until(lambda: len(robots.numbers(first)) > before, "the program to have run on")
    counted = robots.numbers(first)
    assert counted == list(range(len(counted)))


def test_a_full_standby_takes_over_from_what_it_holds(pair: Pair) -> None:
    first, second = pair
    with full(second):
        robots.until_status(second, 1, "No space left on device")
        kept = len(robots.numbers(second))
        first.cut_power()
        robots.until_taken_over(second)
        robots.until(lambda: robots.component(second, "count").get("pid") is not None, "the program to run")
    robots.until(lambda: len(robots.numbers(second)) > kept, "its output, once there is room for it")
    counted = robots.numbers(second)
    assert counted == list(range(len(counted)))
