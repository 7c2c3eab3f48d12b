"""Programs whose first thread has ended while others live on: looked at by a spokesman, and what they were in every life."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.freezer import SignalFreezer
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import UnsupportedError
from checkpoint.linux.spokesman import PIDFD_THREAD, spokesman_of
from checkpoint.resources import refused_threads
from tests.checkpoint.round_trip import (
    ENGINE,
    LIVES,
    Program,
    as_nobody,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    expect_three_lives,
    protected,
    restored,
    start_tracee,
    transported,
)
from tests.checkpoint.test_ids import let_nobody_in

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


def lends_through_threads() -> bool:
    """Whether this kernel is of Linux 6.9 or later, as far as that matters here."""
    try:
        os.close(os.pidfd_open(os.getpid(), PIDFD_THREAD))
    except OSError:
        return False
    return True


needs_lending = pytest.mark.skipif(not lends_through_threads(), reason="this kernel lends no descriptors through a thread")


def started(compiled: Compiled, directory: Path, *mode: str, isolate: bool = False) -> Program:
    """The tracee, its first thread gone."""
    return start_tracee(compiled("ended_first", "-O2", "-pthread"), directory, *mode, isolate=isolate)


def first_has_ended(program: Program) -> bool:
    """Whether it is a zombie."""
    return Path(f"/proc/{program.pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


@needs_lending
@pytest.mark.parametrize("isolate", [False, True])
def test_it_is_the_same_after_three_lives(compiled: Compiled, tmp_path: Path, isolate: bool) -> None:
    tracee = started(compiled, tmp_path, isolate=isolate)
    assert first_has_ended(tracee)
    expect_three_lives(tracee, tmp_path)


@needs_lending
def test_its_status_is_what_it_would_have_been_in_every_life(compiled: Compiled, tmp_path: Path) -> None:
    """Its threads end one by one: older kernels tell the status of the first of them, newer ones that of the last."""
    with ended(started(compiled, tmp_path, "status")) as never_captured:
        never_captured.tell()
        status = never_captured.finish()
    (tmp_path / "go").unlink()
    (tmp_path / "out").unlink()
    assert status in (3, 7)
    tracee = started(compiled, tmp_path, "status")
    for _ in range(LIVES):
        with ended(tracee):
            snapshot = captured_and_killed(tracee)
        assert len(snapshot.threads) == 5
        tracee = restored(snapshot, tmp_path)
    with ended(tracee):
        tracee.tell()
        assert (tracee.finish(), tracee.output.splitlines()[-1:]) == (status, ["ok"]), tracee.output


@needs_lending
def test_a_first_thread_that_ends_under_protection_makes_the_next_capture_a_base(compiled: Compiled, tmp_path: Path) -> None:
    tracee = started(compiled, tmp_path, "late")
    with ended(tracee), protected(tracee) as session:
        before = captured_at_last(session, CaptureOrder())
        session.acknowledge(before.position)
        (tmp_path / "leave").touch()
        tracee.wait_until(lambda: first_has_ended(tracee), "the first thread's end")
        base = captured_at_last(session, CaptureOrder(base=False, sequence=1))
        assert base.parent is None
        assert base.threads[0].tid == base.process.pid == before.process.pid
        session.acknowledge(base.position)
        delta = captured_at_last(session, CaptureOrder(base=False, sequence=2))
        assert delta.parent == base.position
        tracee.kill()
    (tmp_path / "leave").unlink()
    again = restored([transported(base), transported(delta)], tmp_path)
    with ended(again):
        again.tell()
        expect_ok(again)


@needs_lending
def test_a_spokesman_that_ends_is_followed_by_another(compiled: Compiled, tmp_path: Path) -> None:
    tracee = started(compiled, tmp_path, "brief")
    with ended(tracee), protected(tracee) as session:
        spokesman = spokesman_of(tracee.pid)
        captured_at_last(session, CaptureOrder())
        (tmp_path / "hush").touch()
        tracee.wait_until(lambda: not Path(f"/proc/{tracee.pid}/task/{spokesman}").exists(), "the spokesman's end")
        snapshot = transported(captured_at_last(session, CaptureOrder(sequence=1)))
        assert len(snapshot.threads) == 4
        tracee.kill()
    expect_three_lives(restored(snapshot, tmp_path), tmp_path)


@needs_lending
def test_one_that_is_killed_while_it_is_held_ends_for_its_parent(compiled: Compiled, tmp_path: Path) -> None:
    tracee = started(compiled, tmp_path)
    with ended(tracee), protected(tracee) as session:
        captured_at_last(session, CaptureOrder(hold=True))
        os.kill(tracee.pid, signal.SIGKILL)
        assert tracee.finish() == -signal.SIGKILL


def test_one_that_has_children_is_refused_by_name_and_goes_on(compiled: Compiled, tmp_path: Path) -> None:
    tracee = started(compiled, tmp_path, "child")
    with ended(tracee):
        report = ENGINE.probe(tracee.pid)
        assert any("its first thread has ended while others live" in reason for reason in report.reasons)
        with pytest.raises(UnsupportedError, match="its first thread has ended while others live"):
            ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))
        tracee.tell()
        expect_ok(tracee)


def test_where_the_kernel_lends_no_descriptors_it_is_refused_by_name_and_goes_on(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refused_threads, "can_look_through", lambda _: False)
    tracee = started(compiled, tmp_path)
    with ended(tracee):
        with pytest.raises(UnsupportedError, match="this kernel lends no descriptors through another"):
            ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))
        tracee.tell()
        expect_ok(tracee)


def test_sigstop_holds_one_until_it_is_thawed(compiled: Compiled, tmp_path: Path) -> None:
    """Its first thread is a zombie, held or not: the others tell whether it stands."""
    tracee = started(compiled, tmp_path)
    with ended(tracee):
        freezer = SignalFreezer()
        freezer.add(tracee.pid)
        assert freezer.freeze()
        states = [
            task.joinpath("stat").read_text().rpartition(")")[2].split()[0] for task in Path(f"/proc/{tracee.pid}/task").iterdir()
        ]
        assert sorted(states) == ["T"] * 4 + ["Z"]
        freezer.thaw()
        tracee.tell()
        expect_ok(tracee)


@needs_lending
def test_an_ordinary_user_can_do_it_too(compiled: Compiled, tmp_path: Path) -> None:
    program = compiled("ended_first", "-O2", "-pthread")
    let_nobody_in(tmp_path, program)

    def act() -> str:
        tracee = start_tracee(program, tmp_path, isolate=True)
        with ended(tracee):
            captured(tracee)
            snapshot = captured_and_killed(tracee)
        again = restored(snapshot, tmp_path)
        with ended(again):
            again.tell()
            expect_ok(again)
        return "ok"

    assert as_nobody(act) == "ok"
