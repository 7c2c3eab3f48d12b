"""Boards of two robots on one machine: what a program of the one puts, a program of the other gets, with bounds of its age."""

from __future__ import annotations

import os
import select
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from agent.main_loop import board_link, urgent_items
from agent.main_loop.board_link import UNREADABLE, BoardLink
from agent.main_loop.own_items import LOOK_NS
from agent.system import clock
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.directory import OWN_NAME, PEER_PREFIX, PRIVATE_NAME, make_file
from failover.boards.mapping import MappedFile
from failover.boards.received import MISFIT, UNKNOWN
from failover.core.beat_pace import URGENT_GAP_NS
from failover.core.board import layout
from failover.core.board.ages import UNBOUNDED_NS
from failover.core.board.due import URGENT_PER_S
from failover.core.board.items import Board as Declared
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.core.frames.lane import FrameLane, Heard
from failover.core.frames.roster import roster
from failover.core.frames.terms import Said
from failover.core.wire.messages import Beat, Echo
from failover.errors import NeverWrittenError

BOARD = Declared(
    (
        Item("ball", {"x": "f4", "y": "f4"}),
        Item("map", "msgpack", size=4000, period=2),
        Item("mine", size=8, shared=False),
        Item("slow", size=8, period=3, phase=1),
        Item("alarm", size=8, period=1000, phase=999, urgent=True),
    )
)
TEAM = roster(["robot1", "robot2"], BOARD.terms)
ROUND_NS = 20_000_000


def place_of(robot: str) -> Path:
    return directory.agents_place("team", robot)


def made(place: Path, me: str) -> Path:
    """The files as the worker process makes them, if they are not there."""
    if not place.exists():
        place.mkdir()
        make_file(place / PRIVATE_NAME, layout.PRIVATE, me, items=BOARD.private_of(me))
        for other in TEAM.names:
            if other != me:
                make_file(place / f"{PEER_PREFIX}{other}", layout.PEER, other, items=BOARD.shared_by(other), state=layout.NOT)
        make_file(place / OWN_NAME, layout.OWN, me, items=BOARD.shared_by(me))
    return place


class Robot:
    """One robot: its board, its frames, and a program that has the board open."""

    def __init__(self, me: str, boot: int = 1) -> None:
        self.me, self.boot = me, boot
        self.link = BoardLink.open(made(place_of(me), me), ROUND_NS)
        self.lane = FrameLane(me, "team", TEAM, boot, ROUND_NS // 1000)
        for other in TEAM.names:
            if other != me:
                self.lane.speak(other, f"{me} to {other}".ljust(16).encode())
                self.lane.hear(other, f"{other} to {me}".ljust(16).encode())
        self.round = self.beats = 0
        self.program = Board(place_of(me), "test")

    def says(self) -> list[bytes]:
        """The datagrams of its next frame."""
        self.round += 1
        self.beats += 1
        now_ns = clock.now_ns()
        due = self.link.due(self.round, now_ns)
        echoes = tuple(Echo(other, 1, 1) for other in TEAM.names if other != self.me)
        made, count = self.lane.seal(Beat(self.me, self.boot, self.beats, echoes=echoes), due, now_ns, round_=self.round)
        self.link.placed(due, count)
        return made[0].datagrams

    def hears(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            came_ns = clock.now_ns()
            heard = self.lane.open(datagram, came_ns)
            assert isinstance(heard, Heard)
            self.link.take(heard, came_ns)

    def close(self) -> None:
        self.program.close()
        self.link.close()


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Robot, Robot]]:
    monkeypatch.setattr(directory, "SHARED_MEMORY", tmp_path)
    both = tuple(Robot(name) for name in TEAM.names)
    yield both[0], both[1]
    for robot in both:
        robot.close()


def test_what_one_robot_puts_the_other_gets(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    first.program.item("ball").put({"x": 1.0, "y": 2.0})
    second.hears(first.says())
    reading = second.program.item("ball").get("robot1")
    assert (reading.value, reading.robot, reading.number) == ({"x": 1.0, "y": 2.0}, "robot1", 1)
    with pytest.raises(NeverWrittenError):
        second.program.item("map").get("robot1")
    with pytest.raises(NeverWrittenError):
        first.program.item("ball").get("robot2")


def test_an_item_that_is_put_while_several_are_read_together_is_read_again_by_itself(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two puts come in the middle of the copy, so that it has the beginning of one value and the end of another."""
    first, _ = pair
    balls, maps = first.program.item("ball"), first.program.item("map")
    balls.put({"x": 1.0, "y": 1.0})
    maps.put([1] * 900)
    own, pread = first.link._own, os.pread
    reads: list[int] = []

    def slow(descriptor: int, size: int, at: int) -> bytes:
        reads.append(size)
        if len(reads) > 1:
            return pread(descriptor, size, at)
        begin = pread(descriptor, size - 500, at)
        for number in (2, 3):
            maps.put([number] * 900)
        return begin + pread(descriptor, 500, at + size - 500)

    own.look(clock.now_ns())
    newest = [(record, 1) for record in own.records.values() if record.name in ("ball", "map")]
    monkeypatch.setattr(os, "pread", slow)
    own.read_ahead(newest)
    assert len(reads) == 2 and [(one.number, one.value) for one in own._known.values()] == [(1, struct.pack("<2f", 1, 1))]
    found = {record.name: own.get(record, number) for record, number in newest}
    assert found["map"] is not None and msgspec.msgpack.decode(found["map"].value) == [3] * 900


def test_before_a_round_trip_the_age_has_no_upper_bound_and_after_it_it_has(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    put_ns = clock.now_ns()
    first.program.item("ball").put({"x": 1.0, "y": 2.0}, at=put_ns)
    second.hears(first.says())
    assert second.program.item("ball").get("robot1").age_max_ns == UNBOUNDED_NS
    first.hears(second.says())
    first.program.item("ball").put({"x": 1.0, "y": 3.0}, at=put_ns)
    second.hears(first.says())
    before_ns = clock.now_ns()
    reading = second.program.item("ball").get("robot1")
    after_ns = clock.now_ns()
    assert reading.age_ns <= after_ns - put_ns
    assert before_ns - put_ns <= reading.age_max_ns < UNBOUNDED_NS


def test_an_item_goes_in_its_rounds_and_a_private_one_never(pair: tuple[Robot, Robot]) -> None:
    first, _ = pair
    for name, value in (("ball", {"x": 0.0, "y": 0.0}), ("map", b"\xc0"), ("slow", b"x"), ("mine", b"y")):
        first.program.item(name, None if name == "ball" else "msgpack" if name == "map" else bytes)
        first.program.item(name).put(None if name == "map" else value)
    sent = {round_: [portion.number for portion in first.link.due(round_, clock.now_ns())] for round_ in range(1, 7)}
    assert sent == {1: [0, 3], 2: [0, 1], 3: [0], 4: [0, 1, 3], 5: [0], 6: [0, 1]}


def test_a_value_of_several_parts_comes_whole_and_a_lost_part_drops_it(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    item = first.program.item("map", "msgpack")
    item.put(b"a" * 3900)
    first.round = 1
    parts = first.says()
    assert len(parts) == 4
    second.hears(parts)
    assert second.program.item("map", "msgpack").get("robot1").value == b"a" * 3900
    item.put(b"b" * 3900)
    first.round = 3
    second.hears(first.says()[:-1])
    assert second.program.item("map", "msgpack").get("robot1").value == b"a" * 3900


def test_a_repeated_value_is_no_new_one_and_an_older_one_neither(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    item = first.program.item("ball")
    item.put({"x": 1.0, "y": 0.0})
    late = first.says()
    item.put({"x": 2.0, "y": 0.0})
    for datagrams in (first.says(), first.says(), late):
        second.hears(datagrams)
    reading = second.program.item("ball").get("robot1")
    assert (reading.value["x"], reading.number) == (2.0, 1)


def test_a_program_that_waits_is_woken(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    waits = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import failover\nball = failover.board().item('ball')\nprint('waits', flush=True)\n"
            "print(ball.wait('robot1', after=0, timeout=60).value['x'])",
        ],
        env=os.environ | {"FAILOVER_BOARD": str(place_of("robot2"))},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert waits.stdout is not None
    assert waits.stdout.readline() == "waits\n"
    first.program.item("ball").put({"x": 7.0, "y": 0.0})
    second.hears(first.says())
    assert waits.communicate(timeout=60)[0] == "7.0\n"


def test_an_agent_that_begins_anew_takes_the_board_over_and_programs_go_on(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    item, there = first.program.item("ball"), second.program.item("ball")
    item.put({"x": 1.0, "y": 0.0})
    second.hears(first.says())
    first.link.close()
    again = Robot("robot1", boot=2)
    item.put({"x": 2.0, "y": 0.0})
    second.hears(again.says())
    assert (there.get("robot1").value["x"], there.get("robot1").number) == (2.0, 2)
    second.link.close()
    other = Robot("robot2", boot=2)
    item.put({"x": 3.0, "y": 0.0})
    other.hears(again.says())
    assert (there.get("robot1").value["x"], there.get("robot1").number) == (3.0, 3)
    again.close()
    other.close()


def test_a_robot_that_lost_its_board_counts_its_puts_anew(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    for number in range(5):
        first.program.item("ball").put({"x": float(number), "y": 0.0})
    second.hears(first.says())
    first.close()
    shutil.rmtree(place_of("robot1"))
    again = Robot("robot1", boot=2)
    again.program.item("ball").put({"x": 9.0, "y": 0.0})
    second.hears(again.says())
    assert second.program.item("ball").get("robot1").value["x"] == 9.0
    again.close()


def test_a_frame_of_an_earlier_life_of_a_robot_changes_nothing(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    item, there = first.program.item("ball"), second.program.item("ball")
    item.put({"x": 1.0, "y": 0.0})
    recorded = first.says()
    item.put({"x": 2.0, "y": 0.0})
    first.link.close()
    again = Robot("robot1", boot=2)
    second.hears(again.says())
    other_medium = Robot("robot2", boot=2)
    opened = other_medium.lane.open(recorded[0], clock.now_ns())
    assert isinstance(opened, Heard)
    second.link.take(opened, clock.now_ns())
    second.hears(again.says())
    assert (there.get("robot1").value["x"], there.get("robot1").number) == (2.0, 1)
    other_medium.close()
    again.close()


def test_a_robot_whose_clock_shows_anything_ends_no_other_agent(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_link, "BOUNDS_TOLD_NS", -1)
    first, second = pair
    for _ in range(2):
        second.hears(first.says())
        first.hears(second.says())
    for left_us in (2**64 - 1, 0, 2**53 - 1, 0):
        echo = ((1, second.lane.counter, 0),) if left_us else ()
        made, _ = first.lane.seal(None, (), left_us * 1_000, Said(ROUND_NS // 1_000, 0, 0, (), echo))
        heard = second.lane.open(made[0].datagrams[0], clock.now_ns())
        if isinstance(heard, Heard):
            second.link.take(heard, clock.now_ns())
    second.hears(first.says())


def test_what_does_not_belong_here_is_counted(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    made, _ = first.lane.seal(
        None, [Portion(99, 0, 1, b"?"), Portion(0, 0, 1, bytes(9)), Portion(3, 0, 1, b"12345678")], clock.now_ns()
    )
    second.hears(made[0].datagrams)
    assert second.link.left_out() == {UNKNOWN: 1, MISFIT: 1}
    assert second.program.item("slow", bytes).get("robot1").value == b"12345678"


@pytest.mark.parametrize("size", [0, 8, 4096, 20480, layout.names_at(1024)])
def test_a_file_that_a_program_makes_shorter_ends_no_agent(pair: tuple[Robot, Robot], size: int) -> None:
    """A mapping would: the kernel ends a process that touches a page which is gone."""
    first, _ = pair
    first.program.item("ball").put({"x": 1.0, "y": 0.0})
    assert len(first.link.due(1, clock.now_ns())) == 1
    first.program.item("ball").put({"x": 2.0, "y": 0.0})  # is not read yet
    own = place_of("robot1") / "own"
    os.truncate(own, size)
    for round_ in range(3):
        first.link.due(round_, clock.now_ns() + round_ * 2 * LOOK_NS)
    first.program._holder.opened = None  # it would touch the lost pages when it is closed
    assert first.link.dropped.get(UNREADABLE, 0) > 0


def test_states_of_robots_are_told(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    assert second.program.robots()["robot1"].state == "not"
    second.hears(first.says())
    now_ns = clock.now_ns()
    for silent_ns, state in ((0, "run"), (4 * ROUND_NS, "remove"), (20 * ROUND_NS, "not")):
        second.link.tell_states(now_ns + silent_ns, 10 * ROUND_NS, lambda _: ROUND_NS)
        assert second.program.robots()["robot1"].state == state


def test_a_robot_that_is_heard_by_radio_only_is_judged_by_the_rounds_of_the_radio(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_link, "BOUNDS_TOLD_NS", -1)
    first, second = pair
    file = second.link._peers["robot1"].items.file
    (ball,) = [record for record in file.records() if record.name == "ball"]
    bounds = []
    for round_ns in (ROUND_NS, 5 * ROUND_NS):
        second.link.tell_states(clock.now_ns(), 20 * ROUND_NS, lambda _, ns=round_ns: ns)  # type: ignore[misc]
        for _ in range(2):
            second.hears(first.says())
            first.hears(second.says())
        bounds.append(file.words[(ball.at + layout.FORMULA_FIELD) // 8])
    assert bounds[1] - bounds[0] > 10 * ROUND_NS
    now_ns = clock.now_ns() + 5 * ROUND_NS
    for round_ns, state in ((ROUND_NS, "remove"), (5 * ROUND_NS, "run")):
        second.link.tell_states(now_ns, 20 * ROUND_NS, lambda _, ns=round_ns: ns)  # type: ignore[misc]
        assert second.program.robots()["robot1"].state == state


def test_an_urgent_item_wakes_the_loop_and_goes_once_for_each_put_and_not_too_often(pair: tuple[Robot, Robot]) -> None:
    first, second = pair
    item = first.program.item("alarm", bytes)
    first.link.due(0, clock.now_ns())  # the table is read
    for number in range(1, 4):
        item.put(b"%d" % number)
        with closing(select.epoll()) as loop:
            loop.register(first.link.wakes.fileno(), select.EPOLLIN)
            assert loop.poll(60)
        first.link.wakes.heed()
        now_ns = clock.now_ns()
        (urgent,) = first.link.urgent(now_ns)
        made, _ = first.lane.seal(None, [urgent], now_ns)
        first.link.went([urgent])
        assert first.link.urgent(now_ns) == []
        second.hears(made[0].datagrams)
        assert second.program.item("alarm", bytes).get("robot1").value == b"%d" % number
        first.link.seen_to()
    now_ns = clock.now_ns()
    sent = 0
    for _ in range(50):
        item.put(b"!")
        portions = first.link.urgent(now_ns)
        first.link.went(portions)
        sent += len(portions)
    assert sent <= URGENT_PER_S


def test_an_urgent_item_that_left_over_one_medium_goes_over_each_other_one_too(pair: tuple[Robot, Robot]) -> None:
    first, _ = pair
    first.link.due(0, clock.now_ns())  # the table is read
    first.program.item("alarm", bytes).put(b"!")
    now_ns = clock.now_ns()
    for medium in (0, 1, 2):
        (urgent,) = first.link.urgent(now_ns, medium)
        first.link.placed([urgent], 1, medium)
        assert first.link.urgent(now_ns, medium) == []
    taken = 0
    for _ in range(2 * URGENT_PER_S):
        first.program.item("alarm", bytes).put(b"!")
        portions = first.link.urgent(now_ns, 1)
        first.link.went(portions, 1)
        taken += len(portions)
    assert taken == URGENT_PER_S - 1
    assert len(first.link.urgent(now_ns, 0)) == 1, "the radio's limit is not the cable's"


def test_what_was_seen_to_already_is_no_error(pair: tuple[Robot, Robot]) -> None:
    first, _ = pair
    first.link.wakes.heed()
    first.link.wakes.heed()


def test_a_program_that_puts_an_urgent_item_all_the_time_does_not_keep_the_loop_busy(pair: tuple[Robot, Robot]) -> None:
    first, _ = pair
    item = first.program.item("alarm", bytes)
    first.link.due(0, clock.now_ns())  # the table is read
    sent_ns = now_ns = clock.now_ns()
    looks = 0
    while now_ns < sent_ns + 100 * URGENT_GAP_NS:
        item.put(b"!")
        portions = first.link.urgent(now_ns)
        first.link.went(portions)
        looks += 1
        now_ns = max(now_ns + 1_000, first.link.urgent_due_ns(sent_ns))
    assert URGENT_PER_S < looks <= 100
    first.link.leave_for_slot(now_ns)
    assert first.link.urgent_due_ns(sent_ns) == now_ns + URGENT_GAP_NS


def told(link: BoardLink, patience_s: float = 0) -> bool:
    """Whether the loop would wake."""
    with closing(select.epoll()) as loop:
        loop.register(link.wakes.fileno(), select.EPOLLIN)
        return bool(loop.poll(patience_s))


def test_puts_wake_the_loop_once_until_it_has_looked_and_none_is_lost_between_its_look_and_its_question(
    pair: tuple[Robot, Robot],
) -> None:
    first, _ = pair
    item = first.program.item("alarm", bytes)
    first.link.due(0, clock.now_ns())  # the table is read
    for number in range(20):
        item.put(b"%d" % number)
        assert told(first.link, 60)
        first.link.wakes.heed()
        item.put(b"untold")
        assert not told(first.link)
        first.link.urgent(clock.now_ns())
        if number % 2:
            item.put(b"again")
            assert first.link.seen_to(), "no wake-up tells of this put"
            first.link.urgent(clock.now_ns())
        assert not first.link.seen_to()
        assert not told(first.link)


def test_a_put_whose_wake_up_is_lost_is_found_in_the_next_round(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, _ = pair
    first.link.due(0, clock.now_ns())  # the table is read
    monkeypatch.setattr(MappedFile, "touch", lambda _: None)
    first.program.item("alarm", bytes).put(b"!")
    assert not told(first.link)
    assert first.link.has_urgent()
    (urgent,) = first.link.urgent(clock.now_ns())
    first.link.went([urgent])
    assert not first.link.has_urgent()


def test_a_program_that_wakes_the_loop_all_the_time_leaves_one_event(pair: tuple[Robot, Robot]) -> None:
    first, _ = pair
    file = first.program.own_source("alarm").file
    for _ in range(10_000):
        file.touch()
    assert told(first.link)
    first.link.wakes.heed()
    assert not told(first.link)


def test_without_a_descriptor_for_wake_ups_urgent_items_go_with_the_rounds(
    pair: tuple[Robot, Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first, _ = pair

    def refused(_file: int) -> None:
        raise OSError(24, "inotify_init1: Too many open files")

    monkeypatch.setattr(urgent_items, "Touches", refused)
    with closing(BoardLink.open(place_of("robot1"), ROUND_NS)) as link:
        assert "urgent items go with the rounds only" in caplog.text
        assert link.wakes.fileno() < 0
        link.wakes.heed()
        link.due(0, clock.now_ns())
        first.program.item("alarm", bytes).put(b"!")
        assert link.has_urgent()
        assert len(link.urgent(clock.now_ns())) == 1
