"""Items of robots of other sites: questions that come late or close together, other boards, unsound answers."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

import failover
from agent.config import Settings
from agent.errors import RefusedError
from agent.worker import board_directory
from agent.worker.far_items import ANSWERS_WAITING, Answer, FarItems
from failover.boards import directory
from failover.boards.mapping import MappedFile
from failover.config import team
from failover.core.frames.frame import Portion
from failover.errors import BoardError
from tests.agent.worker.test_board_directory import BALL, folder, found, loaded

__all__ = ["folder", "found"]

BALL_VALUE = bytes(8)


class Lines:
    """The line to robot2, which gives the answers of the test."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.asked: list[int] = []
        self.answer: Callable[[], Answer | dict[str, Any]] = dict

    @property
    def errands(self) -> Any:
        return self

    def hindrance(self, _peer: str) -> str:
        return ""

    async def send(self, _peer: str, _verb: str, question: dict[str, Any], patience_s: float = 0) -> dict[str, Any]:
        """As `Errands.send`."""
        self.asked.append(question["got"])
        answer: dict[str, Any] = msgspec.to_builtins(self.answer(), builtin_types=(bytes,))
        return answer


@pytest.fixture
def place(folder: Path, found: None) -> Path:
    """Of robot1's board, in a team that has robot2 at another site."""
    settings = loaded(folder, BALL)
    known = team.read(folder / "team")
    moved = {name: robot if name == "robot1" else robot.at("hall") for name, robot in known.robots.items()}
    team.write(folder / "team", replace(known, robots=moved))
    place = board_directory.provide(settings)
    assert place is not None
    return place


def put(x: float) -> None:
    with failover.board() as board:
        board.item("ball").put({"x": x, "y": 0.0})


def sizes(answers: list[dict[str, Any]]) -> list[int]:
    return [len(answer["items"]) for answer in answers]


def test_questions_that_come_close_together_wait_and_nothing_is_sent_twice(folder: Path, place: Path) -> None:
    """A packet is lost, and TCP brings the question late: just before the next one."""
    put(1)

    async def ask() -> list[dict[str, Any]]:
        items = FarItems(Lines(loaded(folder)), place, 1)
        first = await items.told("robot2", {"got": 0})
        later = await asyncio.gather(*(items.told("robot2", {"got": first["number"]}) for _ in range(2)))
        with pytest.raises(RefusedError, match="more often than every"):
            await asyncio.gather(*(items.told("robot2", {"got": 1}) for _ in range(ANSWERS_WAITING + 2)))
        items.close()
        return [first, *later]

    assert sizes(asyncio.run(ask())) == [1, 0, 0]


def test_a_robot_with_another_board_is_sent_no_values(folder: Path, place: Path) -> None:
    put(1)

    async def ask() -> list[dict[str, Any]]:
        items = FarItems(Lines(loaded(folder)), place, 1)
        told = [await items.told("robot2", {"got": 0, "board": board}) for board in (items._board + 1, items._board)]
        items.close()
        return told

    other, ours = asyncio.run(ask())
    assert sizes([other, ours]) == [0, 1] and other["board"] == ours["board"]


def test_a_refused_question_forgets_nothing_and_an_unsound_answer_ends_nothing(
    folder: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def live() -> None:
        lines = Lines(loaded(folder))
        items = FarItems(lines, place, 1)
        (one,) = items._far.values()

        async def asked(answer: Callable[[], Answer | dict[str, Any]]) -> int:
            lines.answer = answer
            await items._ask("robot2", one)
            return lines.asked[-1]

        def refuses() -> Answer:
            raise RefusedError("too often")

        def values(number: int, put: int) -> Callable[[], Answer]:
            ball = number_of_ball(place)
            return lambda: Answer(number, 1, items._board, (Portion(ball, 0, put, BALL_VALUE),))

        assert await asked(values(7, 1)) == 0
        assert await asked(refuses) == 7
        assert await asked(lambda: {"number": "x"}) == 7, "it has not forgotten what robot2 has told"
        assert "items of robot2 are not read" in items.notes()[0]
        assert await asked(values(8, (1 << 64) - 1)) == 7
        assert not items.notes()

        def damaged(*_: object) -> None:
            raise BoardError("the table is damaged")

        with monkeypatch.context() as patch:
            patch.setattr(one.items, "take", damaged)
            assert await asked(values(9, 2)) == 8
        assert "the table is damaged" in items.notes()[0]
        assert await asked(values(10, 3)) == 8 and not items.notes()
        items.close()

    asyncio.run(live())


def number_of_ball(place: Path) -> int:
    (record,) = MappedFile.open(place / "own").records()
    return record.id


def test_a_board_that_cannot_be_opened_leaves_no_descriptor(folder: Path, place: Path) -> None:
    (place / f"{directory.PEER_PREFIX}robot2").write_bytes(b"no board")
    before = set(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(BoardError):
            FarItems(Lines(loaded(folder)), place, 1)
    assert len(os.listdir("/proc/self/fd")) <= len(before)
