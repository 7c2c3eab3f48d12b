"""A real-time sender floods a robot's heartbeat port: datagrams that are no heartbeats cost nothing and cause no takeover."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from failover.core.frames.frame import MAGIC
from tests.e2e import robots, stranger
from tests.e2e.robots import RobotMachine

Pair = tuple[RobotMachine, RobotMachine]

BUSY = 24
"""Programs beside it: the kernel leaves a part of the processors to ordinary programs, and they share that part."""

FLOOD_S = 10.0
"""Longer than the worker may be silent, and than any lease."""


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    with robots.two_robots(tmp_path_factory.mktemp("flood")) as both:
        robots.run(both[0], "sleeper", "/bin/sleep", "1000000")
        robots.until_protected(both[0], "sleeper")
        yield both


def standing(pair: Pair) -> list[tuple[int, int, int, str, int]]:
    """The agents' processes, and who runs the component in which epoch."""
    found = []
    for robot in pair:
        status, one = robot.status(), robots.component(robot, "sleeper")
        found.append((status["life"], status["pid"], status["lanes_pid"], one["primary"], one["epoch"]))
    return found


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many programs that take what processor they get."""
    with ExitStack() as ending:
        for _ in range(count):
            child = subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"])
            ending.callback(child.wait)
            ending.callback(child.kill)
        yield


def refused(robot: RobotMachine) -> int:
    return sum(robot.status()["beats"]["refused"].values())


@pytest.mark.sampled(2)
@pytest.mark.root
@pytest.mark.parametrize("frame", [bytes(64), MAGIC + bytes(62)], ids=["garbage", "garbage that begins as a beat"])
def test_a_flood_replaces_nobody_and_takes_nothing_over(pair: Pair, frame: bytes) -> None:
    before, counted = standing(pair), refused(pair[0])
    with busy(BUSY):
        sent = stranger.flood(pair[0], frame, FLOOD_S)
    assert standing(pair) == before
    assert refused(pair[0]) > counted, f"{sent} datagrams were sent"
    stored = robots.checkpoints(pair[1], "sleeper")
    robots.until(lambda: robots.checkpoints(pair[1], "sleeper") > stored, "the next checkpoint")
