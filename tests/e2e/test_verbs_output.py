"""A component's output, read from either robot while it moves, loses its robot, and ends: no gap, no repetition."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

BOTH = """
import os, sys, time
number = 0
while number < {limit} and not os.path.exists({go!r}):
    print(number, flush=True)
    print(-number, file=sys.stderr, flush=True)
    number += 1
    time.sleep(0.01)
sys.exit(7)
"""
"""Counts up on standard output and down on standard error, so far or until a file exists."""

ENDLESS = 1_000_000
BRIEF = 300

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def command(robot: RobotMachine, verb: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "failover.cli.main", verb, "--socket", str(robot.socket), *arguments]


def program(limit: int, go: str = "") -> tuple[str, ...]:
    return ("/usr/bin/python3", "-S", "-c", BOTH.format(limit=limit, go=go))


def lines(path: Path) -> list[int]:
    """The program's whole lines in a file that is being written; what the command itself says about it left out."""
    whole = path.read_text().rpartition("\n")[0].splitlines()
    return [int(line) for line in whole if not line.startswith("failover: ")]


def test_whoever_watches_from_the_standby_sees_every_byte_once_across_a_takeover(pair: Pair, tmp_path: Path) -> None:
    first, second = pair
    robots.run(first, "both", *program(ENDLESS))
    robots.until_protected(first, "both")
    out, err = tmp_path / "out", tmp_path / "err"
    with out.open("wb") as stdout, err.open("wb") as stderr:
        watching = subprocess.Popen(command(second, "logs", "--follow", "both"), stdout=stdout, stderr=stderr)
    try:
        robots.until(lambda: len(lines(out)) > 20, "the output to be seen at robot2")
        first.cut_power()
        robots.until_taken_over(second, "both")
        seen = len(lines(out))
        robots.until(lambda: len(lines(out)) > seen + 50 and len(lines(err)) > seen + 50, "the output to go on")
    finally:
        watching.terminate()
        watching.wait()
    assert lines(out) == list(range(len(lines(out))))
    assert lines(err) == [-number for number in range(len(lines(err)))]


def test_the_end_of_a_stream_is_shown_at_the_robot_where_it_did_not_run(pair: Pair) -> None:
    first, second = pair
    robots.run(first, "both", *program(BRIEF))
    watched = subprocess.run(command(second, "logs", "--follow", "both"), capture_output=True, check=False)
    assert watched.stdout.split() == [str(number).encode() for number in range(BRIEF)]
    assert watched.stderr.split() == [str(-number).encode() for number in range(BRIEF)]
    again = subprocess.run(command(second, "logs", "--stream", "1", "both"), capture_output=True, check=False)
    assert (again.stdout, again.stderr) == (watched.stdout, b"")


def test_run_stays_with_its_program_when_that_is_handed_over(pair: Pair, tmp_path: Path) -> None:
    first, second = pair
    out, err, go = tmp_path / "out", tmp_path / "err", tmp_path / "go"
    order = command(first, "run", "--name", "both", "--", *program(ENDLESS, str(go)))
    with out.open("wb") as stdout, err.open("wb") as stderr:
        running = subprocess.Popen(order, stdout=stdout, stderr=stderr)
    robots.until_protected(first, "both")
    moved = robots.failover(first, "handover", "both")
    assert moved.returncode == 0, moved
    assert robots.component(second, "both")["state"] == "running", "the move is over when its answer comes"
    seen = len(lines(out))
    robots.until(lambda: len(lines(out)) > seen + 20, "the output to go on")
    go.touch()
    assert running.wait(timeout=robots.PATIENCE_S) == 7
    counted = lines(out)
    assert counted == list(range(len(counted)))
    assert lines(err) == [-number for number in counted]


def test_whoever_watches_goes_on_when_the_agent_is_back(pair: Pair, tmp_path: Path) -> None:
    first, _ = pair
    robots.run(first, "both", *program(ENDLESS))
    robots.until_protected(first, "both")
    out, err = tmp_path / "out", tmp_path / "err"
    with out.open("wb") as stdout, err.open("wb") as stderr:
        watching = subprocess.Popen(command(first, "logs", "--follow", "both"), stdout=stdout, stderr=stderr)
    try:
        robots.until(lambda: len(lines(out)) > 20, "the output to be seen")
        os.kill(robots.host_pid(first, first.status()["lanes_pid"]), signal.SIGKILL)
        seen = len(lines(out))
        robots.until(lambda: len(lines(out)) > seen + 100, "the output to go on")
    finally:
        watching.terminate()
        watching.wait()
    assert lines(out) == list(range(len(lines(out))))
    assert lines(err) == [-number for number in range(len(lines(err)))]


IN_TWO_PARTS = """
import os, sys, time
for number in range(10):
    print("early", number, flush=True)
while not os.path.exists(sys.argv[1]):
    time.sleep(0.01)
for number in range(10):
    print("late", number, flush=True)
time.sleep(1000)
"""

APART_S = 4
"""Between the two parts: longer than a checkpoint and a command take here."""


def test_the_last_lines_and_what_is_younger_are_shown_with_their_times_at_both_robots(pair: Pair, tmp_path: Path) -> None:
    first, go = pair[0], tmp_path / "go"
    early, late = ([f"{part} {number}" for number in range(10)] for part in ("early", "late"))

    def shown(robot: RobotMachine, *options: str) -> list[str]:
        return robots.failover(robot, "logs", *options, "parts").stdout.splitlines()

    robots.run(first, "parts", "/usr/bin/python3", "-S", "-c", IN_TWO_PARTS, str(go))
    for robot in pair:
        robots.until(lambda: shown(robot) == early, f"the first part at {robot.name}")  # noqa: B023
        robots.until(lambda: shown(robot, "--since", f"{APART_S}s") == [], f"it to be old at {robot.name}")  # noqa: B023
    go.touch()
    began_s = time.monotonic()
    for robot in pair:
        robots.until(lambda: shown(robot) == early + late, f"the second part at {robot.name}")  # noqa: B023
        if time.monotonic() - began_s < APART_S - 2:  # on a machine that is not too busy for it
            assert shown(robot, "--since", f"{APART_S - 1}s") == late
        assert shown(robot, "--since", "1h") == early + late
        assert shown(robot, "--tail", "3") == late[-3:] and shown(robot, "--tail", "15") == early[-5:] + late
        assert shown(robot, "--tail", "100") == early + late
        timed = [line.split("  ", 1) for line in shown(robot, "--times")]
        assert [text for _, text in timed] == early + late
        times = [instant for instant, _ in timed]
        assert times == sorted(times) and times[9] < times[10], "the second part is younger"
        assert [line.split("  ", 1) for line in shown(robot, "--times", "--tail", "2")] == timed[-2:]
