"""While a program stands still its tracer comes before ordinary threads, and not a moment longer."""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.errors import CaptureError
from checkpoint.linux import realtime_boost
from checkpoint.linux.realtime_boost import Precedence
from checkpoint.linux.trace.threads import Threads
from tests.checkpoint.round_trip import ended, protected, start


def _policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


@pytest.fixture
def allowed() -> None:
    """Where the system allows it."""
    before = os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(realtime_boost.PRIORITY))
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
        if len(seen) == 4:
            raise CaptureError("seen enough")
        return look(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(CapturedProcess, "look", looking)
    monkeypatch.setattr(realtime_boost, "LONG_S", 60.0)
    with ended(start(["sleep", "600"], tmp_path)) as program, protected(program) as session:
        assert isinstance(session, PtraceSession)
        session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=2))
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=3))
        assert _policy() == os.SCHED_OTHER
        with pytest.raises(CaptureError, match="seen enough"):
            session.capture(CaptureOrder(base=False, sequence=4))
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=5, hold=True))
        assert _policy() == os.SCHED_OTHER, "it stands still for good: nothing is urgent"
    assert seen == [os.SCHED_OTHER] + [os.SCHED_RR] * 4, "of the first look nobody knows whether it is short"


@pytest.mark.root
@pytest.mark.compiler
def test_its_tracer_is_ordinary_again_even_where_letting_go_goes_wrong(
    allowed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    thaw = Threads.thaw

    def wrongly(self: Threads) -> None:
        thaw(self)
        raise RuntimeError("nobody expected this")

    monkeypatch.setattr(realtime_boost, "LONG_S", 60.0)
    with ended(start(["sleep", "600"], tmp_path)) as program, protected(program) as session:
        session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
        with monkeypatch.context() as broken:
            broken.setattr(Threads, "thaw", wrongly)
            with pytest.raises(RuntimeError, match="nobody expected"):
                session.capture(CaptureOrder(base=False, sequence=2))
        assert _policy() == os.SCHED_OTHER
        session.capture(CaptureOrder(base=False, sequence=3))


def _weight() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def test_after_a_look_that_takes_long_and_before_the_first_it_has_weight_instead_of_precedence(allowed: None) -> None:
    now, seen, usual = [0.0], [], _weight()
    ours = Precedence(lambda: now[0])
    for long in (0.001, 0.001, 1.0, 1.0, 0.001, 0.001):
        ours.take()
        seen.append(_policy() == os.SCHED_RR)
        assert seen[-1] or _weight() == realtime_boost.NICE
        now[0] += long
        ours.give_back()
        assert (_policy(), _weight()) == (os.SCHED_OTHER, usual)
    assert seen == [False, True, True, False, False, True]


def test_a_look_that_waits_for_long_has_precedence_the_next_time_too(allowed: None) -> None:
    """On a busy machine all of them do, and there it is of use."""
    ours, seen = Precedence(), []
    for _ in range(3):
        ours.take()
        seen.append(_policy() == os.SCHED_RR)
        time.sleep(3 * realtime_boost.LONG_S)
        ours.give_back()
    assert seen == [False, True, True]


def test_what_is_put_off_on_purpose_is_so_again(allowed: None) -> None:
    ours = Precedence(lambda: 0.0)
    os.sched_setscheduler(0, os.SCHED_BATCH | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    try:
        for expected in (os.SCHED_BATCH, os.SCHED_RR):
            ours.take()
            assert _policy() == expected
            ours.give_back()
            assert _policy() == os.SCHED_BATCH
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def test_who_would_be_ended_for_it_has_no_precedence(allowed: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit for time in real time (RLIMIT_RTTIME) ends whoever reaches it."""
    monkeypatch.setattr(resource, "getrlimit", lambda which: {resource.RLIMIT_RTTIME: (200_000, 200_000)}[which])
    ours = Precedence(lambda: 0.0)
    for _ in range(3):
        ours.take()
        assert _policy() == os.SCHED_OTHER
        ours.give_back()


def test_a_real_time_priority_that_it_has_already_is_kept(allowed: None) -> None:
    ours, given = Precedence(lambda: 0.0), os.sched_param(7)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, given)
    try:
        for _ in range(2):
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
    ours = Precedence(lambda: 0.0)
    for _ in range(3):
        ours.take()
        ours.give_back()
    assert len(asked) == 1, "and it is not asked for again"
