"""The board of two real agents: made at their start, used by programs, kept over the death of an agent."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.cli.demo.robots import RobotMachine, Stage
from tests.e2e import robots

BOARD = """
[board.items.ball]
type = { x = "f4", y = "f4" }
"""


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    """Two robots whose team file declares a ball."""
    write_team = Stage._write_team

    def with_board(stage: Stage) -> None:
        write_team(stage)
        files = list(stage.directory.rglob("team.toml"))
        assert files
        for path in files:
            path.write_text(path.read_text() + BOARD)

    monkeypatch.setattr(Stage, "_write_team", with_board)
    places: set[Path] = set()
    with robots.two_robots(tmp_path) as both:
        places |= {(robot.socket.parent / "board").resolve() for robot in both}
        yield both
    for place in places:
        shutil.rmtree(place)


def test_programs_of_each_robot_have_its_board_and_it_outlives_the_agent(
    pair: tuple[RobotMachine, RobotMachine], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = pair
    monkeypatch.delenv("FAILOVER_BOARD", raising=False)
    boards = []
    for robot in pair:
        monkeypatch.setenv("FAILOVER_SOCKET", str(robot.socket))
        boards.append(failover.board())
    with boards[0] as board, boards[1] as other:
        assert [one.robot for one in boards] == [first.name, second.name]
        assert list(board.robots()) == [first.name, second.name]
        item = board.item("ball")
        item.put({"x": 1.0, "y": 2.0})
        with pytest.raises(failover.NeverWrittenError):
            other.item("ball").get()
        assert not [note for note in first.status()["notes"] if "board" in note]
        worker = first.status()["lanes_pid"]
        robots.until(lambda: killed(first, worker), "the worker to be killed")
        robots.until(lambda: worker_of(first) not in (0, worker), "another worker")
        assert item.get().number == 1
        item.put({"x": 3.0, "y": 4.0})
        assert board.item("ball").get().number == 2


def worker_of(robot: RobotMachine) -> int:
    try:
        return int(robot.status()["lanes_pid"])
    except robots.NO_ANSWER:
        return 0


def killed(robot: RobotMachine, inner_pid: int) -> bool:
    """Kill the robot's process that has this pid in its own namespace."""
    for pid in robot.processes():
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("NSpid:") and line.split()[-1] == str(inner_pid):
                os.kill(pid, signal.SIGKILL)
                return True
    return False
