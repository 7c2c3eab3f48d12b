"""While a program stands still its tracer comes before ordinary threads, and not a moment longer."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.captured_process import CapturedProcess
from checkpoint.engines.ptrace_capture import PtraceSession
from checkpoint.errors import CaptureError
from checkpoint.linux import precedence
from checkpoint.linux.precedence import Precedence
from tests.checkpoint.round_trip import ended, protected, start


def _policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


@pytest.fixture
def allowed() -> None:
    """Where the system allows it."""
    before = os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(precedence.PRIORITY))
    except OSError as error:
        pytest.skip(f"no real-time priority here: {error.strerror}")
    os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, before)


@pytest.mark.root
@pytest.mark.compiler
def test_its_tracer_has_precedence_while_a_program_stands_still(
    allowed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    look = CapturedProcess.look

    def looking(self: CapturedProcess, *arguments: object, **named: object) -> object:
        seen.append(_policy())
        if len(seen) == 3:
            raise CaptureError("seen enough")
        return look(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(CapturedProcess, "look", looking)
    monkeypatch.setattr(precedence, "LONG_S", 60.0)
    with ended(start(["sleep", "600"], tmp_path)) as program, protected(program) as session:
        assert isinstance(session, PtraceSession)
        session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=2))
        assert _policy() == os.SCHED_OTHER
        with pytest.raises(CaptureError, match="seen enough"):
            session.capture(CaptureOrder(base=False, sequence=3))
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=4, hold=True))
        assert _policy() == os.SCHED_OTHER, "it stands still for good: nothing is urgent"
    assert seen == [os.SCHED_RR] * 4


def test_a_look_that_takes_long_has_no_precedence_the_next_time(allowed: None) -> None:
    now, seen = [0.0], []
    ours = Precedence(lambda: now[0])
    for long in (0.001, 1.0, 1.0, 0.001, 0.001):
        ours.take()
        seen.append(_policy() == os.SCHED_RR)
        now[0] += long
        ours.give_back()
        assert _policy() == os.SCHED_OTHER
    assert seen == [True, True, False, False, True]


def test_a_real_time_priority_that_it_has_already_is_kept(allowed: None) -> None:
    ours, given = Precedence(), os.sched_param(7)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, given)
    try:
        ours.take()
        assert os.sched_getparam(0) == given
        ours.give_back()
        assert os.sched_getparam(0) == given
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def test_where_it_is_refused_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def refused(pid: int, policy: int, parameter: os.sched_param) -> None:
        asked.append(policy)
        raise PermissionError(1, "no")

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    ours = Precedence()
    for _ in range(2):
        ours.take()
        ours.give_back()
    assert len(asked) == 1, "and it is not asked for again"
