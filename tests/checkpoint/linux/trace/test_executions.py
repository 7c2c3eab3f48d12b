"""A thread that executes another program while its process is being stopped: no thread waits for ever, none is left stopped."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.engines.ptrace.capture import enter
from checkpoint.errors import CaptureError, CheckpointError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.trace import threads as all_of_one
from checkpoint.linux.trace.bulk_stops import Together
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Stop, Tracee, no_stop
from checkpoint.program import cpu_baseline
from tests.checkpoint.linux.trace.test_threads import open_descriptors, states, tracers
from tests.checkpoint.round_trip import ENGINE, PATIENCE_S, Program, another_thread, ended, expect_ok, start_tracee

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

OTHERS = 4
"""Threads of executes.c besides the one that executes."""
MANY = 1000
"""Fewer threads are asked one after the other, if `checkpoint.linux.trace.threads.FEW` is this."""


def have_it_execute(tracee: Program) -> None:
    """Until it has executed its program, or waits inside the kernel for us to take note of the others' ends, or stands still."""
    executes = another_thread(tracee.pid)
    tracee.tell()
    deadline = time.monotonic() + PATIENCE_S
    while "executed" not in tracee.output and "D" not in states(tracee.pid) and state(tracee.pid, executes) != "t":
        assert time.monotonic() < deadline, f"it executes nothing: {states(tracee.pid)}"


def state(pid: int, tid: int) -> str:
    """Of one thread; "" when it has gone."""
    try:
        return procfs.thread_stat(pid, tid).state
    except ProcessGoneError:
        return ""


def see_all_others_stand(tracee: Program) -> None:
    """Who stands is let go at once; no note is taken of the stops, which are for the tracer."""
    deadline = time.monotonic() + PATIENCE_S
    while states(tracee.pid).count("t") < OTHERS:
        assert time.monotonic() < deadline, f"not all others stand: {states(tracee.pid)}"


def freeze_until_it_stands(threads: Threads) -> None:
    """Whatever becomes of it meanwhile."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return threads.freeze()
        except CaptureError:
            if time.monotonic() > deadline:
                raise


@pytest.fixture
def before_all_others() -> Iterator[None]:
    """We have one processor for ourselves and all whom we start, who run there while we sleep: whoever we start is in the middle
    of its execve(2) when that has let us go on."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    yield
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def just_started(**variables: str) -> Iterator[int]:
    with subprocess.Popen(["sleep", "1000"], env={**os.environ, **variables}) as program:
        try:
            yield program.pid
        finally:
            program.kill()


def test_a_program_that_has_just_been_started_is_looked_at_when_it_is_there(before_all_others: None) -> None:
    level = next(iter(cpu_baseline.LEVELS))
    for _ in range(20):
        with just_started(**{cpu_baseline.VARIABLE: level}) as pid:
            report = ENGINE.probe(pid)
            assert not report.reasons
            assert report.command == "sleep 1000"
            assert any(f"started for {level}" in finding.text for finding in report.findings)


def test_a_program_that_has_just_been_started_can_be_protected_at_once(before_all_others: None) -> None:
    for _ in range(20):
        with just_started() as pid, contextlib.closing(ENGINE.protect(pid, ProtectOrder("/test/sleeper"))) as session:
            assert session.capture(CaptureOrder(sequence=1)).is_base


@pytest.mark.parametrize("step", ["seize", "ask_to_stop", "has_stopped", "detach"])
@pytest.mark.parametrize("turn", [1, 2, 4, 5])
def test_an_execution_at_any_step_of_a_freeze_ends_it(
    step: str, turn: int, compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = 0
    original = getattr(Tracee, step)

    def then_execute(self: Tracee, *arguments: object) -> object:
        nonlocal turns
        answer = original(self, *arguments)
        turns += 1
        if turns == turn:
            have_it_execute(tracee)
        return answer

    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        monkeypatch.setattr(all_of_one, "FEW", MANY)
        monkeypatch.setattr(Tracee, step, then_execute)
        expect_an_end_of_a_freeze(tracee, monkeypatch, fails=step != "detach")


@pytest.mark.parametrize("step", ["seize", "ask_to_stop", "reports", "let_go"])
@pytest.mark.parametrize("turn", [0, 1, 2, 4, 5])
def test_an_execution_in_the_middle_of_a_step_that_all_take_together_ends_it(
    step: str, turn: int, compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    has_executed = False
    original = getattr(Together, step)

    def in_two_goes(self: Together, tids: list[int]) -> list[object]:
        nonlocal has_executed
        if has_executed:
            return list(original(self, tids))
        before = original(self, tids[:turn])
        has_executed = True
        have_it_execute(tracee)
        return [*before, *original(self, tids[turn:])]

    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        monkeypatch.setattr(Together, step, in_two_goes)
        expect_an_end_of_a_freeze(tracee, monkeypatch, fails=step != "let_go")
        assert has_executed


def expect_an_end_of_a_freeze(tracee: Program, monkeypatch: pytest.MonkeyPatch, *, fails: bool) -> None:
    """Its thread executes a program in the middle of one: that may fail, nobody is harmed."""
    ours = open_descriptors()
    threads = Threads(Tracee(tracee.pid))
    try:
        threads.freeze()
    except CheckpointError:
        assert fails
    else:
        threads.thaw()
    monkeypatch.undo()
    expect_unharmed(tracee, threads)
    assert open_descriptors() == ours


def test_a_thread_that_did_not_stop_and_executes_a_program_instead_is_let_go(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask, detach = Tracee.ask_to_stop, Tracee.detach

    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        executes = another_thread(tracee.pid)

        def ask_all_but_one(self: Tracee) -> Stop | None:
            if self.pid == executes:
                raise no_stop(executes, 0.0)
            return ask(self)

        def detach_then_execute(self: Tracee, signal: int = 0) -> None:
            detach(self, signal)
            if self.pid == tracee.pid:
                have_it_execute(tracee)

        threads = Threads(Tracee(tracee.pid))
        monkeypatch.setattr(all_of_one, "FEW", MANY)
        monkeypatch.setattr(Tracee, "ask_to_stop", ask_all_but_one)
        monkeypatch.setattr(Tracee, "detach", detach_then_execute)
        with pytest.raises(CaptureError, match="did not stop"):
            threads.freeze()
        tracee.wait_until((tmp_path / "go").exists, "the first thread to be let go, which may not have stopped yet either")
        monkeypatch.undo()
        expect_unharmed(tracee, threads)


def test_a_thread_that_executes_a_program_between_two_looks_at_it_is_let_go(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had not stopped under its own id, and by the time it is asked once more that id is gone."""
    ask, reported = Tracee.ask_to_stop, Tracee.reported
    looked_at: list[int] = []

    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        executes = another_thread(tracee.pid)

        def ask_all_but_one(self: Tracee) -> Stop | None:
            if self.pid == executes:
                see_all_others_stand(tracee)
                raise no_stop(executes, 0.0)
            return ask(self)

        def report_then_execute(self: Tracee) -> Stop | None:
            stop = reported(self)
            if self.pid == executes and stop is None:
                looked_at.append(executes)
                tracee.tell()
                tracee.wait_for_line("executed")
            return stop

        threads = Threads(Tracee(tracee.pid))
        monkeypatch.setattr(all_of_one, "FEW", MANY)
        monkeypatch.setattr(Tracee, "ask_to_stop", ask_all_but_one)
        monkeypatch.setattr(Tracee, "reported", report_then_execute)
        with pytest.raises(CaptureError, match="did not stop"):
            threads.freeze()
        monkeypatch.undo()
        assert looked_at
        expect_unharmed(tracee, threads)


def test_a_thread_that_is_ours_since_an_earlier_look_keeps_no_execution_waiting(compiled: Compiled, tmp_path: Path) -> None:
    """It has ended for the execution, which waits for us to take note; we wait for that, and hear no signal meanwhile."""
    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        earlier = Tracee(sorted(thread_ids(tracee.pid))[1])
        earlier.seize()
        tracee.tell()
        tracee.wait_until(lambda: state(tracee.pid, earlier.pid) == "Z", "its end")
        threads = Threads(Tracee(tracee.pid))
        freeze_until_it_stands(threads)
        threads.thaw()
        expect_unharmed(tracee, threads)


def test_who_looks_whether_a_program_has_ended_takes_no_note_of_its_stops(compiled: Compiled, tmp_path: Path) -> None:
    """They are for the tracer, who is told once; each wait in these tests looks."""
    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        leader = Tracee(tracee.pid)
        leader.seize()
        leader.interrupt()
        tracee.wait_until(lambda: state(tracee.pid, tracee.pid) == "t", "the first thread to stand")
        assert tracee.poll() is None
        assert leader.reported() is not None
        leader.detach()


def test_a_protection_that_fails_leaves_nothing_open_however_long_its_error_is_kept(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def give_up(threads: Threads, _: object) -> None:
        threads.freeze()
        threads.thaw()
        raise CaptureError("it has become another program")

    with ended(start_tracee(compiled("executes", "-O2", "-pthread"), tmp_path)) as tracee:
        ours = open_descriptors()
        monkeypatch.setattr(enter, "enter", give_up)
        with pytest.raises(CaptureError, match="another program") as kept:
            ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))
        assert open_descriptors() == ours, kept


def expect_unharmed(tracee: Program, threads: Threads) -> None:
    """It has executed its program, nobody traces that, and it can be stopped like any other."""
    tracee.wait_for_line("executed")
    tracee.wait_until(lambda: tracers(tracee.pid) == {"0"}, "nobody to trace it")
    freeze_until_it_stands(threads)
    assert states(tracee.pid) == "t"
    threads.thaw()
    assert tracers(tracee.pid) == {"0"}
    threads.close()
    (tracee.directory / "may-end").touch()
    expect_ok(tracee)
