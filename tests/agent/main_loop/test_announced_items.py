"""Items that a program adds at one robot: at the other one with the next frame, and whole whenever its agent is killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agent.main_loop.board_link import BoardLink
from failover.boards import directory
from failover.boards.mapping import MappedFile
from failover.boards.received import NO_ROOM
from failover.core.board import layout
from failover.core.board.announcements import ASK_ROUNDS, QUESTION, WORD_ROUNDS
from failover.core.board.items import Item
from failover.errors import BoardError, NeverWrittenError
from tests.agent.main_loop.test_board_link import ROUND_NS, TEAM, Robot, made, place_of


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Robot, Robot]]:
    monkeypatch.setattr(directory, "SHARED_MEMORY", tmp_path)
    both = tuple(Robot(name) for name in TEAM.names)
    both[0].says()  # the table as it was before the test
    yield both[0], both[1]
    for robot in both:
        robot.close()


def rounds(pair: tuple[Robot, Robot], count: int) -> None:
    """Frames both ways; a main loop looks at the table at each one, not a tenth of a second after the last look."""
    first, second = pair
    for _ in range(count):
        first.link._own._looked_ns = second.link._own._looked_ns = None
        second.hears(first.says())
        first.hears(second.says())


def test_an_item_that_a_program_adds_is_readable_at_the_other_robot_with_the_next_frame(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    goal = first.program.add(Item("goal", {"x": "f4"}, period=2))
    goal.put({"x": 1.5})
    rounds(pair, 2)
    reading = second.program.item("goal").get("robot1")
    assert (reading.value, reading.robot) == ({"x": 1.5}, "robot1")
    record = MappedFile.open(place_of("robot2") / "peer-robot1").record("goal")
    assert record is not None and (record.id, record.period, record.flags) == (1024, 2, layout.ADDED)
    with pytest.raises(BoardError, match="robot2 has no item 'goal'"):
        second.program.item("goal").get()


def test_a_removed_item_is_gone_there_too_and_one_of_its_name_is_another_item(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    first.program.add(Item("goal", size=8)).put(b"one")
    rounds(pair, 2)
    item = second.program.item("goal")
    assert item.get("robot1").value == b"one"
    first.program.remove("goal")
    rounds(pair, 1)
    with pytest.raises(BoardError, match="has no item 'goal'"):
        item.get("robot1")
    first.program.add(Item("goal", "u8")).put(7)
    rounds(pair, 2)
    assert second.program.item("goal").get("robot1").value == 7
    assert not second.link.left_out()


def test_a_table_whose_frames_were_all_lost_is_asked_for(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    for number in range(40):
        first.program.add(Item(f"item{number}", "u8")).put(number)
    for _ in range(10):
        first.link._own._looked_ns = None
        first.says()
    rounds(pair, 4 * WORD_ROUNDS)
    assert [second.program.item(f"item{number}").get("robot1").value for number in range(40)] == list(range(40))


def test_an_agent_that_starts_again_has_them_still_and_values_that_it_has_are_not_put_again(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    first.program.add(Item("goal", "u8")).put(1)
    rounds(pair, 3)
    first.program.add(Item("more", "u8")).put(2)
    rounds(pair, 3)
    item = second.program.item("goal")
    assert item.get("robot1").number == 1
    second.link.close()
    second.link = BoardLink.open(made(place_of("robot2"), "robot2"), ROUND_NS)
    assert item.get("robot1").value == 1
    rounds(pair, 2 * WORD_ROUNDS)
    assert (item.get("robot1").value, second.program.item("more").get("robot1").value) == (1, 2)


def test_readers_read_on_while_the_file_becomes_longer(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    handles = []
    for number in range(80):
        handles.append(first.program.add(Item(f"item{number}", size=4000)))
        handles[-1].put(number.to_bytes(2, "little"))
        if number % 20 == 0:
            rounds(pair, 2)
    rounds(pair, 16)
    found = [second.program.item(f"item{number}").get("robot1").value for number in range(80)]
    assert found == [number.to_bytes(2, "little") for number in range(80)]
    before = second.program.item("item0").get("robot1").number
    handles[0].put(b"again")
    rounds(pair, 1)
    assert second.program.item("item0").wait("robot1", after=before, timeout=60).value == b"again"


def test_what_has_no_room_is_refused_and_counted_and_all_else_goes_on(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    file = MappedFile.open(place_of("robot2") / "peer-robot1", writable=True)
    with file.changing():
        while file.read_header().count < file.read_header().capacity - 1:
            number = file.read_header().count
            file.add(layout.Wanted(number + 60_000, f"full{number}", 8, text="bytes[8]"))
    file.close()
    first.program.add(Item("goal", "u8")).put(1)
    first.program.add(Item("more", "u8")).put(2)
    rounds(pair, 3)
    assert second.program.item("goal").get("robot1").value == 1
    with pytest.raises(BoardError, match="has no item 'more'"):
        second.program.item("goal")._board.item("more")
    assert second.link.left_out()[NO_ROOM] == 1
    rounds(pair, 3 * WORD_ROUNDS)
    assert second.link.left_out()[NO_ROOM] == 1


def test_an_item_declared_at_that_robot_keeps_its_name(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    file = MappedFile.open(place_of("robot1") / "own", writable=True)
    with file.changing():
        file.remove(next(record for record in file.records() if record.name == "ball"))
    file.close()
    first.program.add(Item("ball", "u8")).put(1)  # a program that scribbles: declared ones cannot be removed by `remove` alike
    rounds(pair, 3)
    with pytest.raises(NeverWrittenError):
        second.program.item("ball").get("robot1")
    assert second.link.left_out()[NO_ROOM] == 1


# --- Killed ----------------------------------------------------------------------------------------------------------


class _Killed:
    """Ends this process with SIGKILL at the n-th step of a change of a table."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def step(self, act: Callable[..., object]) -> Callable[..., object]:
        def stepped(*arguments: object) -> object:
            self.left -= 1
            if self.left < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return act(*arguments)

        return stepped


def test_an_agent_killed_at_any_step_of_an_addition_leaves_the_table_whole_and_the_next_one_completes_it(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = pair
    first.program.add(Item("one", "u8")).put(1)
    rounds(pair, 3)
    steps = 0
    for steps in range(40):
        name = f"goal{steps}"
        first.program.add(Item(name, "u8")).put(steps)
        first.link._own._looked_ns = None
        frame = first.says()
        child = os.fork()
        if child == 0:
            killed = _Killed(steps)
            monkeypatch.setattr(os, "pwrite", killed.step(os.pwrite))
            monkeypatch.setattr(os, "posix_fallocate", killed.step(os.posix_fallocate))
            second.hears(frame)
            os._exit(0)
        second.link.close()
        _, status = os.waitpid(child, 0)
        peer = MappedFile.open(place_of("robot2") / "peer-robot1", writable=False)
        names = [record.name for record in peer.records()]
        assert names.count("one") == 1 and len(names) == len(set(names))
        assert second.program.item("one").get("robot1").value == 1
        second.link = BoardLink.open(place_of("robot2"), ROUND_NS)
        rounds(pair, 2 * WORD_ROUNDS)
        assert peer.generation % 2 == 0
        assert second.program.item(name).get("robot1").value == steps
        if status == 0:
            break
    assert steps > 3


def test_a_question_goes_once_over_each_medium_and_is_counted_by_rounds(pair: tuple[Robot, Robot]) -> None:
    """A robot may hear but one of them."""
    first, second = pair
    first.program.add(Item("goal", "u8")).put(1)
    for _ in range(10):
        first.link._own._looked_ns = None
        first.says()
    while (first.round + 1) % WORD_ROUNDS:
        first.says()
    second.hears(first.says())
    asked: dict[int, list[int]] = {0: [], 1: [], 2: []}
    for round_ in range(second.round + 1, second.round + 2 * ASK_ROUNDS):
        for medium in asked:
            due = second.link.due(round_, 0, medium)
            asked[medium] += [round_ for portion in due if portion.number == QUESTION]
    assert asked == {medium: [second.round + ASK_ROUNDS] for medium in (0, 1, 2)}
