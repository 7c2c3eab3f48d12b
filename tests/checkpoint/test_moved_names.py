"""Unix sockets whose file was given another name than bind(2) was told: see ``checkpoint/resources/moved_names.py``."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import MismatchError, UnsupportedError
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    captured_and_killed,
    captured_at_last,
    ended,
    protected,
    restored,
    start,
    transported,
)

pytestmark = pytest.mark.root

ANSWERS = """
import os, socket, sys
how, begin, aim = sys.argv[1:]
def bound(door):
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(begin + "new")
    listener.listen()
    os.chmod("new", 0o700)
    if how == "rename":
        os.rename("new", door)
    else:
        os.link("new", door)
        os.unlink("new")
    return listener
os.mkdir("far")
doors = [bound(aim), bound(aim + "2")]
third = socket.socket(socket.AF_UNIX)
third.bind(begin + "new")
client = socket.socket(socket.AF_UNIX)
client.connect(aim)
kept, _ = doors[0].accept()
print("ready", flush=True)
while True:
    for door in doors:
        asked, _ = door.accept()
        client.sendall(b"x")
        assert kept.recv(9) == b"x"
        assert client.getpeername() == kept.getsockname() == door.getsockname() == third.getsockname()
        asked.sendall(door.getsockname().encode())
        asked.close()
"""
"""Two listeners that were bound to one name, one after the other, and moved; another socket has that name."""


def answers(directory: Path) -> list[bytes]:
    """What each of the two says, and the rights of its file."""
    found = []
    for door in (directory / "door", directory / "door2"):
        with socket.socket(socket.AF_UNIX) as asking:
            asking.settimeout(60)
            asking.connect(str(door))
            found.append(asking.recv(200) + b" %o" % door.stat().st_mode)
    return found


def moving(directory: Path, how: str, *, whole: bool = True, aim: str = "door") -> Program:
    program = start([sys.executable, "-c", ANSWERS, how, f"{directory}/" if whole else "", aim], directory)
    program.wait_for_line("ready")
    return program


@pytest.mark.parametrize("is_whole", [True, False], ids=["whole", "relative"])
@pytest.mark.parametrize("how", ["rename", "link"])
def test_a_listener_whose_file_was_moved_is_found_where_it_was(how: str, is_whole: bool, tmp_path: Path) -> None:
    program = moving(tmp_path, how, whole=is_whole)
    before, names = answers(tmp_path), sorted(os.listdir(tmp_path))
    for life in range(3):
        with ended(program), protected(program) as session:
            snapshot = transported(captured_at_last(session, CaptureOrder(hold=True)))
            program.kill()
        if life == 1:  # as on another robot
            for name in ("door", "door2", "new"):
                (tmp_path / name).unlink()
        program = restored(snapshot, tmp_path)
        assert answers(tmp_path) == before
        assert sorted(os.listdir(tmp_path)) == names
    program.kill()


def test_a_listener_that_was_moved_to_another_directory_is_refused_by_name(tmp_path: Path) -> None:
    with ended(moving(tmp_path, "rename", aim="far/door")) as program:
        with pytest.raises(UnsupportedError, match="moved to another directory"):
            ENGINE.protect(program.pid, ProtectOrder("/test/moved"))
        with socket.socket(socket.AF_UNIX) as asking:
            asking.connect(str(tmp_path / "far" / "door"))
            assert asking.recv(200)


def test_a_name_that_a_moved_listener_was_bound_to_is_not_taken_from_others(tmp_path: Path) -> None:
    with ended(moving(tmp_path, "rename")) as program:
        snapshot = captured_and_killed(program)
    (tmp_path / "new").unlink()
    (tmp_path / "new").write_text("somebody's")
    with pytest.raises(MismatchError, match="is something else here"):
        restored(snapshot, tmp_path)
    assert (tmp_path / "new").read_text() == "somebody's"
