"""``failover run`` waits for its program: through deaths of its agent, and when the program has gone to the other robot."""

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
        for names in (("lanes",), ("heart",), ("heart", "lanes")):
            kill(first, names)
            if "heart" in names:
                revived(first, names)
            run.expect_more()
        assert robots.component(first, "told")["restores"] == 0
        run.expect_the_end()


def test_run_goes_on_waiting_when_its_program_was_taken_over_meanwhile(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second), waiting(first, tmp_path) as run:
        run.expect_more()
        kill(first, ("heart", "lanes"))
        robots.until(lambda: robots.component(second, "told").get("restores") == 1, "robot2 to take over")
        revived(first, ("heart", "lanes"))
        run.expect_more()
        assert robots.component(second, "told")["role"] == "primary"
        run.expect_the_end()
