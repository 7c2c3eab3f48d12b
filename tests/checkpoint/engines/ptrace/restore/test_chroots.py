"""Programs with a root directory of their own: see ``tests/tracees/chroots.c``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.restore.process_state import enter_root
from checkpoint.engines.ptrace.restore.vessel import Vessel
from checkpoint.errors import CheckpointError, MismatchError, UnsupportedError
from checkpoint.linux.trace.call_table import CallTable
from tests.checkpoint.round_trip import (
    ENGINE,
    as_nobody,
    captured,
    captured_and_killed,
    ended,
    expect_three_lives,
    protected,
    restored,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


@pytest.mark.parametrize("case", ["inside", "across", "sockets", "linked", "watch", "user"])
def test_a_program_in_a_chroot_stays_there_over_three_lives(case: str, compiled: Compiled, tmp_path: Path) -> None:
    expect_three_lives(start_tracee(compiled("chroots"), tmp_path, case), tmp_path)


@pytest.mark.parametrize("case", ["inside", "sockets", "child"])
def test_a_program_in_a_chroot_comes_back_in_pids_of_its_own(case: str, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("chroots"), tmp_path, case, isolate=True)
    expect_three_lives(tracee, tmp_path)


@pytest.mark.parametrize(
    ("case", "reason"), [("watch_outside", "outside its root directory"), ("common", "has its directories in common with")]
)
def test_what_a_chroot_makes_unreachable_is_refused_and_unharmed(
    case: str, reason: str, compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, case)) as tracee:
        with pytest.raises(UnsupportedError, match=reason):
            captured(tracee)
        tracee.tell()
        assert tracee.finish() == 0, tracee.output


def test_a_root_directory_that_is_missing_here_is_named(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, "across")) as tracee:
        snapshot = captured_and_killed(tracee)
    (tmp_path / "cage").rename(tmp_path / "elsewhere")
    with pytest.raises(MismatchError, match=r"its root directory .*/cage is missing"):
        restored(snapshot, tmp_path)


def test_a_root_directory_that_is_gone_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, "across")) as tracee:
        (tmp_path / "cage" / "work").rmdir()
        (tmp_path / "cage").rmdir()
        with pytest.raises(CheckpointError, match=r"its root directory .*/cage \(deleted\) is gone"):
            captured(tracee)


def test_what_entering_its_root_directory_takes_is_said_when_it_is_looked_at(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, "across")) as tracee, protected(tracee) as session:
        said = f"its root directory is {tmp_path}/cage: to enter that again takes CAP_SYS_CHROOT"
        assert any(said in note for note in ENGINE.probe(tracee.pid).notes)
        assert any(said in note for note in session.notes)


@pytest.mark.parametrize("isolate", [False, True], ids=["of this machine", "in PIDs of its own"])
def test_a_standby_that_may_not_enter_its_root_directory_says_so_beforehand(
    isolate: bool, compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, "inside", isolate=isolate)) as tracee:
        outline = captured_and_killed(tracee)

    def lacking() -> str:
        return "\n".join(ENGINE.lacks(outline, RestoreOptions()))

    assert ("takes CAP_SYS_CHROOT" in as_nobody(lacking)) == (not isolate)
    assert "CAP_SYS_CHROOT" not in lacking()


def test_who_may_not_enter_a_root_directory_is_told_so(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("chroots"), tmp_path, "across")) as tracee:
        process = captured_and_killed(tracee).process
    whole = (1 << 41) - 1
    for capabilities, may in ((whole, True), (whole & ~(1 << 18), False)):
        rights = replace(process.credentials, capabilities=(0, capabilities, capabilities, capabilities, 0))
        vessel = Vessel(process.pid, process.pid, rights, frozenset({0}), {})
        with contextlib.nullcontext() if may else pytest.raises(MismatchError, match="takes CAP_SYS_CHROOT: restore it as root"):
            enter_root(CallTable(1 << 32), process, vessel)
