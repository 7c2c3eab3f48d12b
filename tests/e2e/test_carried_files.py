"""Carried files across two robots with separate file trees: killed at random moments, database and memory agree on the other."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import RobotMachine, Stage, means
from tests.checkpoint.test_carried_files import COUNTER
from tests.e2e.robots import LOG_LINES, connected, mistake, numbers, output, result, until, until_protected

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or not means().own_pids, reason="needs root: each robot has a file tree of its own in its mount namespace"
)


class OwnTrees(Stage):
    """Robots that see another folder of their own at the same path."""

    def command(self, name: str, config: Path) -> list[str]:
        """See `Stage.command`."""
        disk = self.directory / name / "disk"
        disk.mkdir(exist_ok=True)
        here = self.directory / "here"
        here.mkdir(exist_ok=True)
        lay = 'mount --make-rprivate / && mount --bind "$0" "$1" && shift 1 && exec "$@"'
        return ["unshare", "--mount", "sh", "-c", lay, str(disk), str(here), *super().command(name, config)]


@contextmanager
def robots(directory: Path, settings: str = "") -> Iterator[tuple[RobotMachine, RobotMachine, Path]]:
    """robot1 and robot2, and the folder that each has for itself."""
    with OwnTrees(directory / "stage", replace(means(), own_network=False), settings) as stage:
        stage.directory.mkdir()
        stage.start()
        first, second = stage.robots
        try:
            until(lambda: connected(first) and connected(second), "the robots to hear each other")
            yield first, second, stage.directory / "here"
            assert not mistake(second)
        finally:
            for robot in stage.robots:
                print(f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-LOG_LINES:], sep="\n")


def run_carrying(robot: RobotMachine, name: str, carry: list[str], *argv: str, engine: str = "ptrace") -> dict[str, Any]:
    """Start a program under protection with what travels with it."""
    with robot.control() as link:
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C"}
        return link.ask("run", argv=list(argv), name=name, env=environment, cwd="/", wait=False, engine=engine, carry=carry)


def disk(robot: RobotMachine) -> Path:
    """The folder of a robot, as we see it."""
    return robot.directory / "disk"


@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_a_database_goes_on_at_a_robot_that_never_had_it(tmp_path: Path, mode: str) -> None:
    """Power is cut at a random moment; on the other robot nothing acknowledged is missing, and memory and database agree."""
    seed = random.randrange(1 << 32)
    print("seed", seed)
    with robots(tmp_path) as (first, second, here):
        path = here / "data" / "steps.db"
        (disk(first) / "data").mkdir()
        started = run_carrying(first, "count", [str(here / "data")], sys.executable, str(COUNTER), str(path), mode, "400")
        assert not started["reasons"], started
        until_protected(first)
        seen = random.Random(seed).randrange(20, 200)
        until(lambda: len(numbers(first)) > seen, f"{seen} steps")
        acknowledged = numbers(second)
        first.cut_power()
        ended = result(second, "count")
        lines = output(second, "count").decode().split()
        assert ended["exit_status"] == 0, lines[-3:]
        assert lines == [*map(str, range(1, 401)), "ok"]
        assert len(acknowledged) > 0
        assert (disk(second) / "data" / "steps.db").exists()
