"""``failover run`` waits for its program through deaths of its agent, also when the program has moved to the other robot then."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import kill, revived

pytestmark = pytest.mark.root

TOLD = """
import os, sys, time
number = 0
while not os.path.exists({go!r}):
    print(number, flush=True)
    print(-number, file=sys.stderr, flush=True)
    number += 1
    time.sleep(0.005)
sys.exit(7)
"""
"""Counts on both streams until it is told to end."""

MORE = 30
HOLD = '[components."/demo/robot1/told"]\non_loss = "hold"\n'

Pair = tuple[RobotMachine, RobotMachine]


class Waiting:
    """A ``failover run`` that waits, and what it shows."""

    def __init__(self, robot: RobotMachine, directory: Path) -> None:
        self.out, self.err, self._go = directory / "out", directory / "err", directory / "go"
        script = TOLD.format(go=str(self._go))
        command = [sys.executable, "-m", "failover.cli.main", "run", "--socket", str(robot.socket), "--name", "told", "--"]
        with self.out.open("wb") as out, self.err.open("wb") as err:
            self.process = subprocess.Popen([*command, "/usr/bin/python3", "-S", "-c", script], stdout=out, stderr=err)

    def expect_more(self) -> None:
        """It shows that the program counts on."""
        seen = len(self.out.read_bytes().split())
        robots.until(lambda: len(self.out.read_bytes().split()) > seen + MORE, "more output of the program")

    def expect_the_end(self) -> None:
        """Told to end, the program does: its status is ours, its output whole."""
        self._go.touch()
        assert self.process.wait(robots.PATIENCE_S) == 7
        shown = [int(line) for line in self.out.read_text().splitlines()]
        errors = [line for line in self.err.read_text().splitlines() if not line.startswith("failover: ")]
        assert shown == list(range(len(shown)))
        assert [int(line) for line in errors] == [-number for number in shown]


@contextmanager
def waiting(robot: RobotMachine, directory: Path) -> Iterator[Waiting]:
    run = Waiting(robot, directory)
    try:
        robots.until(lambda: robots.component(robot, "told").get("protection") == "protected", "a checkpoint")
        yield run
    finally:
        with contextlib.suppress(ProcessLookupError):
            run.process.kill()
        run.process.wait()


def test_run_goes_on_waiting_when_its_agent_is_killed_and_started_again(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, HOLD) as (first, _), waiting(first, tmp_path) as run:
        for names in (("worker",), ("main_loop",), ("main_loop", "worker")):
            kill(first, names)
            if "main_loop" in names:
                revived(first, names)
            run.expect_more()
        assert robots.component(first, "told")["restores"] == 0
        run.expect_the_end()


def written(robot: RobotMachine) -> bytes:
    """All that its copy wrote to standard output, shown to anybody or not."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    return log.read_bytes()


def test_an_agent_that_comes_back_after_a_takeover_ends_the_copy_that_outlived_it_and_run_goes_on(tmp_path: Path) -> None:
    """Of what the old copy wrote after the checkpoint that the other robot resumed from, nothing is in the output."""
    with robots.two_robots(tmp_path) as (first, second), waiting(first, tmp_path) as run:
        program = robots.host_pid(first, robots.component(first, "told")["pid"])
        run.expect_more()
        kill(first, ("main_loop", "worker"))
        robots.until(lambda: robots.component(second, "told").get("restores") == 1, "robot2 to take over")
        standing, begun = written(first), len(written(second))
        robots.until(lambda: len(written(second)) > begun + MORE, "robot2 to count on")
        assert written(first) == standing, "the old copy stood still before the new one ran"
        assert Path(f"/proc/{program}").exists()
        revived(first, ("main_loop", "worker"))
        robots.until(lambda: not Path(f"/proc/{program}").exists(), "the old copy to be ended")
        robots.until(lambda: list((first.directory / "state" / "lost").glob("*.snapshot")), "what became of it, for inspection")
        run.expect_more()
        shown = robots.component(second, "told")
        assert (shown["role"], shown["restores"]) == ("primary", 1)
        run.expect_the_end()
        for robot in (first, second):
            counted = [int(line) for line in robots.output(robot, "told").split()]
            assert counted == list(range(len(counted))), robot.name
