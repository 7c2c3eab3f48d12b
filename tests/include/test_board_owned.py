"""failover_board.h and items that one user alone may put: an agent's board, programs of several users in C and Python."""

from __future__ import annotations

import os
import pwd
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import failover
from agent.worker import board_directory
from failover.boards import boottime, directory
from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.boards.received import ReceivedItems
from failover.core.board import layout
from failover.core.board.items import Item
from failover.core.board.layout import wanted_of
from failover.core.frames.frame import Portion
from tests.agent.worker.test_board_directory import folder, loaded
from tests.include.board_programs import tool

__all__ = ["folder"]

pytestmark = [
    pytest.mark.compiler,
    pytest.mark.skipif(os.geteuid() != 0 or os.getegid() != 0, reason="needs other users; root's group is the board's"),
]

MAPPER, OTHER = "daemon", "bin"
UID, OTHER_UID = pwd.getpwnam(MAPPER).pw_uid, pwd.getpwnam(OTHER).pw_uid
OWNED = f"""
[board.items.ball]
size = 8
[board.items.map]
size = 8
user = "{MAPPER}"
[board.items.plan]
size = 8
user = "{OTHER}"
[board.items.way]
size = 8
user = "no-such-user"
"""


@pytest.fixture
def place(folder: Path) -> Path:
    made = board_directory.provide(loaded(folder, OWNED))
    assert made is not None
    return made


def test_its_user_puts_it_in_c_others_read_it_and_another_users_put_names_the_user(place: Path) -> None:
    with tool(place, opened=False) as mapper, tool(place, opened=False) as other, Board(place, "test") as python:
        for c, uid in ((mapper, UID), (other, OTHER_UID)):
            c.ok("user", uid)
            c.ok("open")
            for name in ("map", "plan", "ball"):
                c.ok("find", name, 8)
        mapper.ok("put", "map", "mine")
        assert python.item("map").get().value == b"mine"
        assert other.say("get", "map", "-").startswith("mine ")
        said = other.say("put", "map", "theirs")
        assert (
            f"item map cannot be put: user {MAPPER} (uid {UID}) alone may put it, and this program runs as uid {OTHER_UID}"
            in said
        )
        other.ok("put", "plan", "theirs")
        mapper.ok("put", "ball", "b")
        assert mapper.say("get", "plan", "-").startswith("theirs ")
        assert "cannot remove item map" in other.say("remove", "map")
        said = other.say("find", "way", 8), other.say("put", "way", "x")
        assert "item way is for user no-such-user alone; no program of robot1 can put it: failover status says" in said[1]
        words = {word.partition("/")[2].partition("/")[0] for word in other.say("snapshot").split(" ") if word}
        assert words == {"map=mine", "plan=theirs", "ball=b"}
        python.item("plan").put(b"root may") if other.say("close") == "ok" else None
        assert mapper.say("get", "plan", "-").startswith("root may ")


def test_what_its_user_damages_in_his_file_costs_c_no_other_item_and_no_lock(place: Path) -> None:
    with tool(place, opened=False) as c, Board(place, "test") as python:
        c.ok("user", OTHER_UID)
        c.ok("open")
        for name in ("map", "plan", "ball"):
            c.ok("find", name, 8)
        c.ok("put", "ball", "b")
        python.item("map").put(b"mine")
        assert c.say("get", "map", "-").startswith("mine ")
        file = MappedFile.open(place / f"own+{UID}", writable=True)
        at = file.records()[0].at + layout.BANKS_FIELD
        struct.pack_into("<H", file.area, at, 99)
        file.words[layout.GENERATION_AT // 8] += 2
        assert "damaged" in c.say("get", "map", "-")
        assert {word.partition("=")[0] for word in c.say("snapshot").split(" ") if word} == {"robot1/ball"}
        file.words[layout.GENERATION_AT // 8] = layout.GONE
        assert "made anew, or removed" in c.say("get", "map", "-")
        with pytest.raises(failover.BoardError, match=f"written by pid {c.pid}"):
            python.item("ball").put(b"x")
        assert {word.partition("=")[0] for word in c.say("snapshot").split(" ") if word} == {"robot1/ball"}
        c.ok("put", "ball", "c")


def test_the_youngest_value_of_all_robots_is_read_where_the_user_is_not(place: Path) -> None:
    peer = ReceivedItems.open(place / "peer-robot2")
    peer.heard(boottime.machine_ns())
    peer.tell_state(layout.RUN)
    peer.take((Portion(3, 0, 1, b"theirs"),), boottime.machine_ns(), 0, 0)
    with tool(place) as c:
        c.ok("find", "way", 8)
        assert "theirs" in c.say("youngest", "way")


def test_while_the_agent_makes_the_board_anew_a_program_waits_for_it(folder: Path, place: Path) -> None:
    with tool(place) as c:
        c.ok("find", "ball", 8)
        c.ok("put", "ball", "before")
        directory.retire(place / "own")
        with ThreadPoolExecutor(1) as pool:
            said = pool.submit(c.say, "put", "ball", "after")
            board_directory.provide(loaded(folder))
            assert said.result() == "ok"
    with Board(place, "test") as python:
        assert python.item("ball").get().value == b"after"


def test_what_others_write_into_their_files_is_no_item_of_the_user_for_c(place: Path) -> None:
    with tool(place, opened=False) as c, tool(place, opened=False) as mapper:
        mapper.ok("user", UID)
        mapper.ok("open")
        mapper.ok("find", "map", 8)
        mapper.ok("put", "map", "mine")
        file = MappedFile.open(place / "own", writable=True)
        with file.changing():
            file.add(wanted_of(Item("map", size=8), 1))
        record = next(one for one in file.records() if one.name == "map")
        struct.pack_into("<QQQII4s", file.area, record.offset + record.stride, 1, 1, 0, 4, 0, b"fake")
        file.words[(record.at + layout.NEWEST_FIELD) // 8] = 1
        c.ok("user", OTHER_UID)
        c.ok("open")
        c.ok("find", "map", 8)
        assert c.say("get", "map", "-").startswith("mine ")
        assert [word for word in c.say("snapshot").split(" ") if "fake" in word] == []
        assert c.say("db", "init") == "0"
        assert c.say("db", "get", "-", 1).split()[1] == "mine"
        mapper.say("db", "init")
        mapper.ok("close")
        assert mapper.say("db", "put", 1, "again") == "0"
        assert c.say("get", "map", "-").startswith("again")
        assert c.say("db", "put", 1, "no") == "-1"


def test_another_user_cannot_have_the_item_in_his_own_file_for_c(place: Path) -> None:
    with tool(place, opened=False) as c, Board(place, "test") as python:
        python.item("plan").put(b"right")
        file = MappedFile.open(place / f"own+{UID}", writable=True)
        record = file.records()[0]
        at = int(layout.DECLARATION.unpack_from(file.view, record.at)[9])
        named = b"\4\0plan\x08\0bytes[8]"
        file.area[at : at + len(named)] = named
        struct.pack_into("<QQQII4s", file.area, record.offset + record.stride, 1, 1, 0, 4, 0, b"fake")
        file.words[(record.at + layout.NEWEST_FIELD) // 8] = 1
        assert [one.name for one in file.records()] == ["plan"]
        c.ok("user", OTHER_UID)
        c.ok("open")
        c.ok("find", "plan", 8)
        assert c.say("get", "plan", "-").startswith("right ")


def test_c_goes_on_where_its_user_gets_the_item_later(folder: Path, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tool(place, opened=False) as c:
        c.ok("user", OTHER_UID)
        c.ok("open")
        for name in ("map", "ball", "plan"):
            c.ok("find", name, 8)
        c.ok("put", "ball", "held")
        c.ok("put", "plan", "before")
        monkeypatch.setattr(board_directory, "uid_named", {MAPPER: OTHER_UID, OTHER: UID, "no-such-user": OTHER_UID}.get)
        board_directory.provide(loaded(folder))
        words = {word.partition("=")[0] for word in c.say("snapshot").split(" ") if word}
        assert words == {"robot1/ball"}
        c.ok("put", "map", "mine")
        assert {word.partition("=")[0] for word in c.say("snapshot").split(" ") if word} == {"robot1/ball", "robot1/map"}
        assert "alone may put it" in c.say("put", "plan", "x")
        c.ok("find", "way", 8)
        c.ok("put", "way", "now")
        with Board(place, "test") as python:
            assert python.item("map").get().value == b"mine"
            assert python.item("ball").get().number == 1
            assert python.item("ball").source().file.path.name == "own"
            with pytest.raises(Exception, match=f"written by pid {c.pid}"):
                python.item("ball").put(b"x")
        c.ok("put", "ball", "still")
