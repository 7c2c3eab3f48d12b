"""Items that programs add while they run, over two real agents: readable at the other robot, and whole after a kill."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.core.board.items import Item
from failover.errors import BoardError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_board import board_of, two_with_boards
from tests.include.board_programs import tool
from tests.include.programs import has as has_program

KILLS = int(os.environ.get("FAILOVER_KILLS", "4"))
"""Of an agent, while items are added at the other robot."""


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with two_with_boards(tmp_path, monkeypatch) as both:
        yield both


def value(board: Board, name: str, robot: str = "robot1") -> object:
    """The newest value; None before there is one."""
    try:
        return board.item(name).get(robot).value
    except BoardError:
        return None


def test_an_item_that_a_program_adds_is_readable_at_the_other_robot_until_it_removes_it(
    pair: tuple[RobotMachine, RobotMachine],
) -> None:
    with Board(board_of(pair[0]), "one") as one, Board(board_of(pair[1]), "two") as two:
        goal = one.add(Item("goal", {"x": "f8", "y": "f8"}, period=2))
        goal.put({"x": 1.0, "y": 2.0})
        robots.until(lambda: value(two, "goal") == {"x": 1.0, "y": 2.0}, "the item at robot2")
        two.add(Item("goal", "u4")).put(7)  # each robot's items are its own
        robots.until(lambda: value(one, "goal", "robot2") == 7, "robot2's item at robot1")
        assert value(two, "goal") == {"x": 1.0, "y": 2.0}
        reading = two.item("goal").get("robot1")
        goal.put({"x": 3.0, "y": 4.0})
        assert two.item("goal").wait("robot1", after=reading.number, timeout=60).value == {"x": 3.0, "y": 4.0}
        one.remove("goal")
        robots.until(lambda: "goal" not in [r.name for r in peer_of(pair[1]).records()], "its removal at robot2")
        assert value(two, "goal", "robot2") == 7
        one.add(Item("goal", "msgpack", size=100)).put(["another"])
        robots.until(lambda: value(two, "goal") == ["another"], "an item of the same name and another type")
        assert not any("added" in reason for reason in pair[1].status()["beats"].get("items", {}))


@pytest.mark.compiler
@pytest.mark.skipif(not has_program("cc"), reason="no C compiler")
def test_an_item_that_a_program_in_c_adds_is_readable_at_the_other_robot(pair: tuple[RobotMachine, RobotMachine]) -> None:
    with tool(board_of(pair[0])) as c, Board(board_of(pair[1]), "two") as two:
        c.ok("add", "ccc", 16)
        c.ok("find", "ccc", 16)
        c.ok("put", "ccc", "hello")
        robots.until(lambda: value(two, "ccc") == b"hello", "the item at robot2")


def peer_of(robot: RobotMachine) -> MappedFile:
    return MappedFile.open(board_of(robot).resolve() / "peer-robot1", writable=False)


def test_an_agent_killed_while_items_come_has_its_table_whole_and_all_of_them_after_its_restart(
    pair: tuple[RobotMachine, RobotMachine],
) -> None:
    print("seed", seed := random.randrange(1 << 30))
    dice = random.Random(seed)
    robots.keep_on(pair[1])
    stops, count = threading.Event(), 0

    def add() -> None:
        nonlocal count
        with Board(board_of(pair[0]), "adds") as one:
            while not stops.is_set() and count < 900:
                one.add(Item(f"item{count}", "u4")).put(count)
                count += 1
                time.sleep(0.005)
            ended.wait()

    ended = threading.Event()
    adding = threading.Thread(target=add)
    adding.start()
    try:
        with Board(board_of(pair[1]), "two") as two:
            for _ in range(KILLS):
                before = len(peer_of(pair[1]).records())
                robots.until(lambda before=before: len(peer_of(pair[1]).records()) > before, "more items")
                time.sleep(dice.random() / 20)
                agent = robots.host_pid(pair[1], pair[1].status()["pid"])
                os.kill(agent, signal.SIGKILL)
                robots.until(lambda agent=agent: robots.has_ended(agent), "the agent to be gone")
                names = [record.name for record in peer_of(pair[1]).records()]
                assert len(names) == len(set(names))
                assert value(two, "item0") == 0
                robots.start_agent(pair[1])
                robots.until(lambda: robots.answers(pair[1]), "the next agent")
            stops.set()
            robots.until(lambda: all(value(two, f"item{number}") == number for number in range(count)), "all items")
            assert peer_of(pair[1]).generation % 2 == 0
    finally:
        stops.set()
        ended.set()
        adding.join()
    assert count > KILLS
