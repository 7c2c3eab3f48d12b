"""Simulated robots beside real ones: a program that drives one outlives its robot; guests are on the board and have no vote."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.boards.board import Board
from failover.core.naming import worlds
from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_board import board_of, two_with_boards
from tests.failover.simulators.test_simulation import simulated

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "examples" / "cruise.py"
ENGINE = "Simulated/University/Lab/Robotino/Engines/3/PWM"

WORLD = """
[labs.Lab]
size = [6, 6]
[robots.Robotino]
lab = "Lab"
at = [3, 3]
controller = "none"
[robots.robot2]
lab = "Lab"
at = [1, 1]
"""
"""The second one has the name of a member of the team."""


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with two_with_boards(tmp_path, monkeypatch) as both:
        yield both


def test_a_protected_program_drives_a_simulated_robot_on_after_its_own_robot_is_lost(
    pair: tuple[RobotMachine, RobotMachine], tmp_path_factory: pytest.TempPathFactory
) -> None:
    first, second = pair
    place = tmp_path_factory.mktemp("w")
    (place / "world.toml").write_text(WORLD)
    (place / "m").mkdir(mode=0o700)
    usual = {DIRECTORY: str(place / "m"), ROBOT: "field", TEAM: "", "PYTHONPATH": str(ROOT)}  # devices of neither robot alone
    there = {**os.environ, **usual, "FAILOVER_SOCKET": str(second.socket)}
    there.pop(worlds.VARIABLE, None)
    peers = second.status()["peers"]
    with simulated("--world", str(place / "world.toml"), environment=there) as process:
        with Board(board_of(second), "test") as board:
            assert list(board.robots()) == ["robot2", "robot1"]
            assert list(board.guests()) == ["Simulated.Robotino", "Simulated.robot2"]
            pose = board.item("pose").get("Simulated.robot2")
            assert board.item("pose").wait("Simulated.robot2", after=pose.number, timeout=60).number > pose.number
        robots.run(
            first, "cruise", sys.executable, str(PROGRAM), engine="cooperative", env={**usual, worlds.VARIABLE: "Simulated"}
        )
        robots.until(lambda: len(steps(first)) > 10, "some steps")
        robots.until_protected(first, "cruise")
        first.cut_power()
        robots.until_taken_over(second, "cruise")
        before = steps(second)[-1]
        robots.until(lambda: steps(second)[-1] > before + 5, "it to drive on")
        walked = steps(second)
        assert walked == list(range(1, len(walked) + 1)), "each step once, in order"
        here = Here("field", place / "m")
        with Proxy(here, lookup(here, ENGINE)) as engine:
            assert engine.call("read", timeout=60)["moves"] >= walked[-1] - 1
        assert [one["name"] for one in second.status()["peers"]] == [one["name"] for one in peers], "guests have no vote"
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60)
        assert process.returncode in (0, 1) and "digest" in out and "Traceback" not in err
    with Board(board_of(second), "test") as board:
        assert not board.guests()
    tasks = subprocess.run(
        [sys.executable, "-m", "failover", "ps", "--json"], capture_output=True, text=True, check=False, env=there, timeout=60
    )
    assert not [one for one in json.loads(tasks.stdout)["tasks"] if one["task"].startswith("Simulated")]


def steps(robot: RobotMachine) -> list[int]:
    """The numbers of the steps that the program has told, as that robot has its output."""
    return [
        int(found[1]) for line in robots.output(robot, "cruise").decode().splitlines() if (found := re.match(r"(\d+) ", line))
    ]
