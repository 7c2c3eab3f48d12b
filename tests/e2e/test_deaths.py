"""Keeper, agent and both are killed, at instants spread over captures and restores: the program is unharmed. Guards, too.

Two robots of which one waits (``on_loss = "hold"``), so that an agent that is away for a second is a pause of the protection and
not a takeover. FAILOVER_KILLS=200 kills each that often, at instants that FAILOVER_SEED chooses.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.errors import AgentRefusedError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.robot_processes import command_lines, parts

pytestmark = pytest.mark.root

KILLS = int(os.environ.get("FAILOVER_KILLS", "4"))
SEED = os.environ.get("FAILOVER_SEED", "")
COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.005)\n"
SPREAD_S = 0.15
"""Instants of death lie in here: a capture begins every 0.1 s."""

RESTORE_S = 0.25
"""A handover, its restore included, takes about so long."""

WAYS = {
    "keeper": ("keeper",),
    "worker": ("worker",),
    "main_loop": ("main_loop",),
    "agent": ("main_loop", "worker"),
    "agent_and_keeper": ("main_loop", "worker", "keeper"),
}

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    settings = '[components."/demo/robot1/count"]\non_loss = "hold"\n'
    with robots.two_robots(tmp_path, settings) as both:
        for robot in both:
            robots.keep_on(robot)
        yield both


def kill(robot: RobotMachine, names: tuple[str, ...]) -> None:
    """Freeze these parts, then kill them at once: nobody sees another one die."""
    for name in names:
        robots.until(lambda name=name: parts(robot, name), f"a {name} to kill")  # type: ignore[misc]
    victims = [pid for name in names for pid in parts(robot, name)]
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)


def revived(robot: RobotMachine, names: tuple[str, ...]) -> None:
    """Bring the agent back, if it was killed, and wait until it answers."""
    if "main_loop" in names:
        robots.until(lambda: not parts(robot, "main_loop") and not parts(robot, "worker"), "the agent to be gone")
        robots.start_agent(robot)
    robots.until(lambda: robots.answers(robot), "the agent to answer")


def expect_checkpoints(standby: RobotMachine) -> None:
    stored = robots.checkpoints(standby, "count")
    robots.until(lambda: robots.checkpoints(standby, "count") > stored, "protection to go on")


def numbers(content: bytes) -> list[int]:
    return [int(line) for line in content.split()]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", WAYS)
def test_whoever_is_killed_the_program_runs_on(pair: Pair, way: str) -> None:
    first, second = pair
    dice = random.Random(f"{way} {SEED}")
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


def test_guards_that_die_together_cost_a_program_one_crash_and_nothing_that_was_acknowledged(pair: Pair) -> None:
    first, second = pair
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until(lambda: robots.checkpoints(second, "count") >= 3, "checkpoints at robot2")
    robots.until(lambda: len(parts(first, "guard")) > 1, "a guard that waits")
    kill(first, ("guard",))
    robots.until(lambda: robots.component(first, "count").get("restores") == 1, "the program to be resumed")
    decisions = [line for line in first.log.read_text().splitlines() if "saw it crash" in line or "could not resume" in line]
    assert len(decisions) == 1 and "saw it crash, 1 in the window" in decisions[0], decisions
    expect_checkpoints(second)


def order_handover(source: RobotMachine, target: RobotMachine) -> None:
    """Ask for it; that it is refused or that nobody answers is no concern here."""
    with contextlib.suppress(AgentRefusedError, *robots.NO_ANSWER), source.control() as link:
        link.ask("handover", name="count", to=target.name)


def settled(pair: Pair) -> RobotMachine | None:
    """The robot that runs it, once both agree and the other one holds a checkpoint of this epoch."""
    for one, other in (pair, pair[::-1]):
        here, there = robots.component(one, "count"), robots.component(other, "count")
        agreed = here.get("primary") == there.get("primary") == one.name
        if agreed and here["state"] == "running" and here["protection"] == "protected":
            return one
    return None


def copies(robot: RobotMachine) -> tuple[int, int]:
    """How many processes of the program there are, and how many of ours around it: vessels, and first processes of namespaces."""
    programs = ours = 0
    for pid, words in command_lines(robot):
        programs += words[:3] == ["/usr/bin/python3", "-S", "-c"]
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            ours += Path(f"/proc/{pid}/exe").readlink().name.startswith("memfd:")
    return programs, ours


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", WAYS)
def test_a_restore_that_is_broken_off_leaves_nothing_behind(pair: Pair, way: str) -> None:
    """The robot that is to go on with the program loses a part of its agent in the middle of it, again and again."""
    dice = random.Random(f"restore {way} {SEED}")
    robots.run(pair[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
    for _ in range(KILLS):
        source = robots.until(lambda: settled(pair), "one robot to run it and the other to protect it")
        target = pair[1] if source is pair[0] else pair[0]
        death = threading.Timer(dice.uniform(0, RESTORE_S), kill, (target, WAYS[way]))
        death.start()
        order_handover(source, target)
        death.join()
        revived(target, WAYS[way])
    primary = robots.until(lambda: settled(pair), "one robot to run it and the other to protect it")
    other = pair[1] if primary is pair[0] else pair[0]
    robots.until(lambda: copies(other) == (0, 0), f"no copy to be left at {other.name}")
    robots.until(lambda: copies(primary) == (1, 1), f"one copy at {primary.name}")
    expect_checkpoints(other)
    counted = numbers(robots.output(other, "count"))
    assert counted == list(range(len(counted)))
