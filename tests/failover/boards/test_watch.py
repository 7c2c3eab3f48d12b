"""One sleep for several items, of this robot's files and another robot's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.boards import directory, futex, watch
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.errors import BoardError
from tests.failover.boards.programs import program


@pytest.fixture
def board(place: Path) -> Iterator[Board]:
    with failover.board() as opened:
        opened.add(Item("one", size=8))
        opened.add(Item("two", size=8))
        opened.add(Item("mine", size=8, shared=False))
        yield opened


def test_it_gives_each_new_value_once_with_its_item(board: Board) -> None:
    one, two = board.item("one"), board.item("two")
    watched = board.watch(one, two)
    with pytest.raises(TimeoutError, match=r"none of the 2 items was put within 0\.01 s"):
        watched.wait(timeout=0.01)
    two.put(b"2")
    assert [(item.name, reading.value) for item, reading in watched.wait(timeout=60)] == [("two", b"2")]
    one.put(b"1")
    two.put(b"3")
    assert [(item.name, reading.value) for item, reading in watched.wait(timeout=60)] == [("one", b"1"), ("two", b"3")]
    with pytest.raises(TimeoutError):
        watched.wait(timeout=0)


PUTS = """
items = {name: board.item(name, bytes) for name in ('one', 'two', 'mine')}
say('begun')
while word := hear():
    items[word].put(word.encode())
"""


@pytest.mark.parametrize("is_old", [False, True], ids=["futex_waitv", "an older kernel"])
def test_a_put_of_any_of_them_wakes_it_whatever_its_file(board: Board, monkeypatch: pytest.MonkeyPatch, is_old: bool) -> None:
    if is_old:
        monkeypatch.setattr(futex, "WAITV", 100_000)  # the kernel has no such call
    else:
        monkeypatch.setattr(watch, "SLICE_S", 20.0)  # it is woken, or each turn takes so long
    robot2 = ReceivedItems(directory.make_peer(board.directory, "robot2", items={0: Item("ball", size=8)}))
    watched = board.watch(*(board.item(name) for name in ("one", "two", "mine")), (board.item("ball"), "robot2"))
    with program(PUTS) as other:
        other.hear()
        for turn in range(1, 4):
            for name in ("one", "mine", "two"):
                other.tell(name)
                assert [item.name for item, _ in watched.wait(timeout=60)] == [name]
            robot2.take([Portion(0, 0, turn, b"ball")], turn, 0, turn)
            assert [(item.name, reading.robot) for item, reading in watched.wait(timeout=60)] == [("ball", "robot2")]


def test_bad_watches_are_refused(board: Board) -> None:
    for count in (0, 129):
        with pytest.raises(BoardError, match=f"cannot watch {count} items"):
            board.watch(*[board.item("one")] * count)
    with pytest.raises(BoardError, match="no robot 'robot9'"):
        board.watch((board.item("one"), "robot9")).wait(timeout=0)
