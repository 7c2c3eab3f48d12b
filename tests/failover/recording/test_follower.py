"""What is new on a board since the last look: each put once, over tables that change and boards that are made anew."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.core.board import layout
from failover.errors import BoardError
from failover.recording import follower
from failover.recording.follower import Choice, Follower
from tests.failover.boards.conftest import place as place

BALL = failover.Item("ball", size=8)


def seen(follower_: Follower) -> list[tuple[str, str, bytes, int]]:
    """Robot, item, value and missed puts of what is new."""
    return [(one.robot, one.record.name, one.found.value, one.missed) for one in follower_.look()]


@pytest.fixture
def board(place: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Board]:
    monkeypatch.setattr(follower, "LIST_S", 0.0)
    with failover.board() as opened:
        yield opened


def test_each_put_is_given_once_and_replaced_ones_are_counted(board: Board) -> None:
    ball = board.add(BALL)
    follower_ = Follower(board, Choice())
    assert seen(follower_) == []
    for value in (b"1", b"2", b"3"):
        ball.put(value)
    assert seen(follower_) == [(board.robot, "ball", b"3", 0)], "what was put before is not known"
    assert seen(follower_) == []
    for value in (b"4", b"5", b"6"):
        ball.put(value)
    assert seen(follower_) == [(board.robot, "ball", b"6", 2)]
    follower_.again()
    assert seen(follower_) == [(board.robot, "ball", b"6", 0)]
    ball.put(b"7")
    assert seen(follower_) == [(board.robot, "ball", b"7", 0)]


def test_items_and_robots_that_come_and_go_are_followed(board: Board) -> None:
    ball = board.add(BALL)
    ball.put(b"1")
    follower_ = Follower(board, Choice())
    assert len(seen(follower_)) == 1
    board.add(failover.Item("goal", size=4, shared=False)).put(b"g")
    assert seen(follower_) == [(board.robot, "goal", b"g", 0)], "the ball is not given again"
    board.remove("ball")
    board.add(failover.Item("ball", size=9)).put(b"another")
    assert seen(follower_) == [(board.robot, "ball", b"another", 0)]
    directory.make_peer(board.directory, "robot2", items={0: BALL})
    assert seen(follower_) == [] and list(follower_.robots()) == [board.robot, "robot2"]
    directory.dismiss(board.directory / "peer-robot2")
    assert seen(follower_) == [] and list(follower_.robots()) == [board.robot]


def test_a_board_that_an_agent_makes_anew_is_followed_and_never_made(place: Path) -> None:
    def make(value: bytes) -> None:
        for name, flags in (("private", layout.PRIVATE), ("own", layout.OWN)):
            directory.make_file(place / name, flags, "robot1", items={0: BALL} if flags == layout.OWN else {})
        with Board(place, "writer") as writer:
            writer.item("ball").put(value)

    place.mkdir()
    try:
        make(b"old")
        with failover.board() as board:
            follower_ = Follower(board, Choice(("robot1",), ("b*",)))
            assert seen(follower_) == [("robot1", "ball", b"old", 0)]
            for name in ("private", "own"):
                directory.dismiss(place / name)
            for _ in range(2):
                with pytest.raises(BoardError, match="is gone, and there is no other one yet"):
                    follower_.look()
            assert list(place.iterdir()) == [], "a look makes no board"
            make(b"new")
            assert seen(follower_) == [("robot1", "ball", b"new", 0)]
    finally:
        for one in place.iterdir():
            one.unlink()
        place.rmdir()


def test_a_file_whose_table_is_damaged_is_told_once_and_the_others_go_on(board: Board) -> None:
    ball = board.add(BALL)
    received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={0: BALL}))
    told: list[str] = []
    follower_ = Follower(board, Choice(), told.append)
    good = received.file.halves[(layout.RECORDS_AT + layout.BANKS_FIELD) // 2]
    for number, banks in enumerate((99, good, 99)):
        with received.file.changing():
            received.file.halves[(layout.RECORDS_AT + layout.BANKS_FIELD) // 2] = banks
        for value in (b"1", b"2"):
            ball.put(value)
            assert seen(follower_)[0][:3] == (board.robot, "ball", value)
        assert len(told) == (number + 2) // 2 and "peer-robot2" in told[0] and "has 99 banks" in told[0]
    assert [one.robot for one in Follower(board, Choice(), told.append).look()] == [board.robot] and len(told) == 3
