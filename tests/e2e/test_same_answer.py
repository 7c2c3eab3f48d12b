"""`failover status` at both robots, in every situation of a component: the same words and the same exit status."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.worker.components import stall_watchdog
from failover.cli.output import team_tree
from failover.client.control import Control
from tests.e2e import robots
from tests.e2e.robots import NO_ANSWER, RobotMachine
from tests.e2e.test_deaths import kill
from tests.e2e.test_stale import parts_of_it
from tests.robot_processes import parts

Pair = tuple[RobotMachine, RobotMachine]
Answer = tuple[int, tuple[tuple[str, ...], ...]]

COUNT = "import time\nn = 0\nwhile True:\n print(n, flush=True)\n n += 1\n time.sleep(0.05)"

SHOWN = ("component", "role", "state")
"""The first columns: the others are measured, and differ from one look to the next."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(both[0])
        yield both


def answer(robot: RobotMachine) -> Answer:
    """The exit status, and each component's row."""
    shown = robots.failover(robot, "status")
    try:
        with Control.open(robot.socket) as agent:
            status = agent.ask("status", team=True)
    except NO_ANSWER:
        return shown.returncode, ()
    rows = [row.cells[: len(SHOWN)] for row in team_tree.rows(status)]
    assert status["healthy"] == team_tree.is_healthy(status)
    return shown.returncode, tuple(sorted((cells[0].lstrip("└├─ "), *cells[1:]) for cells in rows if "/" in cells[0]))


def until_both_say(pair: Pair, returncode: int, state: str) -> None:
    """Both end with this exit status and show the component so, and twice in a row, both the same."""
    told: list[tuple[Answer, Answer]] = []

    def agree() -> bool:
        told.append((answer(pair[0]), answer(pair[1])))
        return len(told) > 1 and all(
            one == other and one[0] == returncode and [cells[2] for cells in one[1]] == [state] for one, other in told[-2:]
        )

    try:
        robots.until(agree, f"both to say {state}, with exit status {returncode}")
    except AssertionError as error:
        raise AssertionError(f"{error}; they say {told[-1]}") from error


def test_both_robots_answer_the_same_through_a_handover_and_a_release(pair: Pair) -> None:
    first, second = pair
    until_both_say(pair, 0, "running")
    assert robots.failover(first, "handover", "count", "--to", "robot2").returncode == 0
    until_both_say(pair, 0, "running")
    assert robots.failover(first, "release", "count").returncode == 0
    robots.until(lambda: answer(first) == answer(second) == (0, ()), "both to say that nothing is protected any more")


def test_both_robots_answer_the_same_after_an_end(pair: Pair) -> None:
    assert robots.failover(pair[1], "stop", "count").returncode == 0
    until_both_say(pair, 0, "ended (signal 15)")


@pytest.mark.parametrize("part", ["keeper", "worker"])
def test_both_robots_answer_the_same_after_a_part_was_killed(pair: Pair, part: str) -> None:
    (killed,) = parts_of_it(pair[0], part)
    os.kill(killed, signal.SIGKILL)
    robots.until(lambda: stall_watchdog.activity(killed)[0] in ("", "Z"), f"the {part} to be gone")
    until_both_say(pair, 0, "running")


def test_a_program_whose_agent_is_killed_is_healthy_at_no_robot(pair: Pair) -> None:
    first, second = pair
    kill(first, ("main_loop",))
    robots.until(lambda: not parts(first, "main_loop") and not parts(first, "worker"), "the agent to be gone")
    robots.until(lambda: answer(second)[0] == 1, "robot2 to say that not all is well")
    robots.until_taken_over(second)
    assert answer(second)[0] == 1, "it has no standby"
    assert answer(first)[0] == 3
    robots.start_agent(first)
    until_both_say(pair, 0, "running")


def test_a_cable_that_is_out_makes_neither_robot_call_itself_healthy(pair: Pair) -> None:
    if not robots.has_cable():
        pytest.skip("robots share one network here")
    robots.cable(pair[0], "down")
    for robot in pair:
        robots.until(lambda robot=robot: answer(robot)[0] == 1, f"{robot.name} to say that not all is well")  # type: ignore[misc]
    robots.cable(pair[0], "up")
    until_both_say(pair, 0, "running")
