"""An agent restarts as planned: its programs act on meanwhile and none moves; one that does not come back is replaced.

FAILOVER_RESTARTS=100 restarts an agent so often, at instants that FAILOVER_SEED chooses.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.cli.demo.robots import LEASE_MS
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, kill
from tests.robot_processes import parts

pytestmark = pytest.mark.root

RESTARTS = int(os.environ.get("FAILOVER_RESTARTS", "2"))
SEED = os.environ.get("FAILOVER_SEED", "")
SHOWN = 2
"""Of many restarts, ``failover why`` tells the latest."""
SPREAD_S = 0.3
"""Instants of restarts lie in here: a capture begins every 0.1 s."""

AWAY_S = 6 * LEASE_MS / 1_000
"""Long after any lease that the agent could have renewed before."""

SHORT_GRACE = "restart_grace_s = 4\n"

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Pair]:
    with robots.two_robots(tmp_path, getattr(request, "param", "")) as both:
        for robot in both:
            robots.keep_on(robot)
        robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(both[0])
        yield both


def leave(robot: RobotMachine) -> None:
    """Tell its agent that another one starts at once, and wait until it has ended."""
    agent = robots.host_pid(robot, robot.status()["pid"])
    os.kill(agent, signal.SIGUSR1)
    robots.until(lambda: robots.has_ended(agent), f"the agent of {robot.name} to end")


def written(robot: RobotMachine) -> int:
    """Bytes of output that the guard there has on its disk: it needs no agent."""
    return sum(path.stat().st_size for path in (robot.directory / "state" / "logs").rglob("*") if path.is_file())


def shows(robot: RobotMachine, *words: str) -> bool:
    shown = robots.failover(robot, "status").stdout
    return all(word in shown for word in words)


def expect_it_acts(robot: RobotMachine) -> None:
    before = written(robot)
    robots.until(lambda: written(robot) > before + 20, "the program to write on")


def as_seen(robot: RobotMachine) -> tuple[object, ...]:
    """What a move, a restore or another process would change."""
    seen = robots.component(robot, "count")
    return seen["epoch"], seen["primary"], seen["restores"], seen["pid"]


def test_restarts_of_an_agent_move_nothing_and_leave_no_gap(pair: Pair) -> None:
    first, second = pair
    dice, before = random.Random(SEED), as_seen(first)
    for number in range(RESTARTS):
        time.sleep(dice.uniform(0, SPREAD_S))
        leave(first)
        gone_at = time.monotonic()
        if number == 0:
            robots.until(lambda: shows(second, "restarting", "its agent restarts, as it announced"), "the status to tell of it")
        robots.until(lambda gone_at=gone_at: time.monotonic() > gone_at + AWAY_S, "any lease to be over")  # type: ignore[misc]
        expect_it_acts(first)
        assert robots.component(second, "count")["role"] == "standby"
        robots.start_agent(first)
        robots.until(lambda: robots.answers(first), "the agent to answer")
        expect_it_acts(first)
        robots.until_protected(first)
        assert as_seen(first) == before
    counted = robots.numbers(first)
    assert counted == list(range(len(counted)))
    assert "freezes it" not in story(first) and "stands still" not in story(first)

    # the promise was given back: a loss soon after a restart is met as ever
    told = min(RESTARTS, SHOWN)
    robots.until(lambda: story(second).count("robot2 waits for it no longer than ever") >= told, "the promise to be void")
    robots.counts_on_elsewhere(first, second, more=20)


def story(robot: RobotMachine) -> str:
    """What ``failover why`` tells of the component and of its robot."""
    return " ".join(robots.failover(robot, "why", "count").stdout.split())


@pytest.mark.parametrize("pair", [SHORT_GRACE], indirect=True, ids=["4 s"])
def test_an_agent_that_does_not_come_back_or_dies_in_the_grace_is_replaced_after_it(pair: Pair) -> None:
    first, second = pair
    program = robots.host_pid(first, robots.component(first, "count")["pid"])
    leave(first)
    expect_it_acts(first)
    robots.start_agent(first)
    kill(first, ("main_loop", "worker"))  # before it could be heard, perhaps
    robots.until(lambda: not parts(first, "main_loop"), "the agent to be gone")
    robots.until_taken_over(second)
    ran, before = ran_ns(program), len(robots.numbers(second))
    robots.until(lambda: len(robots.numbers(second)) > before + 20, "it to go on")
    assert ran_ns(program) == ran, "the copy that was left behind stood still before the other one ran"
    counted = robots.numbers(second)
    assert counted == list(range(len(counted))), "each number once, in order"


def ran_ns(pid: int) -> int:
    """Processor time that a process has had. Source: Documentation/scheduler/sched-stats.rst."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])


@pytest.mark.skipif(not robots.has_cable(), reason="needs networks of their own")
def test_an_agent_whose_peer_cannot_promise_ends_all_the_same(pair: Pair) -> None:
    first, second = pair
    robots.cable(first, "down")
    leave(first)
    assert "the other robots have not promised to wait" in first.log.read_text()
    robots.until_taken_over(second)
