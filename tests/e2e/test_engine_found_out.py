"""`failover run` without an engine named: a program that keeps its state says so itself, at any time, below any launcher."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

WAITS = """
import os, time
while not os.path.exists("go"):
    time.sleep(0.01)
"""
THREADED = """
import os, threading, time
held = os.pidfd_open(1)  # of somebody else, which nobody can bring back
threading.Thread(target=time.sleep, args=(1e6,), daemon=True).start()
"""
COUNTS = """
import time
import failover

state = failover.resume("count", default={"value": 0})
origin = failover.resumed()
if origin is not None:
    print("#", origin.robot, origin.epoch, origin.why)
while True:
    print(state["value"])
    state["value"] += 1
    failover.commit()
    time.sleep(0.01)
"""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with robots.two_robots(tmp_path) as both:
        yield both


def start(robot: RobotMachine, folder: Path, script: str, *, shell: bool = False) -> None:
    program = folder / "counter.py"
    program.write_text(script)
    command = [sys.executable, str(program)]
    wanted = ["sh", "-c", f"{shlex.join(command)}; true"] if shell else command
    with robot.control() as link:
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C"}
        link.ask("run", argv=wanted, name="count", env=environment, cwd=str(folder), wait=False)


def shown(robot: RobotMachine) -> dict[str, Any]:
    return robots.component(robot, "count")


def captured_by(robot: RobotMachine, engine: str) -> bool:
    """Whether the standby's newest checkpoint came from this engine."""
    return shown(robot).get("engine") == engine and robots.checkpoints(robot, "count") > 0


def lines(robot: RobotMachine) -> list[str]:
    return robots.output(robot, "count").decode().splitlines()


def taken_over(first: RobotMachine, second: RobotMachine) -> None:
    """The first one's power fails; the second goes on with the state, and nothing is printed twice or never."""
    robots.until(lambda: len(lines(second)) > 20, "a count at the standby")
    first.cut_power()
    robots.until(lambda: any(line.startswith("#") for line in lines(second)), "robot2 to go on")
    told = next(line for line in lines(second) if line.startswith("#"))
    assert told == "# robot1 2 taken over"
    at = lines(second).index(told)
    robots.until(lambda: len(lines(second)) > at + 20, "it to count on")
    counted = [int(line) for line in lines(second) if line != told]
    assert counted == list(range(len(counted)))


def words_of_alarm(robot: RobotMachine) -> list[str]:
    """What its log says about the component above the level of news."""
    log = robot.log.read_text(errors="replace").splitlines()
    return [line for line in log if " W " in line or " E " in line]


def test_a_program_is_traced_until_it_says_that_it_keeps_its_state(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    start(first, tmp_path, WAITS + COUNTS.replace("while True:", WAITS.replace("go", "commit") + "while True:"))
    robots.until(lambda: captured_by(second, "ptrace"), "a checkpoint from outside")
    (tmp_path / "go").touch()
    robots.until(
        lambda: "it has committed nothing yet" in "".join(shown(first)["notes"]), "it to be said that there is no commit"
    )
    assert shown(first)["state"] == "running"
    (tmp_path / "commit").touch()
    robots.until(lambda: captured_by(second, "cooperative"), "a checkpoint of its own")
    assert (shown(first)["engine"], shown(first)["reasons"], words_of_alarm(first)) == ("cooperative", [], [])
    taken_over(first, second)
    assert shown(second)["engine"] == "cooperative"


def test_a_program_with_threads_below_a_shell_is_protected_without_a_word_of_alarm(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    start(first, tmp_path, THREADED + WAITS + COUNTS, shell=True)
    robots.until(lambda: "may yet say that it keeps its state" in "".join(shown(first)["notes"]), "it to be refused from outside")
    assert (shown(first)["state"], shown(first)["reasons"]) == ("running", [])
    (tmp_path / "go").touch()
    robots.until(lambda: captured_by(second, "cooperative"), "a checkpoint of its own")
    assert (shown(first)["state"], shown(first)["reasons"], words_of_alarm(first)) == ("running", [], [])
    taken_over(first, second)


def test_a_shell_and_its_child_are_traced_until_the_child_says_that_it_keeps_its_state(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    start(first, tmp_path, WAITS + COUNTS, shell=True)
    robots.until(lambda: captured_by(second, "ptrace"), "a checkpoint from outside")
    (tmp_path / "go").touch()
    robots.until(lambda: captured_by(second, "cooperative"), "a checkpoint of its own")
    assert (shown(first)["state"], shown(first)["reasons"], words_of_alarm(first)) == ("running", [], [])
    taken_over(first, second)


def test_a_program_that_is_taken_over_before_it_says_so_can_still_say_it(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    start(first, tmp_path, WAITS + COUNTS)
    robots.until(lambda: captured_by(second, "ptrace"), "a checkpoint from outside")
    first.cut_power()
    robots.until_taken_over(second)
    (tmp_path / "go").touch()
    robots.until(lambda: shown(second)["engine"] == "cooperative" and len(lines(second)) > 20, "it to keep its state here")
    assert not list(tmp_path.glob("*.state")), "no file beside a program that has an agent"
