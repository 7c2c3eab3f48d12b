"""Two components with one file open for writing: reported as not protected while both run, taken over where it is shared."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

WRITES = """
import os, sys, time
file, place, count = os.open(sys.argv[1], os.O_RDWR), int(sys.argv[2]), 0
while True:
    os.pwrite(file, b"%12d" % count, place)
    print(count, flush=True)
    count += 1
    time.sleep(0.01)
"""
BOTH = ("first", "second")

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "telemetry.db"
    path.write_bytes(bytes(4096))
    return path


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def begin(robot: RobotMachine, database: Path, *rule: str) -> None:
    for index, name in enumerate(BOTH):
        command = ["/usr/bin/python3", "-S", "-c", WRITES, str(database), str(index * 64)]
        started = robots.failover(robot, "run", "--detach", "--name", name, *rule, "--", *command)
        assert started.returncode == 0, started
    for name in BOTH:
        robots.until_protected(robot, name)


def test_a_takeover_that_must_fail_is_told_at_both_robots(pair: Pair, database: Path) -> None:
    begin(pair[0], database)
    for robot in pair:
        known = [f"of component /demo/robot1/{name}: end that" for name in BOTH]
        shown = robots.until_status(robot, 1, "running, unprotected", "NOT PROTECTED", f"--shared {database}", *known)
        for name, other in (BOTH, BOTH[::-1]):
            (line,) = (line for line in shown.splitlines() if f"{name}: " in line.rpartition("NOT PROTECTED")[0])
            assert f"{database}, open as fd 3, is held open for writing by pid " in line
            assert f"of component /demo/robot1/{other}: end that" in line


def test_with_a_shared_file_both_are_taken_over(pair: Pair, database: Path) -> None:
    first, second = pair
    begin(first, database, "--shared", str(database))
    for robot in pair:
        assert "NOT PROTECTED" not in robots.until_status(robot, 0)
    for name in BOTH:
        robots.until(lambda of=name: len(robots.numbers(first, of)) > 20, "some numbers")  # type: ignore[misc]
    first.cut_power()
    for name in BOTH:
        robots.until_taken_over(second, name)
        before = len(robots.numbers(second, name))
        robots.until(lambda of=name, had=before: len(robots.numbers(second, of)) > had + 20, "it to go on")  # type: ignore[misc]
        counted = robots.numbers(second, name)
        assert counted == list(range(len(counted)))


def test_a_capture_says_that_its_restore_would_be_refused(database: Path) -> None:
    hold = "import sys, time; held = open(sys.argv[1], 'r+b'); print(flush=True); time.sleep(600)"
    programs = [subprocess.Popen([sys.executable, "-c", hold, database], stdout=subprocess.PIPE) for _ in range(2)]
    try:
        for program in programs:
            assert program.stdout is not None
            program.stdout.readline()
        failover = [sys.executable, "-m", "failover.cli.main", "capture", str(programs[0].pid), "--leave-running", "--force"]
        failover += ["-o", str(database.parent / "snapshot")]
        told = subprocess.run(failover, capture_output=True, text=True, check=True)
        assert f"{database}, open as fd 3, is held open for writing by pid {programs[1].pid} " in told.stdout + told.stderr
        told = subprocess.run([*failover, "--shared", str(database)], capture_output=True, text=True, check=True)
        assert "held open" not in told.stdout + told.stderr
    finally:
        for program in programs:
            program.kill()
            program.wait()
