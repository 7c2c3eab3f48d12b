"""Unix sockets whose file has another name than bind(2) was told: see `checkpoint.resources.sockets.renamed_paths`."""

from __future__ import annotations

import os
import socket
import tempfile
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import MismatchError, UnsupportedError
from checkpoint.linux.net.unix_diag import BoundFile, answer_about, parsed
from checkpoint.resources.sockets import renamed_paths
from tests.checkpoint.round_trip import (
    ENGINE,
    NOBODY,
    Program,
    as_nobody,
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
    program = start(["/usr/bin/python3", "-S", "-c", ANSWERS, how, f"{directory}/" if whole else "", aim], directory)
    program.wait_for_line("ready")
    return program


def three_lives(directory: Path, how: str, *, whole: bool) -> str:
    """Both listeners are where they were, and answer, after each of three restores; "" if all of it holds."""
    program = moving(directory, how, whole=whole)
    before, names = answers(directory), sorted(os.listdir(directory))
    for life in range(3):
        with ended(program), protected(program) as session:
            snapshot = transported(captured_at_last(session, CaptureOrder(hold=True)))
            program.kill()
        if life == 1:  # as on another robot
            for name in ("door", "door2", "new"):
                (directory / name).unlink()
        program = restored(snapshot, directory)
        assert answers(directory) == before
        assert sorted(os.listdir(directory)) == names
    program.kill()
    return ""


@pytest.mark.parametrize("is_whole", [True, False], ids=["whole", "relative"])
@pytest.mark.parametrize("how", ["rename", "link"])
def test_a_listener_whose_file_was_moved_is_found_where_it_was(how: str, is_whole: bool, tmp_path: Path) -> None:
    assert three_lives(tmp_path, how, whole=is_whole) == ""


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


@pytest.mark.parametrize("is_whole", [True, False], ids=["whole", "relative"])
@pytest.mark.parametrize("how", ["rename", "link"])
def test_an_ordinary_user_finds_it_too(how: str, is_whole: bool) -> None:
    """He may not ask a socket for its file, but for the number of that."""
    with tempfile.TemporaryDirectory() as place:
        os.chown(place, NOBODY, NOBODY)
        assert as_nobody(lambda: three_lives(Path(place), how, whole=is_whole)) == ""


def test_a_name_that_another_file_has_by_now_is_not_its_for_an_ordinary_user(tmp_path: Path) -> None:
    """Its own file is gone: of that one only the number is left, which no other has."""
    with socket.socket(socket.AF_UNIX) as gone, socket.socket(socket.AF_UNIX) as other:
        for made in (gone, other):
            (tmp_path / "name").unlink(missing_ok=True)
            made.bind(str(tmp_path / "name"))
        files = [parsed(answer_about(os.fstat(made.fileno()).st_ino)) for made in (gone, other)]
        found = [renamed_paths.by_number("", str(tmp_path / "name"), one.file if one else None)[1] for one in files]
        assert [about is not None for about in found] == [False, True]


def test_on_a_file_system_that_tells_other_numbers_the_name_counts(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(tmp_path / "name"))
        about = (tmp_path / "name").stat()
        elsewhere = BoundFile(about.st_ino + 1, about.st_dev + 1)
        assert renamed_paths.by_number("", str(tmp_path / "name"), elsewhere) == (str(tmp_path / "name"), about)
