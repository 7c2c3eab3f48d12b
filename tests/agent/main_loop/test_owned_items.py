"""Items that one user alone may put, in the main loop: those of all files go, and each under its own number alone."""

from __future__ import annotations

import os
import pwd
import select
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from agent.main_loop.board_link import BoardLink
from agent.main_loop.loop import MainLoop
from agent.main_loop.own_items import LOOK_NS, UNREADABLE, OwnItems
from agent.system import clock
from agent.worker import board_directory
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.announcements import RESERVED
from failover.core.board.items import Item
from failover.core.board.layout import ADDED, Record, wanted_of
from tests.agent.worker.test_board_directory import folder, loaded

__all__ = ["folder"]

ME, UID = pwd.getpwuid(os.geteuid()).pw_name, os.geteuid()
OTHER = pwd.getpwnam("bin")
"""Another user: this process puts nothing of his unless it is root's."""
ROUND_NS = 20_000_000
BALL, MAP, PLAN, SECRET, ALARM = range(5)
ITEMS = f"""
[board.items.ball]
size = 8
[board.items.map]
size = 8
user = "{ME}"
[board.items.plan]
size = 8
period = 2
user = "{OTHER.pw_name}"
[board.items.secret]
size = 9000
shared = false
user = "{ME}"
[board.items.alarm]
size = 8
period = 60000
phase = 1
urgent = true
user = "{ME}"
"""


@pytest.fixture
def place(folder: Path) -> Path:
    made = board_directory.provide(loaded(folder, ITEMS))
    assert made is not None
    return made


@pytest.fixture
def link(place: Path) -> Iterator[BoardLink]:
    with closing(BoardLink.open(place, ROUND_NS)) as opened:
        yield opened


def sent(link: BoardLink, round_: int) -> dict[int, bytes]:
    """The items in the frame of a round, after a look at each table. No item of a user is told as one that was added."""
    due = link.due(round_, clock.now_ns() + round_ * LOOK_NS)
    assert not any(b"plan" in portion.value for portion in due if portion.number >= RESERVED)
    return {portion.number: portion.value for portion in due if portion.number < RESERVED}


def write(file: MappedFile, record: Record, value: bytes) -> None:
    """Put a value as a member of the group can: with no regard to locks."""
    put = 1 << 41
    bank = record.offset + put % record.banks * record.stride
    struct.pack_into(f"<QQQII{len(value)}s", file.area, bank, put, 1, 0, len(value), 0, value)
    file.words[(record.at + layout.NEWEST_FIELD) // 8] = put


def impostor(file: MappedFile, name: str, number: int, flags: int = 0) -> None:
    """A record of that name and number, with a value."""
    with file.changing():
        file.add(wanted_of(Item(name, size=8), number, flags))
    write(file, next(one for one in file.records() if one.name == name), b"fake")


def test_items_of_all_files_go_in_their_rounds_and_private_ones_stay(place: Path, link: BoardLink) -> None:
    with Board(place, "test") as board:
        for name in ("ball", "map", "secret"):
            board.item(name).put(name.encode())
        plan = MappedFile.open(place / f"own+{OTHER.pw_uid}", writable=True)
        write(plan, plan.records()[0], b"plan")
        assert sent(link, 2) == {BALL: b"ball", MAP: b"map", PLAN: b"plan"}
        assert sent(link, 3) == {BALL: b"ball", MAP: b"map"}
        board.item("map").put(b"again")
        board.add(Item("goal", size=8)).put(b"goal")
        found = sent(link, 5)
        assert (found[MAP], b"goal" in found.values()) == (b"again", True)
        assert not link.left_out()[UNREADABLE]


def test_what_a_member_of_the_group_writes_into_own_is_never_sent_as_an_item_of_one_user(place: Path, link: BoardLink) -> None:
    with Board(place, "test") as board:
        board.item("map").put(b"mine")
        own = MappedFile.open(place / "own", writable=True)
        impostor(own, "map", 4000)
        impostor(own, "other", MAP)
        impostor(own, "plan", PLAN, ADDED)
        assert sent(link, 3) == sent(link, 4) == {MAP: b"mine"}


def test_what_a_user_writes_into_his_file_is_sent_under_no_other_name_and_number(place: Path, link: BoardLink) -> None:
    with Board(place, "test") as board:
        board.item("ball").put(b"right")
        board.item("map").put(b"right")
        plan = MappedFile.open(place / f"own+{OTHER.pw_uid}", writable=True)
        record = plan.records()[0]
        write(plan, record, b"fake")
        for number, flags in ((BALL, 0), (MAP, 0), (4000, ADDED), (PLAN, ADDED)):
            with plan.changing():
                struct.pack_into("<I", plan.area, record.at, number)
                struct.pack_into("<I", plan.area, record.at + 56, flags)
            link.due(2 * number + 2, clock.now_ns() + (number + 9) * 10 * LOOK_NS)
            assert sent(link, 100_000 + number) == {BALL: b"right", MAP: b"right"}, (number, flags)


@pytest.mark.parametrize("spoil", ["shorter", "damaged"])
def test_a_file_that_its_user_has_spoilt_keeps_no_other_item_back(place: Path, link: BoardLink, spoil: str) -> None:
    with Board(place, "test") as board:
        board.item("ball").put(b"ball")
        board.item("map").put(b"map")
        plan = place / f"own+{OTHER.pw_uid}"
        assert sent(link, 2) == {BALL: b"ball", MAP: b"map"}
        if spoil == "shorter":
            os.truncate(plan, 20)
        else:
            with plan.open("r+b") as file:
                file.seek(layout.GENERATION_AT)
                file.write(layout.WORD.pack(100))
                file.seek(layout.RECORDS_AT)
                file.write(b"\xff" * layout.RECORD_SIZE)
        assert sent(link, 4) == {BALL: b"ball", MAP: b"map"}
        assert link.left_out()[UNREADABLE] > 0
    if spoil == "shorter":
        with closing(BoardLink.open(place, ROUND_NS)) as again:  # by a main loop that was started anew meanwhile
            assert sent(again, 2) == {BALL: b"ball", MAP: b"map"}


def test_a_put_of_an_urgent_item_of_one_user_wakes_the_main_loop_each_time_that_it_asks(place: Path, link: BoardLink) -> None:
    with Board(place, "test") as board, closing(select.epoll()) as loop:
        alarm = board.item("alarm")
        loop.register(link.wakes.fileno(), select.EPOLLIN)
        assert sent(link, 2) == {}
        for turn in range(3):
            alarm.put(b"%d" % turn)
            assert loop.poll(60)
            due = link.urgent(clock.now_ns())
            assert [(portion.number, portion.value) for portion in due] == [(ALARM, b"%d" % turn)]
            link.went(due)
            assert not link.seen_to()
            assert not loop.poll(0)


@pytest.mark.parametrize("owned", [False, True])
def test_a_board_without_such_items_is_read_with_two_calls_a_round_as_ever(
    folder: Path, monkeypatch: pytest.MonkeyPatch, owned: bool
) -> None:
    text = "[board.items.ball]\nsize = 8\n[board.items.goal]\nsize = 8\n"
    place = board_directory.provide(loaded(folder, ITEMS if owned else text))
    assert place is not None
    with closing(BoardLink.open(place, ROUND_NS)) as link, Board(place, "test") as board:
        assert isinstance(link._own, OwnItems) is not owned
        board.item("ball").put(b"b")
        sent(link, 2)
        calls = []
        for name in ("pread", "pwrite", "fstat", "open", "read", "stat"):
            call = getattr(os, name)
            monkeypatch.setattr(os, name, lambda *words, call=call, name=name: calls.append(name) or call(*words))
        assert sent(link, 3) == {BALL: b"b"}
        files = 3 if owned else 1
        assert calls.count("pread") <= 2 * files and len(calls) == calls.count("pread")
        assert owned or len(calls) == 2


def test_a_file_that_was_made_anew_with_other_keys_of_the_team_is_sent_from_then_on(folder: Path, place: Path) -> None:
    settings = loaded(folder)
    one: Any = SimpleNamespace(_settings=settings, _me="robot1", _has_board=True, _media=SimpleNamespace(round_ns=ROUND_NS))
    one._attend = one._neglect = one._note_urgent = lambda *_: None
    one._frames = SimpleNamespace(forget_older=lambda _: None)
    one._close_board, one._open_board = partial(MainLoop._close_board, one), partial(MainLoop._open_board, one)
    one._board = None
    one._open_board()
    directory.retire(place / f"own+{UID}")
    board_directory.provide(settings)
    with Board(place, "test") as board:
        board.item("map").put(b"anew")
    MainLoop._take_team(one, {name: replace(robot, next_key="k" * 40) for name, robot in settings.team.robots.items()})
    assert sent(one._board, 1)[MAP] == b"anew"
    one._close_board()
