"""An item of one user on two real robots: another user's put is refused, and the program puts on after a takeover."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.boards.board import Board
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.banks import EPOCH_SHIFT
from failover.core.board.items import Item
from failover.core.board.layout import wanted_of
from failover.errors import BoardError, NeverWrittenError
from tests.agent.worker.test_owned_items import as_user
from tests.e2e import robots, test_board
from tests.e2e.robots import RobotMachine
from tests.e2e.test_agents_board import killed, worker_of
from tests.e2e.test_board import board_of, two_with_boards
from tests.include.programs import program

pytestmark = [pytest.mark.root, pytest.mark.compiler]

MAPPER, OTHER = pwd.getpwnam("daemon"), pwd.getpwnam("bin")
GROUP = grp.getgrgid(MAPPER.pw_gid).gr_name
ITEMS = f"""
[board]
group = "{GROUP}"
[board.items.ball]
size = 8
[board.items.map]
type = "u8"
user = "{MAPPER.pw_name}"
[board.items.way]
size = 8
user = "no-such-user"
"""
NOTE = "has no user 'no-such-user': no program here can put way; make the user, and restart the agent"


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    monkeypatch.setattr(test_board, "ITEMS", ITEMS)
    with two_with_boards(tmp_path, monkeypatch, name=f"owned{os.getpid()}") as both:
        yield both


@pytest.fixture
def open_to_all() -> Iterator[Path]:
    """A directory that each user finds, whatever else runs: another run of the tests closes the one above `tmp_path`."""
    with tempfile.TemporaryDirectory(prefix="failover-owned-") as made:
        Path(made).chmod(0o755)
        yield Path(made)


def test_its_users_program_puts_it_at_whichever_robot_it_runs_and_no_other_user_anywhere(
    pair: tuple[RobotMachine, RobotMachine], open_to_all: Path
) -> None:
    first, second = pair
    link = open_to_all / "board"  # on real robots both boards are found by one path
    place = board_of(first).resolve()
    link.symlink_to(place)
    counts = Path(shutil.copy(program("board_counts"), open_to_all / "counts"))
    counts.chmod(0o755)
    for robot in pair:
        assert [note for note in robot.status()["notes"] if "no-such-user" in note] == [f"{robot.name} {NOTE}"]
    with first.control() as control:
        control.ask(
            "run",
            argv=[str(counts), "map"],
            name="count",
            env={"PATH": "/usr/bin:/bin", "FAILOVER_BOARD": str(link)},
            cwd="/",
            wait=False,
            engine="ptrace",
            user=MAPPER.pw_name,
        )
    robots.until_protected(first)
    with Board(board_of(second), "reads") as here:
        item = here.item("map")

        def at(robot: str) -> int:
            try:
                return int(item.get(robot).value)
            except NeverWrittenError:
                return 0

        robots.until(lambda: at("robot1") > 20, "the item at the other robot")

        def another() -> None:
            with (
                Board(place, "another") as board,
                pytest.raises(BoardError, match=r"'daemon' .* alone may put"),
            ):
                board.item("map").put(10**6)
            with pytest.raises(PermissionError):
                os.open(place / f"own+{MAPPER.pw_uid}", os.O_RDWR)
            file = MappedFile.open(place / "own", writable=True)
            with file.changing():
                file.add(wanted_of(Item("map", "u8"), 1))
            record = next(one for one in file.records() if one.name == "map")
            put = 1 << 60
            struct.pack_into("<QQQIIQ", file.area, record.offset, put, 1, 0, 8, 0, 10**6)
            file.words[(record.at + layout.NEWEST_FIELD) // 8] = put

        as_user(OTHER.pw_uid, another, GROUP)
        before = at("robot1")
        robots.until(lambda: at("robot1") > before + 20, "more of it after another user's scribble")
        assert at("robot1") < 10**6
        with Board(board_of(first), "beside") as there:
            worker = worker_of(first)
            robots.until(lambda: killed(first, worker), "the worker to be killed")
            robots.until(lambda: worker_of(first) not in (0, worker), "another worker")
            number = there.item("map").get().number
            robots.until(lambda: there.item("map").get().number > number, "the program to put on")
            assert 0 < there.item("map").get().value < 10**6
        before = at("robot1")
        robots.until(lambda: at("robot1") > before + 20, "more of it after the agent's restart")
        robots.until_protected(first)
        aside = open_to_all / "aside"
        aside.symlink_to(board_of(second).resolve())
        os.replace(aside, link)
        first.cut_power()
        robots.until_taken_over(second)
        robots.until(lambda: at("robot2") > before, "the item at the robot that resumed its program")
        assert item.get("robot2").number >> EPOCH_SHIFT > 0
        assert item.source().file.path.name == f"own+{MAPPER.pw_uid}"
        before = at("robot2")
        robots.until(lambda: at("robot2") > before + 20, "more of it")
        assert at("robot2") < 10**6
        os.truncate(board_of(second) / f"own+{MAPPER.pw_uid}", 100)
        said = f"user '{MAPPER.pw_name}' has damaged the file of that user's items, which are not sent"
        robots.until(
            lambda: any(note.startswith(said) for note in second.status()["notes"]), "the agent to run on, and to say so"
        )
