"""Which process gets the signals of a descriptor, and which signals: as during the freeze, not as right afterwards."""

from __future__ import annotations

import fcntl
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.capture.standstill import Standstill
from checkpoint.linux.procfs.descriptors import copy_of, descriptors
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import Program, captured_at_last, ended, expect_ok, protected, start_tracee

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


def number_of(program: Program, name: str) -> int:
    return next(one.number for one in descriptors(program.pid) if one.target.endswith(name))


def send(program: Program, number: int, wanted: int, owner: int) -> None:
    """Have an open file of a program send a signal; whoever has a copy of the descriptor can."""
    with copy_of(program.pid, number) as copy:
        fcntl.fcntl(copy, fcntl.F_SETSIG, wanted)
        fcntl.fcntl(copy, fcntl.F_SETOWN, owner)


def sent_by(snapshot: Snapshot, name: str) -> tuple[object, object]:
    """(signal, owner) of an open file, by the end of its path."""
    facts = next(held.facts for held in snapshot.resources if str(held.facts.get("path")).endswith(name))
    return facts.get("signal", 0), facts.get("owner", 0)


@pytest.mark.parametrize(("wanted", "to_itself"), [(signal.SIGUSR1, True), (0, False)])
def test_what_is_chosen_right_after_the_freeze_is_not_part_of_the_snapshot(
    wanted: int, to_itself: bool, compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("files", "-O2"), tmp_path, "owner_signal")) as tracee:
        number = number_of(tracee, "/owned")
        thaw = Standstill.thaw

        def thaw_and_choose(standstill: Standstill) -> int:
            ended_ns = thaw(standstill)
            send(tracee, number, wanted, tracee.pid if to_itself else 0)
            return ended_ns

        monkeypatch.setattr(Standstill, "thaw", thaw_and_choose)
        with protected(tracee) as session:
            assert sent_by(session.capture(CaptureOrder(1, 1)), "/owned") == (signal.SIGUSR2, 1)
        monkeypatch.undo()
        send(tracee, number, signal.SIGUSR2, tracee.pid)
        tracee.tell()
        expect_ok(tracee)


def test_an_owner_that_nobody_knew_of_is_asked_for_in_the_next_freeze(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    freezes: list[int] = []
    freeze = Standstill.freeze

    def counted(standstill: Standstill) -> int:
        freezes.append(1)
        return freeze(standstill)

    with ended(start_tracee(compiled("files", "-O2"), tmp_path, "odd_name")) as tracee:
        number = number_of(tracee, "line (deleted)")
        with protected(tracee) as session:
            first = captured_at_last(session, CaptureOrder(1, 1))
            assert sent_by(first, "line (deleted)") == (0, 0)
            send(tracee, number, signal.SIGUSR1, tracee.pid)
            monkeypatch.setattr(Standstill, "freeze", counted)
            assert sent_by(session.capture(CaptureOrder(1, 2)), "line (deleted)") == (signal.SIGUSR1, 1)
            assert len(freezes) == 2
            assert sent_by(session.capture(CaptureOrder(1, 3)), "line (deleted)") == (signal.SIGUSR1, 1)
            assert len(freezes) == 3
        tracee.tell()
        expect_ok(tracee)
