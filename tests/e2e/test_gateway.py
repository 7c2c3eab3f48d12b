"""The worst case: a whole robot stands still, guard included, is replaced, and resumes: the actuator obeys it no more."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = pytest.mark.root

ROOT = Path(__file__).parents[2]
GRIPPER = (sys.executable, str(ROOT / "examples" / "gripper.py"))
MORE = 20
"""Commands that show that it is driven."""

Command = tuple[int, int, str]


@contextmanager
def gripper(directory: Path) -> Iterator[Path]:
    """The actuator of the example: where it writes what it obeyed and refused."""
    said = directory / "said"
    with said.open("wb") as output:
        process = subprocess.Popen([*GRIPPER, "serve", str(directory / "gripper"), str(directory / "epoch")], stdout=output)
    try:
        robots.until(lambda: (directory / "gripper").exists(), "the gripper to listen")
        yield said
    finally:
        process.kill()
        process.wait()


def commands(said: Path) -> list[Command]:
    """Epoch and step of each, and whether it was obeyed."""
    words = [line.split(maxsplit=2) for line in said.read_text().splitlines()]
    return [(int(epoch), int(step), answer.partition(":")[0]) for epoch, step, answer in words]


def obeyed(said: Path) -> list[Command]:
    return [command for command in commands(said) if command[2] == "obeyed"]


def stand_still(robot: RobotMachine) -> list[int]:
    """Stop all of it, at one instant as far as anybody can see; its processes, the programs last."""
    stopped: list[int] = []
    while fresh := [pid for pid in robot.processes() if pid not in stopped]:
        for pid in fresh:
            with contextlib.suppress(ProcessLookupError):  # it was about to end
                os.kill(pid, signal.SIGSTOP)
        stopped += fresh
    return stopped


def test_an_old_primary_that_wakes_up_as_a_whole_moves_nothing(tmp_path: Path) -> None:
    with gripper(tmp_path) as said, robots.two_robots(tmp_path) as (first, _):
        robots.run(first, "drive", *GRIPPER, "drive", str(tmp_path / "gripper"), cwd=str(ROOT), engine="cooperative")
        robots.until_protected(first, "drive")
        robots.until(lambda: len(obeyed(said)) > MORE, "the gripper to be driven")
        program = robots.host_pid(first, robots.component(first, "drive")["pid"])
        old = obeyed(said)[-1][0]
        stopped = stand_still(first)
        try:
            robots.until(lambda: obeyed(said)[-1][0] > old, "robot2 to drive")
            before = len(obeyed(said))
            os.kill(program, signal.SIGCONT)  # the program alone, before its guard can freeze it
            robots.until(lambda: [one for one in commands(said) if one[2] == "refused"], "a command of the old copy")
            robots.until(lambda: len(obeyed(said)) > before + MORE, "robot2 to drive on")
        finally:
            for pid in stopped:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
        robots.until(lambda: not Path(f"/proc/{program}").exists(), "the old copy to be ended")
        robots.until(lambda: robots.component(first, "drive").get("primary") == "robot2", "robot1 to know who drives")
        epochs = [epoch for epoch, _, _ in obeyed(said)]
        assert epochs == sorted(epochs), "once the new one was obeyed, the old one was not"
        assert {epoch for epoch, _, answer in commands(said) if answer == "refused"} == {old}
