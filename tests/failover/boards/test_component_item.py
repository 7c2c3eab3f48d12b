"""The item of a component: at whichever robot is its primary, and never an older copy's value in place of a newer one's."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from agent.main_loop.primaries import Primaries
from failover.boards import component_item, directory
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.core.board import layout
from failover.core.board.banks import EPOCH_SHIFT
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.errors import BoardError, NeverWrittenError

MAPPER = "/lab/robot1/mapper"
MAP = Item("map", "u8")


class Agent:
    """Of robot2: it tells who the primary is, and receives what robot1 and robot3 put."""

    def __init__(self, place: Path) -> None:
        place.mkdir()
        directory.make_file(place / "private", layout.PRIVATE, "robot2")
        directory.make_file(place / "own", layout.OWN, "robot2", items={0: MAP})
        table = Item("primaries", "msgpack", size=65536, shared=False)
        directory.make_file(place / "agent", layout.PEER, "robot2", items={0: table})
        self.place = place
        self.received = {}
        for robot in ("robot1", "robot3"):
            directory.make_file(place / f"peer-{robot}", layout.PEER, robot, items={0: MAP})
            self.received[robot] = ReceivedItems.open(place / f"peer-{robot}")
        self.primaries = Primaries.open(place)

    def tells(self, robot: str, epoch: int, name: str = MAPPER) -> None:
        self.primaries.tell({name: (robot, epoch), "/lab/robot3/other": ("robot3", 1)}, now())

    def gets(self, robot: str, number: int, value: int, age_us: int = 0) -> None:
        """The robot's put comes in a frame."""
        self.received[robot].take([Portion(0, age_us, number, value.to_bytes(8, "little"))], now(), 0, number & 0xFFFF)

    def close(self) -> None:
        self.primaries.close()
        for items in self.received.values():
            items.file.close()


def now() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def number(epoch: int, put: int) -> int:
    return (epoch << EPOCH_SHIFT) + put


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Agent]:
    made = Agent(tmp_path / "board")
    yield made
    made.close()


@pytest.fixture
def board(agent: Agent) -> Iterator[Board]:
    with failover.board(agent.place) as opened:
        yield opened


def test_it_is_read_at_the_primary_and_follows_a_takeover(agent: Agent, board: Board) -> None:
    item = board.item("map").of(MAPPER)
    agent.gets("robot3", number(9, 1), 99)  # its own mapper's
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 5), 1)
    first = item.get()
    assert (first.value, first.robot, first.number >> EPOCH_SHIFT, item.robot) == (1, "robot1", 2, "robot1")
    agent.tells("robot3", 10)
    assert item.get().value == 1  # until the new copy puts
    agent.gets("robot3", number(10, 1), 2)
    second = item.get()
    assert (second.value, second.robot) == (2, "robot3")
    assert second.number > first.number


def test_what_a_robot_put_in_an_earlier_primacy_is_not_shown_as_the_new_copys(agent: Agent, board: Board) -> None:
    agent.gets("robot3", number(1, 7), 1)
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 1), 2)
    reader = board.item("map").of(MAPPER)
    assert reader.get().value == 2
    agent.tells("robot3", 3)
    assert reader.get().value == 2
    with pytest.raises(NeverWrittenError, match="runs on robot3 under epoch 3, and has not put it there yet"):
        board.item("map").of(MAPPER).get()
    agent.gets("robot3", number(3, 1), 3)
    assert reader.get().value == board.item("map").of(MAPPER).get().value == 3


def test_a_copy_whose_epoch_grows_while_it_runs_is_read_on(agent: Agent, board: Board) -> None:
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 1), 1)
    agent.tells("robot1", 3)
    agent.gets("robot1", number(2, 2), 2)
    assert board.item("map").of(MAPPER).get().value == 2
    agent.primaries = Primaries.open(agent.place)  # the agent starts again
    agent.tells("robot1", 3)
    assert board.item("map").of(MAPPER).get().value == 2


def test_wait_follows_a_takeover_and_ends_although_the_numbers_of_the_new_copy_are_others(agent: Agent, board: Board) -> None:
    agent.tells("robot1", 2)
    agent.gets("robot1", number(2, 1000), 1)
    item = board.item("map").of(MAPPER)
    reading = item.wait(after=0, timeout=60)
    with pytest.raises(TimeoutError, match=f"item 'map' of {MAPPER} was not put within"):
        item.wait(after=reading.number, timeout=0.05)
    waits = threading.Thread(target=lambda: found.append(item.wait(after=reading.number, timeout=60).value))
    found: list[object] = []
    waits.start()
    agent.tells("robot2", 3)
    with failover.board(agent.place) as own:
        own.item("map").put(2)  # of no epoch, but put since it runs here
    waits.join()
    assert found == [2]


def test_a_component_that_the_agent_does_not_know_names_the_nearest(agent: Agent, board: Board) -> None:
    item = board.item("map").of("/lab/robot1/maper")
    with pytest.raises(BoardError, match="knows no robot that runs '/lab/robot1/maper'"):
        item.get()
    agent.tells("robot1", 2)
    with pytest.raises(BoardError, match="mapper"):
        item.get()


def test_without_an_agent_it_says_so(place: Path) -> None:
    with failover.board() as alone:
        item = alone.add(MAP).of(MAPPER)
        with pytest.raises(BoardError, match="no agent has made the board"):
            item.get()


def test_a_table_with_more_components_than_it_holds_leaves_some_out_and_says_how_many(agent: Agent, board: Board) -> None:
    names = {f"/lab/robot1/{'x' * 180}{place:04}": ("robot1", place + 1) for place in range(1024)}
    agent.primaries.tell(names, now())
    assert 0 < agent.primaries.left_out < 900
    assert board.primary(next(iter(names))).robot == "robot1"


@pytest.mark.parametrize("content", [b"\x81\xa1a\x81\xa1x" + b"\x91" * 12_000, b"\x81\xa1\xff\xc0", b"\xc1", b""])
def test_a_table_of_primaries_that_is_none_is_told(content: bytes) -> None:
    with pytest.raises(BoardError, match="damaged: the agent's table of primaries"):
        component_item.decode(content)
