"""failover_board.h: an item removed, and the item of a component read at whichever robot is its primary."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from failover.boards.board import Board, board
from failover.boards.received import ReceivedItems
from failover.core.board import layout
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.errors import BoardError
from tests.failover.boards.test_component_item import MAPPER, Agent, now, number
from tests.failover.boards.test_component_item import agent as agent
from tests.include.board_programs import Tool, place_for_board, tool

pytestmark = pytest.mark.compiler


@pytest.fixture
def place() -> Iterator[Path]:
    with place_for_board() as found:
        yield found


# --- Remove ----------------------------------------------------------------------------------------------------------


def test_an_item_is_removed_for_c_and_python_and_its_name_is_free(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        c.ok("add", "goal", 8)
        c.ok("find", "goal", 8)
        c.ok("put", "goal", "first")
        assert python.item("goal").get().value == b"first"
        c.ok("remove", "goal")
        assert python.names() == []
        assert "no item goal" in c.say("get", "goal", "-") and "no item goal" in c.say("put", "goal", "x")
        with pytest.raises(BoardError, match="no item 'goal'"):
            python.item("goal")
        python.add(Item("goal", size=8)).put(b"second")
        assert c.say("get", "goal", "-").startswith("second age ")
        c.say("close")
        c.ok("open")
        assert python.names() == ["goal"], "what was removed is not added again"


def test_an_item_that_python_added_is_removed_and_its_writer_told(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        goal = python.add(Item("goal", size=8, shared=False))
        goal.put(b"x")
        c.ok("remove", "goal")
        with pytest.raises(BoardError, match="no item 'goal'"):
            goal.put(b"y")


def test_an_item_that_is_not_there_is_not_removed(place: Path) -> None:
    with board(place), tool(place) as c:
        assert "cannot remove item goal: this robot has none" in c.say("remove", "goal")
        assert "a name has 1 to 63 bytes" in c.say("remove", "g" * 64)


SLEEPS = {"230", "35", "115", "101"}
"""Numbers of clock_nanosleep and nanosleep on x86-64, and on aarch64."""


def test_a_table_that_is_damaged_before_the_item_is_removed_is_told(place: Path) -> None:
    with board(place) as python, tool(place) as c:
        python.add(Item("goal", size=8))
        file = python.ensured().own
        at = layout.RECORDS_AT + layout.BANKS_FIELD
        answers: list[str] = []
        asks = threading.Thread(target=lambda: answers.append(c.say("remove", "goal")))
        with file.changing():
            asks.start()
            while Path(f"/proc/{c.pid}/syscall").read_text().split()[0] not in SLEEPS:
                assert not answers, "it waits for the table, in which it has found the item"
            file.halves[at // 2] = 99
        asks.join()
        file.halves[at // 2] = 2
        assert len(answers) == 1 and "is damaged: record 0" in answers[0]
        assert python.names() == ["goal"]


# --- The item of a component -----------------------------------------------------------------------------------------


@pytest.fixture
def c(agent: Agent) -> Iterator[Tool]:
    with tool(agent.place) as started:
        started.ok("find", "map", 8)
        yield started


def read(c: Tool, *waiting: object) -> tuple[int, str, int]:
    """Value, robot, number."""
    words = c.say("of", "map", *waiting).split()
    assert words[2] == "number", words
    return int(words[0]), words[1], int(words[3])


def test_it_follows_a_takeover_and_gives_no_older_copys_value(agent: Agent, c: Tool) -> None:
    agent.gets("robot3", number(1, 1), 33, age_us=1_000_000)
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 1), 11)
    c.ok("follow", "map", MAPPER)
    assert read(c)[:2] == (11, "robot1")
    agent.gets("robot1", number(2, 2), 12)
    assert read(c)[:2] == (12, "robot1")
    agent.tells("robot3", 3)
    assert read(c)[:2] == (12, "robot1"), "the new copy has put nothing yet"
    agent.gets("robot3", number(3, 1), 34)
    value, robot, put = read(c)
    assert (value, robot) == (34, "robot3") and put > number(3, 0)
    agent.tells("robot2", 4)
    with Board(agent.place, "writer") as own:
        own.item("map").put(21)
        assert read(c)[:2] == (21, "robot2"), "since it runs there"


def test_what_a_copy_before_put_is_not_taken_for_the_running_ones(agent: Agent, c: Tool) -> None:
    agent.gets("robot3", number(1, 1), 33, age_us=1_000_000)
    agent.tells("robot3", 5)
    c.ok("follow", "map", MAPPER)
    assert "it runs on robot3 under epoch 5, and has not put it there yet" in c.say("of", "map")
    assert "was not put in time" in c.say("of", "map", 0, 50)


def test_a_waiting_reader_is_woken_by_the_primary_and_follows_it(agent: Agent, c: Tool) -> None:
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 1), 11)
    c.ok("follow", "map", MAPPER)
    _, _, put = read(c)

    def move() -> None:
        agent.tells("robot3", 3)
        agent.gets("robot3", number(3, 1), 34)

    later = threading.Timer(0.2, move)
    later.start()
    assert read(c, put, 60_000)[:2] == (34, "robot3")
    later.join()


def test_an_unknown_component_and_a_board_without_an_agent_are_told(agent: Agent, c: Tool, place: Path) -> None:
    c.ok("follow", "map", MAPPER)
    assert f"the agent knows no robot that runs {MAPPER}" in c.say("of", "map")
    agent.tells("robot1", 1, "/lab/robot1/another")
    assert f"the agent knows no robot that runs {MAPPER}" in c.say("of", "map")
    assert "a component is named by its path" in c.say("follow", "map", "x" * 300)
    with board(place) as python, tool(place) as alone:
        python.add(Item("map", "u8"))
        alone.ok("find", "map", 8)
        alone.ok("follow", "map", MAPPER)
        assert "no agent has made the board" in alone.say("of", "map")


@pytest.mark.parametrize(
    "content",
    [
        *(
            b"",
            b"\xc0",
            b"\x81",
            b"\x81\xa1",
            b"\x81\xa1x",
            b"\x81\xa1x\x93",
            b"\x81\xa1x\x92\xa1r\x01",
            b"\x81\xdb\xff\xff\xff\xff",
        ),
        *(
            b"\x81\xa1x\x93\xd9\xffr\x01\x01",
            b"\xdf\xff\xff\xff\xff",
            b"\x81\xa1x\x93\xa1r\xcf\x01",
            b"\x81\xa1x\x93\xa1r\xd0\x01\x01",
        ),
        *(
            msgspec.msgpack.encode({MAPPER: ["r" * 65, 1, 1]}),
            msgspec.msgpack.encode({MAPPER: ["r", 1]}),
            b"\x81\x01\x93\xa1r\x01\x01",
        ),
    ],
)
def test_a_damaged_table_is_told(agent: Agent, c: Tool, content: bytes) -> None:
    table = ReceivedItems.open(agent.place / "agent")
    assert table.take([Portion(0, 0, 1, content)], now(), 0, 0) == 1
    table.file.close()
    c.ok("follow", "map", MAPPER)
    assert "damaged: the agent's table of primaries" in c.say("of", "map")


def test_a_large_table_is_read(agent: Agent, c: Tool) -> None:
    others = {f"/laboratory/robot{index}/{'x' * (index % 40)}": ("robot3", index << 20) for index in range(700)}
    agent.primaries.tell(others | {MAPPER: ("robot1", 70_000)}, now())
    agent.gets("robot1", number(70_000, 1), 11)
    c.ok("follow", "map", MAPPER)
    assert read(c)[:2] == (11, "robot1")
