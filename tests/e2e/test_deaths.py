"""Keeper, agent and both are killed, at instants spread over captures and restores: the program is none the worse.

Two robots of which one waits (``on_loss = "hold"``), so that an agent that is away for a second is a pause of the protection and
not a takeover. FAILOVER_KILLS=200 kills each that often.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

KILLS = int(os.environ.get("FAILOVER_KILLS", "4"))
COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.005)\n"
SPREAD_S = 0.15
"""Instants of death lie in here: a capture begins every 0.1 s."""

NAMES = {"heart": b"agent.main", "lanes": b"agent.lanes", "keeper": b"checkpoint"}
"""Module of each part of an agent: the third word of its command line."""

WAYS = {
    "keeper": ("keeper",),
    "lanes": ("lanes",),
    "heart": ("heart",),
    "agent": ("heart", "lanes"),
    "agent_and_keeper": ("heart", "lanes", "keeper"),
}

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    settings = '[components."/demo/robot1/count"]\non_loss = "hold"\n'
    with robots.two_robots(tmp_path, settings) as both:
        yield both


def parts(robot: RobotMachine, name: str) -> list[int]:
    """PIDs of the robot's processes that play this part."""
    found = []
    for pid in robot.processes():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[2:3] == [NAMES[name]]:
                found.append(pid)
    return found


def kill(robot: RobotMachine, names: tuple[str, ...]) -> None:
    """Freeze these parts, then kill them at once: nobody sees another one die."""
    victims = [pid for name in names for pid in parts(robot, name)]
    assert victims, names
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)


def revived(robot: RobotMachine, names: tuple[str, ...]) -> None:
    """Bring the agent back, if it was killed, and wait until it answers."""
    if "heart" in names:
        robots.until(lambda: not parts(robot, "heart") and not parts(robot, "lanes"), "the agent to be gone")
        robots.start_agent(robot)
    robots.until(lambda: robots.answers(robot), "the agent to answer")


def expect_checkpoints(standby: RobotMachine) -> None:
    stored = robots.checkpoints(standby, "count")
    robots.until(lambda: robots.checkpoints(standby, "count") > stored, "protection to go on")


def numbers(content: bytes) -> list[int]:
    return [int(line) for line in content.split()]


@pytest.mark.parametrize("way", WAYS)
def test_whoever_is_killed_the_program_runs_on(pair: Pair, way: str) -> None:
    first, second = pair
    dice = random.Random(way)
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until(lambda: robots.checkpoints(second, "count") >= 3, "checkpoints at robot2")
    pid = robots.component(first, "count")["pid"]
    for _ in range(KILLS):
        time.sleep(dice.uniform(0, SPREAD_S))
        kill(first, WAYS[way])
        revived(first, WAYS[way])
        robots.until(lambda: robots.component(first, "count").get("pid") == pid, "the program to be found again")
        expect_checkpoints(second)
    assert robots.component(first, "count")["restores"] == 0
    before = len(numbers(robots.output(second, "count")))
    robots.until(lambda: len(numbers(robots.output(second, "count"))) > before + 20, "the count to go on")
    counted = numbers(robots.output(second, "count"))
    assert counted == list(range(len(counted)))
    with first.control() as link:
        assert os.WTERMSIG(link.ask("stop", name="count")["exit_status"]) == signal.SIGTERM
    counted = numbers(robots.output(first, "count"))
    assert counted == list(range(len(counted)))
