"""A component's output, read from either robot while it moves, loses its robot, and ends: no gap, no repetition."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
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
