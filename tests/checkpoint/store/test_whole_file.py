"""A small file that is written anew: its name stands for the old content or the new, and nothing is left of one not finished."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.store import whole_file
from checkpoint.store.whole_file import Lasting, write_new, write_whole, written_aside


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was asked of the kernel, in order."""
    said: list[str] = []

    def noted(name: str) -> Callable[..., object]:
        real = getattr(os, name)

        def called(*arguments: object, **named: object) -> object:
            said.append(name)
            return real(*arguments, **named)

        return called

    for name in ("write", "fdatasync", "fsync", "rename"):
        monkeypatch.setattr(whole_file.os, name, noted(name))
    return said


@pytest.mark.parametrize(
    ("lasts", "order"),
    [
        ("process", ["write", "rename"]),
        ("content", ["write", "fdatasync", "rename"]),
        ("name", ["write", "fdatasync", "rename", "fsync"]),
    ],
)
def test_content_is_on_the_disk_before_the_name_and_the_name_before_the_writer_returns(
    tmp_path: Path, calls: list[str], lasts: Lasting, order: list[str]
) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    write_whole(path, b"new", lasts=lasts)
    assert calls == order and path.read_bytes() == b"new" and os.listdir(tmp_path) == ["file"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_of_one_that_was_not_finished_nothing_is_left_and_the_old_one_stands(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def begin() -> None:
        with written_aside(path) as descriptor:
            os.write(descriptor, b"ne")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        begin()
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]
    with pytest.raises(OSError, match="No such file"):
        write_whole(tmp_path / "gone" / "file", b"new")


def test_what_lies_aside_is_written_over_but_neither_followed_nor_where_others_write_taken(tmp_path: Path) -> None:
    path, aside, other = tmp_path / "file", tmp_path / "file.new", tmp_path / "other"
    aside.write_bytes(b"what a kill has left, which is longer")
    write_whole(path, b"new")
    assert path.read_bytes() == b"new" and not aside.exists()
    aside.write_bytes(b"another user's")
    with pytest.raises(FileExistsError), written_aside(path, is_exclusive=True):
        raise AssertionError("it must not be given")
    assert aside.read_bytes() == b"another user's"
    aside.unlink()
    aside.symlink_to(other)
    with pytest.raises(OSError, match="Too many levels"):
        write_whole(path, b"newer")
    assert not other.exists() and path.read_bytes() == b"new"


def test_a_new_file_and_its_name_are_on_the_disk_before_the_writer_returns(tmp_path: Path, calls: list[str]) -> None:
    path = tmp_path / "key"
    write_new(path, b"secret", mode=0o640)
    assert calls == ["write", "fsync", "fsync"] and path.read_bytes() == b"secret"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_new_file_replaces_none(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(b"old")
    with pytest.raises(FileExistsError):
        write_new(path, b"new")
    assert path.read_bytes() == b"old"


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_of_a_new_file_that_the_disk_does_not_take_nothing_is_left(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(whole_file.os, call, full)
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
        write_new(tmp_path / "key", b"secret")
    assert os.listdir(tmp_path) == []
