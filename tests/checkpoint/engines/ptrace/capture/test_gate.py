"""A capture waits at its gate while the program runs on: what comes meanwhile is followed, and the wait does not count."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.capture import session as session_module
from checkpoint.engines.ptrace.capture.freeze_budget import LONG_CAPTURE_NS
from checkpoint.engines.ptrace.capture.frozen_component import Frozen
from checkpoint.engines.ptrace.capture.memory import RunningCopy
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.session import MOVED_S, PtraceSession
from checkpoint.engines.ptrace.capture.tree import MovedError
from tests.checkpoint.round_trip import ended, protected, start

pytestmark = pytest.mark.root

PARENT = """
import os, sys, time
print("ready", flush=True)
while not os.path.exists(sys.argv[1] + "/go"):
    time.sleep(0.002)
parent = os.getpid()
if not os.fork():
    print("born", flush=True)
    while os.getppid() == parent:
        time.sleep(0.002)
    os._exit(0)
time.sleep(1000)
"""


class WaitingGate:
    """Opens at the second question of each turn; does something before."""

    def __init__(self, wait: Callable[[], None]) -> None:
        self._wait = wait
        self._has_waited = False

    def opens(self, pids: tuple[int, ...]) -> bool:
        self._has_waited = not self._has_waited
        if self._has_waited:
            self._wait()
        return not self._has_waited

    def closes(self, *, stood_still: bool) -> None:
        """As of a gate that keeps no account."""


def test_a_process_that_is_born_during_the_wait_is_entered_before_the_freeze(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered, standing = [], CapturedProcess.entered_standing

    def counted(*given: Any) -> CapturedProcess:
        entered.append(given)
        return standing(*given)

    def have_a_child() -> None:
        (tmp_path / "go").touch()
        program.wait_for_line("born")

    monkeypatch.setattr(CapturedProcess, "entered_standing", counted)
    with ended(start([sys.executable, "-S", "-c", PARENT, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        session.capture(CaptureOrder(sequence=1, gate=WaitingGate(have_a_child)))
        program.kill()
    assert not entered, "to enter one while it stands still takes milliseconds"


def moving(monkeypatch: pytest.MonkeyPatch, now: list[float], moves: list[MovedError]) -> list[bool]:
    """Have the first freezes fail, by a clock of our own: for each freeze from now on, whether the capture counts as long."""
    look, is_long = PtraceSession._frozen_look, list[bool]()

    def failing(self: PtraceSession, *given: Any, **named: Any) -> Frozen:
        is_long.append(self._budget.is_long)
        if moves:
            raise moves.pop()
        return look(self, *given, **named)

    monkeypatch.setattr(session_module, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=time.sleep))
    monkeypatch.setattr(PtraceSession, "_frozen_look", failing)
    return is_long


def test_a_capture_whose_copy_took_long_is_made_again_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else gigabytes would be copied anew for a process that came in the middle of the first freeze.

    Only one freeze may take as long as it must: the second one begins with little to copy.
    """
    now, moves, copies = [0.0], [MovedError("one has come")], list[object]()
    copy = CapturedProcess.copy_running

    def slow(self: CapturedProcess, *, copied: RunningCopy | None = None, **named: Any) -> RunningCopy:
        copies.append(copied)
        if copied is None:
            now[0] += MOVED_S + LONG_CAPTURE_NS / 1e9
        return copy(self, copied=copied, **named)

    is_long = moving(monkeypatch, now, moves)
    monkeypatch.setattr(CapturedProcess, "copy_running", slow)
    with ended(start([sys.executable, "-S", "-c", PARENT, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        assert isinstance(session, PtraceSession)
        monkeypatch.setattr(session._budget, "_clock", lambda: int(now[0] * 1e9))
        session.capture(CaptureOrder(sequence=1))
        program.kill()
    assert len(copies) == 2
    assert copies[0] is None
    assert copies[1] is not None, "the second freeze goes on with the copy of the first"
    assert is_long == [True, False]


def test_the_wait_counts_neither_as_a_capture_that_is_made_again_too_often_nor_as_a_long_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes come and go in the middle of two freezes, and before each there is a long wait."""
    now = [0.0]
    moves = [MovedError("one has come"), MovedError("one has gone")]

    def wait() -> None:
        now[0] += MOVED_S + LONG_CAPTURE_NS / 1e9

    is_long = moving(monkeypatch, now, moves)
    with ended(start([sys.executable, "-S", "-c", PARENT, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        assert isinstance(session, PtraceSession)
        monkeypatch.setattr(session._budget, "_clock", lambda: int(now[0] * 1e9))
        session.capture(CaptureOrder(sequence=1, gate=WaitingGate(wait)))
        program.kill()
    assert is_long == [False, False, False]
