"""A program that cannot be executed is refused in words: what is wrong with it, and the command that would work."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth
from checkpoint.sentences import in_words


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files that are no programs."""
    (tmp_path / "mapper.py").write_text("print(1)\n")
    (tmp_path / "tool").write_text("#!/bin/sh\n")
    (tmp_path / "tool").chmod(0o755)
    (tmp_path / "lost").write_text("#!/opt/none/python3 -u\n")
    (tmp_path / "lost").chmod(0o755)
    (tmp_path / "plain.sh").write_text("echo 1\n")
    (tmp_path / "plain.sh").chmod(0o755)
    (tmp_path / "maps").mkdir()
    return tmp_path


def refusal(name: str, folder: Path, path: str = "/usr/bin:/bin") -> str:
    """What is said of a program that is started in the folder."""
    with pytest.raises(OSError) as refused:
        vessel.spawn_program([name], {"PATH": path}, folder, 0o22, Birth())
    return in_words(refused.value)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nosuch", "no directory of its PATH has nosuch (PATH is /usr/bin:/bin)"),
        ("mapper.py", "no directory of its PATH has mapper.py; start the one in {} by python3 mapper.py (PATH is /usr/bin:/bin)"),
        ("tool", "no directory of its PATH has tool; start the one in {} by ./tool (PATH is /usr/bin:/bin)"),
        ("./nosuch", "No such file or directory"),
        ("./lost", "No such file or directory: the file is there, but not its interpreter /opt/none/python3"),
        ("./maps", "Permission denied: it is a directory"),
        ("./mapper.py", "Permission denied: it is not executable; start it by python3 ./mapper.py, or chmod +x ./mapper.py"),
        (
            "./plain.sh",
            "Exec format error: it does not begin with #!INTERPRETER, and is no program of this machine; "
            "start it by sh ./plain.sh",
        ),
    ],
)
def test_the_reason_and_the_command_that_would_work_are_named(name: str, said: str, folder: Path) -> None:
    assert refusal(name, folder) == said.format(folder)


def test_a_file_on_the_path_that_is_not_executable_is_named(folder: Path) -> None:
    said = refusal("mapper.py", folder, f"/usr/bin:{folder}")
    assert said.startswith(f"Permission denied: it is not executable; start it by python3 {folder}/mapper.py")


def test_a_directory_that_is_gone_is_named(folder: Path) -> None:
    with pytest.raises(FileNotFoundError) as refused:
        vessel.spawn_program(["true"], {"PATH": "/bin"}, folder / "gone", 0o22, Birth())
    assert in_words(refused.value) == f"No such file or directory ({folder}/gone)"


def test_what_the_kernel_says_is_told_without_numbers_and_bytes() -> None:
    assert in_words(FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), b"/bin/mapper.py")) == (
        "No such file or directory (/bin/mapper.py)"
    )
    assert in_words(OSError(errno.EXDEV, "Invalid cross-device link", "a", None, b"b")) == "Invalid cross-device link (a, b)"
    assert in_words(OSError(errno.EBADF, "Bad file descriptor", 7)) == "Bad file descriptor (7)"
    assert in_words(TimeoutError("too late")) == "too late"
