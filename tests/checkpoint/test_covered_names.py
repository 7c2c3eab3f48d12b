"""Named pipes and unix sockets whose name leads elsewhere by now: see ``tests/tracees/covered_names.c``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.engine import RestoreOptions
from checkpoint.engines import restore_checks
from checkpoint.errors import MismatchError, UnsupportedError
from tests.checkpoint.round_trip import (
    captured,
    captured_and_killed,
    covered,
    ended,
    expect_ok,
    expect_three_lives,
    restored,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


@pytest.mark.parametrize("case", ["pipe", "accepted", "accepted_whole"])
def test_what_a_mount_covers_is_as_it_was_after_three_lives(case: str, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, case)
    with covered(tmp_path / "place"):
        expect_three_lives(tracee, tmp_path)
        assert not any((tmp_path / "place").iterdir()), "nothing was left in what was mounted"


@pytest.mark.parametrize("case", ["accepted", "accepted_whole"])
def test_a_mount_over_an_accepted_socket_is_not_held_by_the_restored_one(case: str, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, case)
    with covered(tmp_path / "place"), ended(tracee):
        for _ in range(2):
            tracee = restored(captured_and_killed(tracee), tmp_path)
    (tmp_path / "place" / "door").unlink()
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


def test_a_socket_whose_name_is_a_file_by_now_comes_back_and_the_file_stays(compiled: Compiled, tmp_path: Path) -> None:
    expect_three_lives(start_tracee(compiled("covered_names"), tmp_path, "replaced"), tmp_path)


def test_a_listener_below_a_mount_is_refused_and_unharmed(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, "listening")
    with covered(tmp_path / "place"), ended(tracee):
        with pytest.raises(UnsupportedError, match="whose name a mount hides"):
            captured(tracee)
        tracee.tell()
        expect_ok(tracee)


def test_a_named_pipe_that_a_mount_covers_is_not_opened_for_an_ordinary_user(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, "pipe")
    with covered(tmp_path / "place"), ended(tracee):
        snapshot = captured_and_killed(tracee)
        with pytest.raises(MismatchError, match="which a mount covers, is opened again for root alone"):
            restore_checks.require(snapshot, RestoreOptions(own_eyes=True), os.getpid())


def test_a_named_pipe_that_is_not_below_the_mount_here_is_named(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, "pipe")
    with covered(tmp_path / "place"), ended(tracee):
        snapshot = captured_and_killed(tracee)
    (tmp_path / "place" / "pipe").unlink()
    with pytest.raises(MismatchError, match="which a mount covers, is not on this machine"):
        restored(snapshot, tmp_path)
