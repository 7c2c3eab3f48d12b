"""Files of a program that runs while its descriptors are read: a change between two looks causes no refusal."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from checkpoint.resources.files import regular
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.survey import gather


def test_a_file_that_is_deleted_between_two_looks_is_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb"):
        (held,) = (one for one in gather(os.getpid()) if one.first.target == str(path))
        path.unlink()
        assert regular.refuse(held, Surroundings()) is None


def test_a_file_that_gets_its_name_back_between_two_looks_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a database's journal does, which is deleted and made again, mostly of the same inode and under the same number."""
    path, away = tmp_path / "journal", tmp_path / "away"
    with path.open("wb"):
        (held,) = (one for one in gather(os.getpid()) if one.first.target == str(path))
        path.rename(away)
        really_is_found = regular.is_found

        def is_found_and_comes_back(held: OpenFile) -> bool:
            found = really_is_found(held)
            if away.exists():
                away.rename(path)
            return found

        monkeypatch.setattr(regular, "is_found", is_found_and_comes_back)
        assert regular.refuse(held, Surroundings()) is None


def test_a_file_that_was_put_under_the_name_of_ours_is_not_taken_for_it(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb"):
        (held,) = (one for one in gather(os.getpid()) if one.first.target == str(path))
        path.rename(tmp_path / "moved")
        path.touch()
        assert "no path leads to" in (regular.refuse(held, Surroundings()) or "")
