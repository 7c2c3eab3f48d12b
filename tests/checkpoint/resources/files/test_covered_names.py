"""Named pipes and unix sockets whose name leads elsewhere by now: see ``tests/tracees/covered_names.c``."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.restore import checks
from checkpoint.errors import MismatchError, UnsupportedError
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.sockets import unix_names
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
            checks.require(snapshot, RestoreOptions(own_eyes=True), os.getpid())


def test_a_named_pipe_that_is_not_below_the_mount_here_is_named(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("covered_names"), tmp_path, "pipe")
    with covered(tmp_path / "place"), ended(tracee):
        snapshot = captured_and_killed(tracee)
    (tmp_path / "place" / "pipe").unlink()
    with pytest.raises(MismatchError, match="which a mount covers, is not on this machine"):
        restored(snapshot, tmp_path)


@pytest.mark.parametrize("act", [Path.unlink, lambda path: path.rename(path.with_name("moved"))], ids=["removed", "moved"])
def test_a_socket_whose_file_goes_away_while_it_is_looked_at_is_below_no_mount(
    act: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, leads_to = [0], unix_names.leads_to

    def look(path: str, about: os.stat_result) -> bool:
        if not looks[0]:
            act(tmp_path / "name")
        looks[0] += 1
        return leads_to(path, about)

    monkeypatch.setattr(unix_names, "leads_to", look)
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(tmp_path / "name"))
        seen = unix_names.observe(OpenFile(os.getpid(), ()), made, os.fsencode(made.getsockname()) + b"\0")
    assert (seen["covered"], seen["mode"] == unix_names.GONE) == (False, act is Path.unlink)
