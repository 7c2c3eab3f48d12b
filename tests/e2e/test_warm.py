"""Two robots and a program that keeps its state: its standby has started it already, and a takeover is one message."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_cooperative import COUNTER, lines, numbers, origins, shown
from tests.e2e.test_deaths import kill, revived
from tests.robot_processes import naming

SCRIPT = (
    "import os, sys\nwith open(sys.argv[1], 'a') as starts:\n    starts.write('started\\n')\nprint('# imported - -')\n" + COUNTER
)
"""Notes each of its starts in a file, and counts."""

ELSEWHERE = '[components."/demo/robot1/count"]\ncommand = ["{}"]\n'


def counting(first: RobotMachine, folder: Path) -> None:
    """Start it at the first robot."""
    program = folder / "counter.py"
    program.write_text(SCRIPT)
    robots.run(first, "count", sys.executable, str(program), str(folder / "starts"), cwd=str(folder), engine="auto")


def until_warm(*both: RobotMachine) -> None:
    """Until these robots know that its standby has it waiting, with some checkpoints."""
    robots.until(lambda: all(shown(one).get("warm") for one in both), "the program to wait at its standby")
    robots.until(lambda: all(robots.checkpoints(one, "count") >= 5 for one in both), "checkpoints")


def starts(folder: Path) -> int:
    return (folder / "starts").read_text().count("started")


def programs(robot: RobotMachine) -> list[int]:
    """Its processes there, as this machine numbers them."""
    return naming(robot, "counter.py")


def went_on(robot: RobotMachine, before: int) -> None:
    """It counts there, beyond what it had counted before, without a gap and without a repetition."""
    robots.until(lambda: shown(robot).get("state") == "running", f"{robot.name} to run it")
    assert len(numbers(robot)) >= before, "nothing that was safe is lost"
    reached = len(numbers(robot))  # by checkpoints that came in since then
    robots.until(lambda: len(numbers(robot)) > reached + 20, "the count to go on")
    counted = numbers(robot)
    assert counted == list(range(len(counted)))


def test_a_takeover_goes_on_with_the_very_program_that_waited(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        counting(first, tmp_path)
        until_warm(first, second)
        assert "robot2, warm" in robots.failover(first, "status").stdout
        (waiting,), before = programs(second), len(numbers(second))
        first.cut_power()
        went_on(second, before)
        assert programs(second) == [waiting] and starts(tmp_path) == 2
        resumed_at = lines(second).index("# imported - -", 1)
        assert resumed_at >= before, "what it wrote while it waited follows what had been written before"
        assert [line.split()[1:] for line in origins(second)[2:]] == [["robot1", "2", "taken-over"]]


@pytest.mark.parametrize("when", ["before", "during"])
def test_a_program_that_is_killed_while_it_waits_is_started_anew(tmp_path: Path, when: str) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        counting(first, tmp_path)
        until_warm(first, second)
        (waiting,), before = programs(second), len(numbers(second))
        first.cut_power()
        if when == "during":
            robots.until(lambda: shown(second).get("role") == "primary", "robot2 to begin")
        os.kill(waiting, signal.SIGKILL)
        went_on(second, before)
        assert programs(second) != [waiting] and starts(tmp_path) >= 3


def test_a_standby_without_the_program_says_so_and_refuses_the_takeover_by_name(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, ELSEWHERE.format("/nowhere/counter")) as (first, second):
        counting(first, tmp_path)
        why = "cannot start /nowhere/counter: No such file or directory"
        for robot in (first, second):
            robots.until_status(robot, 1, "its program does not wait at robot2", why, "robot2, cold")
        first.cut_power()
        robots.until_status(second, 1, "robot2 cannot run it", why)


def test_what_waits_is_used_by_a_handover_and_ends_with_the_component(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        counting(first, tmp_path)
        until_warm(first, second)
        (waiting,), before = programs(second), len(numbers(second))
        done = robots.failover(first, "handover", "count")
        assert done.returncode == 0, done.stdout + done.stderr
        went_on(second, before)
        assert programs(second) == [waiting]
        until_warm(first, second)
        assert starts(tmp_path) == 3, "the robot that it left has it waiting in turn"
        assert robots.failover(second, "stop", "count").returncode == 0
        robots.until(lambda: not programs(first) and not programs(second), "all of it to end")


def test_what_waits_ends_with_the_worker_and_another_takes_its_place(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        counting(first, tmp_path)
        until_warm(first, second)
        (lost,) = programs(second)
        kill(second, ("worker",))
        revived(second, ("worker",))
        robots.until(lambda: starts(tmp_path) == 3, "another one to be started")
        until_warm(first, second)
        assert lost not in programs(second)
        (waiting,), before = programs(second), len(numbers(second))
        first.cut_power()
        went_on(second, before)
        assert programs(second) == [waiting]
