"""Items of another robot, as its receiver puts them: read with both bounds, woken for, refused when they do not fit."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path

import pytest

import failover
from failover.boards import directory
from failover.boards.received import ReceivedItems
from failover.core.board import layout, reception
from failover.core.board.ages import AGE_MAX_US
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.errors import NeverWrittenError

BALL = Item("ball", {"x": "f8"})
ONE, TWO = (layout.struct.pack("<d", number) for number in (1.0, 2.0))


def now() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def put(received: ReceivedItems, item: int, number: int, value: bytes, round_: int = 0, missing: int = 0) -> bool:
    """As a frame that comes now brings it."""
    return bool(received.take([Portion(item, 0, number, value)], now(), 0, round_, missing))


def test_a_frame_brings_a_value_with_its_age_and_an_upper_bound(place: Path) -> None:
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}, rank=1))
        came = now()
        received.heard(came)
        received.tell_state(layout.RUN)
        assert received.take([Portion(7, 20_000, 1, ONE)], came, 501, 9) == 1
        reading = ball.get("robot2")
        assert reading.value == {"x": 1.0} and not reading.stale
        assert 20_000_000 <= reading.age_ns <= now() - came + 20_000_000
        assert reading.age_max_ns == reading.age_ns + 501_000
        received.bound(lambda period: period * 20_000_001)
        assert ball.get("robot2").stale
        state = board.robots()["robot2"]
        assert state.state == "run" and state.age_ns is not None and state.age_ns <= now() - came


def test_a_bound_beyond_all_sense_is_none(place: Path) -> None:
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        received.bound(lambda period: 1 << 65)
        assert put(received, 7, 1, ONE)
        assert not ball.get("robot2").stale


@pytest.mark.parametrize(
    ("item", "number", "value"), [(8, 2, TWO), (7, 2, TWO + b"x"), (7, 2, TWO[:4]), (7, 1, TWO), (7, 0, TWO)]
)
def test_what_does_not_fit_changes_nothing(place: Path, item: int, number: int, value: bytes) -> None:
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        assert put(received, 7, 1, ONE)
        assert not put(received, item, number, value)
        assert (ball.get("robot2").value, ball.get("robot2").number) == ({"x": 1.0}, 1)


def test_an_item_that_is_added_to_the_file_is_known_at_once(place: Path) -> None:
    with failover.board() as board:
        later = board.add(Item("later", size=4))
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        assert not put(received, 8, 1, b"x")
        with pytest.raises(failover.BoardError, match="no item 'later'"):
            later.get("robot2")
        with received.file.changing():
            received.file.add(layout.wanted_of(Item("later", size=4), 8))
        assert put(received, 8, 1, b"x")
        assert later.get("robot2").value == b"x"


def test_a_robot_that_started_anew_has_a_new_file_and_its_readers_go_there(place: Path) -> None:
    with failover.board() as board:
        ball = board.add(BALL)
        first = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        assert put(first, 7, 1000, ONE)
        assert ball.get("robot2").number == 1
        directory.dismiss(board.directory / "peer-robot2")
        again = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        with pytest.raises(NeverWrittenError):
            ball.get("robot2")
        assert put(again, 7, 1, TWO)
        assert ball.get("robot2").value == {"x": 2.0}


def test_puts_that_no_frame_carried_do_not_overwrite_the_bank_that_is_read(place: Path) -> None:
    """Every second put comes: with two banks they all have the same place by the writer's number."""
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        places = set()
        for number in range(2, 10, 2):
            assert put(received, 7, number, ONE)
            places.add(ball.get("robot2").number % 2)
        assert places == {0, 1}


def counts(received: ReceivedItems) -> list[int]:
    """Frames with the only item, and how many were lost."""
    (record,) = received.file.records()
    return [received.file.words[(record.at + field) // 8] for field in (layout.FRAMES_FIELD, layout.LOST_FIELD)]


def test_frames_that_were_missed_are_counted_by_the_senders_rounds(place: Path) -> None:
    with failover.board() as board:
        item = Item("ball", {"x": "f8"}, period=2)
        board.add(item)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: item}))
        for number, (round_, missing) in enumerate(((2, 0), (4, 0), (10, 5), (12, 1), (11, 0)), 1):
            put(received, 7, number, ONE, round_, missing)
        assert counts(received) == [5, 2]


def test_rounds_of_which_a_medium_carries_no_frame_lose_none(place: Path) -> None:
    """The sender has a cable, too, and begins a round each 20 ms; this robot hears its slots, each 50 ms."""
    with failover.board() as board:
        item = Item("ball", {"x": "f8"})
        board.add(item)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: item}))
        for number, (round_, missing) in enumerate(((3, 0), (5, 0), (8, 0), (10, 0), (15, 1)), 1):
            put(received, 7, number, ONE, round_, missing)
        assert counts(received) == [5, 1]


def test_a_robot_that_began_another_life_counts_from_any_number(place: Path) -> None:
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        assert put(received, 7, 1000, ONE)
        assert not put(received, 7, 1, TWO)
        received.begin_life()
        assert put(received, 7, 1, TWO)
        assert (ball.get("robot2").value, ball.get("robot2").number) == ({"x": 2.0}, 2)


def test_a_frame_wakes_who_waits_for_it(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a slice of an hour only the wake-up can end the wait."""
    monkeypatch.setattr("failover.boards.item.SLICE_S", 3600.0)
    with failover.board() as board:
        ball = board.add(BALL)
        received = ReceivedItems(directory.make_peer(board.directory, "robot2", items={7: BALL}))
        with pytest.raises(NeverWrittenError):
            ball.get("robot2")
        got: list[object] = []
        thread = threading.Thread(target=lambda: got.append(ball.wait("robot2", after=0).value))
        thread.start()
        asleep = Path(f"/proc/self/task/{thread.native_id}/wchan")
        while "futex" not in asleep.read_text():
            time.sleep(0)
        assert put(received, 7, 1, ONE)
        thread.join(0.5)
        number = 1
        while thread.is_alive():  # it may have slept in a lock of Python's when we looked
            number += 1
            put(received, 7, number, ONE)
            thread.join(0.5)
        assert got == [{"x": 1.0}]


@pytest.mark.parametrize(("seed", "new"), [(0, 0.97), (1, 0.97), (2, 0.97), (3, 0.5), (4, 0.02)])
def test_what_is_put_together_is_as_what_is_put_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, new: float
) -> None:
    """Frames of all items, or of some; repeated, older, missing, too long, too old ones, and another epoch among them."""
    dice = random.Random(seed)
    items = {number: Item(f"item{number}", size=8 * (1 + number % 3), banks=2 + number % 2) for number in range(6)}
    together, single = (received_in(tmp_path / name, items) for name in ("together", "single"))
    frames, puts, planned = 300, dict.fromkeys(items, 0), 0
    for round_ in range(frames):
        chosen = list(items) if dice.random() < 0.8 else dice.sample(list(items), dice.randint(1, 6))
        for number in chosen:
            puts[number] += dice.random() < new
        if dice.random() < 0.02:
            puts = {number: put + (1 << 40) for number, put in puts.items()}
        age_us = AGE_MAX_US if dice.random() < 0.02 else dice.randrange(1000)
        too_long = dice.random() < 0.02
        portions = [
            Portion(number, age_us, puts[number] or 1, bytes([round_ % 256]) * (items[number].size + (too_long and number == 2)))
            for number in chosen
        ]
        came_ns, error_us, missing = now(), dice.randrange(500), int(dice.random() < 0.03)
        taken = together.take(portions, came_ns, error_us, round_, missing)
        plan = together._reception._plan
        planned += plan is not None and plan.frames > 0
        monkeypatch.setattr(reception, "TOGETHER_MIN", 1000)
        assert single.take(portions, came_ns, error_us, round_, missing) == taken
        monkeypatch.undo()
    assert planned > frames // 2
    together.tell_state(layout.RUN)
    single.tell_state(layout.RUN)
    assert bytes(together.file.area) == bytes(single.file.area)
    assert together.dropped == single.dropped


def received_in(directory_: Path, items: dict[int, Item]) -> ReceivedItems:
    directory_.mkdir(parents=True)
    return ReceivedItems(directory.make_peer(directory_, "robot2", items=items))


def test_frames_of_items_that_are_put_together_are_counted_within_a_second(tmp_path: Path) -> None:
    items = {number: Item(f"item{number}", size=8) for number in range(4)}
    received = received_in(tmp_path / "board", items)
    came_ns = now()
    for round_, later_ns in enumerate((0, reception.TOLD_NS, reception.TOLD_NS + 1), 1):
        portions = [Portion(number, 0, round_, b"12345678") for number in items]
        assert received.take(portions, came_ns + later_ns, 5, round_) == 4
    told = [received.file.words[(record.at + layout.FRAMES_FIELD) // 8] for record in received.file.records()]
    assert told == [2] * 4
    assert [received.file.word32(record.at + layout.TRANSIT_FIELD) for record in received.file.records()] == [5] * 4


def test_what_is_remembered_of_frames_that_vary_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However a robot varies the items of its frames, the sizes of their values, and the banks that each begins with."""
    monkeypatch.setattr(reception, "PLACES_MAX", 200)
    dice = random.Random(1)
    items = {number: Item(f"item{number}", size=64, banks=2 + number % 3) for number in range(6)}
    received = received_in(tmp_path / "board", items)
    came_ns = now()
    for put_ in range(1, 2_000):
        numbers = dice.sample(list(items), dice.randint(3, 6)) if dice.random() < 0.5 else list(items)
        portions = [Portion(number, 0, put_, bytes(dice.randint(1, 64))) for number in numbers]
        assert received.take(portions, came_ns, 5, put_) == len(numbers)
        plans = [plan for plan in received._reception._plans.values() if plan is not None]
        shapes = [(plan, shape) for plan in plans for known in plan._known.values() for shape in known]
        assert sum(len(plan.slots) for plan, _ in shapes) <= 200 + len(items)
        assert len(plans) <= reception.PLANS_MAX
