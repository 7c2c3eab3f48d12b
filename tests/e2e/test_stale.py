"""The robot that ran a program is away for a while, and not dead: its copy stands still, and is ended when it is back."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.guard.output_logs import total_of
from agent.worker.components.stall_watchdog import activity
from checkpoint.linux.procfs import procfs
from checkpoint.snapshot import format
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, numbers
from tests.robot_processes import parts

pytestmark = pytest.mark.root

STOPPED = {
    "main_loop": ("main_loop",),
    "agent": ("main_loop", "worker"),
    "main_loop_and_keeper": ("main_loop", "keeper"),
    "agent_and_keeper": ("main_loop", "worker", "keeper"),
}
"""Parts whose rest makes a robot silent; the guard, which stands by itself, freezes the program before its lease ends."""

REST_S = 0.5
"""A counting program's log grows all the time; one that did not for so long grows no more."""

MORE = 30
"""Numbers that show that it counts on."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def protected_count(pair: Pair) -> int:
    """A counting program at the first robot, protected by the second; its process here."""
    first, second = pair
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until(lambda: robots.checkpoints(second, "count") >= 3, "checkpoints at robot2")
    return robots.host_pid(first, robots.component(first, "count")["pid"])


def written(robot: RobotMachine) -> bytes:
    """All that its copy wrote, shown to anybody or not."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    return log.read_bytes()


def came_to_rest(robot: RobotMachine) -> bytes:
    """All that its copy wrote, once nothing comes any more; nothing while it grows."""
    before = written(robot)
    time.sleep(REST_S)
    return before if written(robot) == before else b""


def runs_at(robot: RobotMachine) -> bool:
    shown = robots.component(robot, "count")
    return shown.get("role") == "primary" and shown.get("state") in ("running", "degraded")


def expect_one_history(pair: Pair) -> None:
    """Both robots agree that the second one runs it, and show the same output: no gap, no repetition, nothing of the old copy."""
    first, second = pair
    robots.until(lambda: robots.component(first, "count").get("primary") == "robot2", "robot1 to know who runs it")
    robots.until(lambda: robots.component(second, "count").get("protection") == "protected", "robot1 to protect it")
    before = len(numbers(robots.output(second, "count")))
    robots.until(lambda: len(numbers(robots.output(first, "count"))) > before + MORE, "checkpoints to travel home")
    for robot in pair:
        counted = numbers(robots.output(robot, "count"))
        assert counted == list(range(len(counted))), robot.name


def kept_aside(robot: RobotMachine) -> int:
    """What the old copy had become is there for inspection: how much it had written by then."""
    (kept,) = (robot.directory / "state" / "lost").glob("*.snapshot")
    assert format.verify(kept).component == "/demo/robot1/count"
    with kept.open("rb") as file:
        return total_of(format.read_outline(file.fileno()).output)[0]


def parts_of_it(robot: RobotMachine, name: str) -> list[int]:
    """The processes of that kind which the program has to do with: spare guards and keepers wait besides."""
    if name == "worker":
        return parts(robot, name)
    program = robots.host_pid(robot, robots.component(robot, "count")["pid"])
    if name == "guard":
        return [pid for pid in parts(robot, name) if pid == procfs.status(program).ppid]
    return robots.until(lambda: busy_keepers(robot), "one keeper alone to work")


def busy_keepers(robot: RobotMachine) -> list[int]:
    """The keeper that uses processor time while snapshots are taken, once it is the only one."""
    before = {pid: activity(pid)[1] for pid in parts(robot, "keeper")}
    taken = robots.checkpoints(robot, "count")
    robots.until(lambda: robots.checkpoints(robot, "count") > taken + 5, "snapshots")
    busy = [pid for pid in before if activity(pid)[1] > before[pid]]
    return busy if len(busy) == 1 else []


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", STOPPED)
def test_who_stops_and_wakes_up_stale_has_not_run_on(pair: Pair, way: str) -> None:
    first, second = pair
    program = protected_count(pair)
    stopped = [pid for name in STOPPED[way] for pid in parts(first, name)]
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    try:
        robots.until(lambda: runs_at(second), "robot2 to take over")
        standing = robots.until(lambda: came_to_rest(first), "what it wrote before to be in its log")
        before = len(robots.output(second, "count"))
        robots.until(lambda: len(robots.output(second, "count")) > before + MORE, "robot2 to count on")
        assert written(first) == standing, "the old copy stood still before the new one ran"
        assert Path(f"/proc/{program}").exists()
    finally:
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):  # a keeper that stood still is replaced
                os.kill(pid, signal.SIGCONT)
    robots.until(lambda: not Path(f"/proc/{program}").exists(), "the old copy to be ended")
    expect_one_history(pair)
    assert kept_aside(first) == len(standing), "and it did not run on before it was told"


ALONE = [("worker", signal.SIGSTOP), ("keeper", signal.SIGSTOP), ("guard", signal.SIGSTOP), ("guard", signal.SIGKILL)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("part", "number"), ALONE)
def test_a_part_that_stops_alone_is_replaced_and_nobody_takes_over(pair: Pair, part: str, number: int) -> None:
    first, second = pair
    protected_count(pair)
    copies = {robots.component(first, "count")["pid"]}
    (stopped,) = parts_of_it(first, part)
    os.kill(stopped, number)
    robots.until(lambda: not Path(f"/proc/{stopped}").exists(), f"the {part} to be ended")
    robots.until(lambda: robots.answers(first), "the agent to answer")
    robots.until(lambda: robots.component(first, "count").get("state") == "running", "it to run")
    taken = robots.checkpoints(second, "count")
    robots.until(lambda: robots.checkpoints(second, "count") > taken + 2, "checkpoints to be taken again")
    copies.add(robots.component(first, "count")["pid"])
    assert len(copies) == (2 if part == "guard" else 1), "it is resumed where it has lost its guard, else it ran on"
    assert robots.component(first, "count")["primary"] == "robot1"
    for robot in pair:
        counted = numbers(robots.output(robot, "count"))
        assert counted == list(range(len(counted))), robot.name
