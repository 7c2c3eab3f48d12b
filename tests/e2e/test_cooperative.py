"""Two robots and a program that says by itself what must survive: a component like any other, and never frozen."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

COUNTER = """
import time
from dataclasses import dataclass
import failover

@dataclass
class Count:
    value: int = 0

count = failover.resume("count", default=Count())
origin = failover.resumed()
if origin is not None:
    print("#", origin.robot, failover.epoch(), origin.why.replace(" ", "-"))
while True:
    print(count.value)
    count.value += 1
    failover.commit()
    time.sleep(0.01)
"""
FORGETS = """
import os, time
import failover

state = failover.resume("count", default={"step": 0})
origin = failover.resumed()
if origin is not None:
    print("resumed", origin.age_s > 2, flush=True)
while True:
    state["step"] += 1
    if origin is not None or not os.path.exists("stop"):
        failover.commit()
    time.sleep(0.01)
"""
SNAPSHOTS = 5


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with robots.two_robots(tmp_path) as both:
        yield both


def start_counting(robot: RobotMachine, folder: Path, script: str = COUNTER) -> None:
    program = folder / "counter.py"
    program.write_text(script)
    robots.run(robot, "count", sys.executable, str(program), cwd=str(folder), engine="cooperative")


def protected(first: RobotMachine, second: RobotMachine, folder: Path) -> int:
    """Start it and wait for checkpoints at the standby; how many numbers are safe there."""
    start_counting(first, folder)
    robots.until(lambda: robots.checkpoints(second, "count") >= SNAPSHOTS, "checkpoints at robot2")
    return len(numbers(second))


def lines(robot: RobotMachine) -> list[str]:
    return robots.output(robot, "count").decode().splitlines()


def numbers(robot: RobotMachine) -> list[int]:
    return [int(line) for line in lines(robot) if not line.startswith("#")]


def origins(robot: RobotMachine) -> list[str]:
    return [line for line in lines(robot) if line.startswith("#")]


def went_on(robot: RobotMachine, before: int, why: str) -> None:
    """It was resumed here, and its numbers have no gap and no repetition, from the first to those of its new life."""
    robots.until(lambda: origins(robot), "the program to say that it was resumed")
    resumed_at = lines(robot).index(origins(robot)[0])
    assert resumed_at >= before, "what was safe is still there"
    robots.until(lambda: len(numbers(robot)) > resumed_at + 20, "the count to go on")
    counted = numbers(robot)
    assert counted == list(range(len(counted)))
    assert [line.split()[1::2] for line in origins(robot)] == [["robot1", why]]


def shown(robot: RobotMachine) -> dict[str, Any]:
    return robots.component(robot, "count")


def test_a_program_that_keeps_its_state_outlives_its_robot(pair: tuple[RobotMachine, RobotMachine], tmp_path: Path) -> None:
    first, second = pair
    before = protected(first, second, tmp_path)
    told = shown(first)
    assert (told["engine"], told["freeze_us"], told["reasons"]) == ("cooperative", 0, [])
    assert told["lag_ms"] is not None
    assert shown(second)["engine"] == "cooperative"
    assert not list(tmp_path.glob("*.state")), "no file beside a program that has an agent"
    first.cut_power()
    robots.until_taken_over(second)
    went_on(second, before, "taken-over")
    assert (shown(second)["restores"], shown(second)["epoch"]) == (1, 2)
    assert origins(second)[0].split()[2] == "2", "the program knows the epoch that it runs in"


def test_a_program_that_keeps_its_state_goes_on_in_place_after_a_crash(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    before = protected(first, second, tmp_path)
    os.kill(robots.host_pid(first, shown(first)["pid"]), signal.SIGSEGV)
    robots.until(lambda: shown(first).get("restores") == 1, "robot1 to resume it")
    went_on(first, before, "restarted")


def test_a_program_that_keeps_its_state_is_handed_over(pair: tuple[RobotMachine, RobotMachine], tmp_path: Path) -> None:
    first, second = pair
    before = protected(first, second, tmp_path)
    done = robots.failover(first, "handover", "count")
    assert done.returncode == 0, done.stdout + done.stderr
    robots.until(lambda: shown(second).get("role") == "primary", "robot2 to run it")
    went_on(second, before, "handed-over")


def test_a_program_that_stops_committing_is_seen_in_status_and_sends_nothing(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    start_counting(first, tmp_path, FORGETS)
    robots.until(lambda: robots.checkpoints(second, "count") >= SNAPSHOTS, "checkpoints at robot2")
    robots.until(lambda: (shown(first)["commit_usual_ms"] or 0) > 0 and not shown(first)["commit_overdue"], "its usual pace")
    (tmp_path / "stop").touch()
    robots.until(lambda: shown(first)["commit_overdue"], "robot1 to find that it stopped")
    sent = shown(first)["snapshots"]
    robots.until(lambda: shown(first)["lag_ms"] > 5_000, "its newest commit to grow old")
    told = shown(first)
    assert min(told["lag_ms"], told["commit_age_ms"]) > told["commit_usual_ms"]  # read one after the other
    assert (told["snapshots"], told["protection"]) == (sent, "protected")
    assert robots.checkpoints(second, "count") <= sent
    drawn = robots.failover(first, "status").stdout
    assert "running, last commit" in drawn and "it commits no more" in drawn
    first.cut_power()
    robots.until(lambda: b"resumed True" in robots.output(second, "count"), "it to learn how old its state is")
