"""A cable that carries less than the program writes: fewer snapshots, each with more in it; the status says so."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from failover.cli.demo.robots import means
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

WRITING = """
import os, time
held = bytearray(400_000)
number = 0
while True:
    held[:] = os.urandom(len(held))
    print(number, flush=True)
    number += 1
    time.sleep(0.05)
"""
"""400 KB that no compression makes less, written anew each 50 ms."""

RATE = "8mbit"
QUEUE_MS = 20
INSTEAD = "instead of every"
CABLE = "to reach robot2"
"""Of the reasons why snapshots are seldom this one's; on a busy machine the program may stand still for long besides."""

needs_tbf = pytest.mark.skipif(
    not means().own_network or shutil.which("tc") is None, reason="needs root, networks of their own and tc"
)


def shape(robot: RobotMachine, *words: str) -> None:
    """A token bucket at a robot's end of the cable, or none any more."""
    subprocess.run(["nsenter", "--net", f"--target={robot.process.pid}", "tc", "qdisc", *words], check=True)


def slow_for_the_cable(robot: RobotMachine) -> bool:
    """Does its status say that snapshots are seldom because they take so long to arrive?"""
    return any(INSTEAD in note and CABLE in note for note in robots.component(robot, "write").get("notes") or [])


@needs_tbf
def test_what_does_not_fit_the_cable_is_taken_less_often_and_the_status_says_so(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        robots.run(first, "write", "/usr/bin/python3", "-S", "-c", WRITING)
        robots.until_protected(first, "write")
        shape(first, "add", "dev", "wire", "root", "tbf", "rate", RATE, "burst", "8kb", "latency", f"{QUEUE_MS}ms")
        robots.until(lambda: slow_for_the_cable(first), "the status to say that snapshots are seldom, and why")
        held = robots.checkpoints(second, "write")
        robots.until(lambda: robots.checkpoints(second, "write") >= held + 3, "checkpoints to arrive all the same")
        robots.until_protected(first, "write")
        robots.until(lambda: INSTEAD in robots.failover(first, "status").stdout, "the status to say so still")
        shape(first, "delete", "dev", "wire", "root")
        robots.until(lambda: not slow_for_the_cable(first), "the status to say nothing of it any more")
        assert robots.component(first, "write")["role"] == "primary", "nobody took it over meanwhile"
