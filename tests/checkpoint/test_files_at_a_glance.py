"""Files of a program that runs while its descriptors are read: what changes between two looks is not held against it."""

from __future__ import annotations

import os
from pathlib import Path

from checkpoint.resources import Surroundings, files, gather


def test_a_file_that_is_deleted_between_two_looks_is_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb"):
        (held,) = (one for one in gather(os.getpid()) if one.first.target == str(path))
        path.unlink()
        assert files.refuse(held, Surroundings()) is None


def test_a_file_that_was_put_under_the_name_of_ours_is_not_taken_for_it(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb"):
        (held,) = (one for one in gather(os.getpid()) if one.first.target == str(path))
        path.rename(tmp_path / "moved")
        path.touch()
        assert "no path leads to" in (files.refuse(held, Surroundings()) or "")
