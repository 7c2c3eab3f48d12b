"""The item of a component over a takeover: robot1 loses its power, and a reader at robot2 reads on."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.boards.board import Board
from failover.core.board.banks import EPOCH_SHIFT, Reading
from failover.errors import BoardError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_board import board_of, two_with_boards

ROOT = Path(__file__).parents[2]
PROGRAM = """
import time, failover
board = failover.board()
item = board.item("map")
count = 0
while True:
    count += 1
    item.put(["count", count])
    time.sleep(0.01)
"""


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with two_with_boards(tmp_path, monkeypatch) as both:
        yield both


@pytest.mark.root
def test_a_reader_reads_on_over_a_power_cut_and_sees_no_older_copy(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    link = tmp_path / "board"  # on real robots both boards are found by one path
    link.symlink_to(board_of(first).resolve())
    with Board(board_of(second), "earlier") as earlier:
        earlier.item("map").put(["left over"])  # as if the component had run here long ago
    environment = {"FAILOVER_BOARD": str(link), "PYTHONPATH": str(ROOT)}
    robots.run(first, "count", sys.executable, "-c", PROGRAM, env=environment)
    robots.until_protected(first)
    name = robots.component(first, "count")["name"]
    readings: list[Reading] = []
    ends = threading.Event()
    trouble: list[BaseException] = []

    def read() -> None:
        try:
            with Board(board_of(second), "reads") as board:
                item = board.item("map").of(name)
                while not ends.is_set():
                    readings.append(item.wait(after=readings[-1].number if readings else 0, timeout=60))
        except (BoardError, TimeoutError) as error:
            trouble.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        robots.until(lambda: len(readings) > 20 or trouble, "readings of robot1")
        assert {reading.robot for reading in readings} == {"robot1"}
        aside = tmp_path / "aside"
        aside.symlink_to(board_of(second).resolve())
        os.replace(aside, link)
        first.cut_power()
        robots.until_taken_over(second)
        robots.until(lambda: trouble or readings[-1].robot == "robot2", "readings of robot2")
        some = len(readings)
        robots.until(lambda: trouble or len(readings) > some + 20, "more readings of robot2")
    finally:
        ends.set()
        reader.join()
    assert not trouble
    whose = [reading.robot for reading in readings]
    assert whose == ["robot1"] * whose.index("robot2") + ["robot2"] * (len(whose) - whose.index("robot2"))
    numbers = [reading.number for reading in readings]
    assert numbers == sorted(set(numbers))
    assert all(reading.number >> EPOCH_SHIFT > 0 for reading in readings)
    assert all(reading.value[0] == "count" for reading in readings)
    last, new = readings[whose.index("robot2") - 1], readings[whose.index("robot2")]
    assert new.number >> EPOCH_SHIFT > last.number >> EPOCH_SHIFT
