"""Programs whose first thread has ended while others live on: read through another thread, and the same in every life."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from agent.guard.freezer import SignalFreezer
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import PIDFD_THREAD, SPOKESMEN_MAX, spokesman_of, told_by_spokesman
from checkpoint.linux.procfs.procfs import Stat
from checkpoint.linux.trace.bulk_stops import Together
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.resources.process import refused_threads
from tests.checkpoint.linux.spawn.test_ids import let_nobody_in
from tests.checkpoint.round_trip import (
    ENGINE,
    LIVES,
    Program,
    another_thread,
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
def test_a_spokesman_that_executes_another_program_is_followed_by_nobody(compiled: Compiled, tmp_path: Path) -> None:
    tracee = started(compiled, tmp_path, "exec")
    with ended(tracee), protected(tracee) as session:
        captured_at_last(session, CaptureOrder())
        (tmp_path / "hush").touch()
        tracee.wait_until(lambda: not first_has_ended(tracee), "the other program")
        with pytest.raises(ProcessGoneError, match=r"another program \(exec\)"):
            captured_at_last(session, CaptureOrder(sequence=1))


def test_a_kernel_that_lends_nothing_by_a_spokesman_is_named_and_nothing_is_left_in_the_program(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first thread ends under protection, when it had been looked at by that."""
    opened = os.pidfd_open

    def of_processes_alone(pid: int, flags: int = 0) -> int:
        if flags & PIDFD_THREAD:
            raise OSError(errno.EINVAL, "as before Linux 6.9")
        return opened(pid, flags)

    monkeypatch.setattr(os, "pidfd_open", of_processes_alone)
    tracee = started(compiled, tmp_path, "late")
    with ended(tracee), protected(tracee) as session:
        captured_at_last(session, CaptureOrder())
        (tmp_path / "leave").touch()
        tracee.wait_until(lambda: first_has_ended(tracee), "the first thread's end")
        before = os.listdir(f"/proc/{spokesman_of(tracee.pid)}/fd")
        for sequence in (1, 2):
            with pytest.raises(UnsupportedError, match="this kernel lends no descriptors"):
                captured_at_last(session, CaptureOrder(sequence=sequence))
        assert os.listdir(f"/proc/{spokesman_of(tracee.pid)}/fd") == before
        tracee.tell()
        expect_ok(tracee)


def test_a_stranger_who_has_the_id_of_a_spokesman_by_now_is_left_in_peace(compiled: Compiled, tmp_path: Path) -> None:
    stranger = subprocess.Popen(["sleep", "1000"])
    try:
        with ended(started(compiled, tmp_path)) as tracee:
            threads = Threads(Tracee(stranger.pid), process=tracee.pid)
            with pytest.raises(ProcessGoneError):
                threads.freeze()
    finally:
        stranger.kill()
        stranger.wait()


def test_nobody_speaks_for_a_process_whose_first_thread_lives(compiled: Compiled, tmp_path: Path) -> None:
    with ended(started(compiled, tmp_path, "late")) as tracee:
        with pytest.raises(ProcessGoneError, match="another program"):
            Threads(Tracee(another_thread(tracee.pid)), process=tracee.pid).freeze()


def test_a_first_thread_comes_to_its_end_before_the_others_are_stopped(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until it is a zombie it may still write where those wait who join it."""
    seen: list[str] = []
    read, seize = procfs.thread_stat, Together.seize

    def about_to_end(pid: int, tid: int) -> Stat:
        stat = read(pid, tid)
        if pid != tid or seen.count("ends") >= 3:
            return stat
        seen.append("ends")
        return replace(stat, state="R", flags=stat.flags | procfs.PF_EXITING)

    def noted(together: Together, tids: Sequence[int]) -> list[bool]:
        seen.extend(["seized"] * len(tids))
        return seize(together, tids)

    with ended(started(compiled, tmp_path)) as tracee:
        threads = Threads(Tracee(spokesman_of(tracee.pid)), process=tracee.pid)
        monkeypatch.setattr(procfs, "thread_stat", about_to_end)
        monkeypatch.setattr(Together, "seize", noted)
        threads.freeze()
        threads.thaw()
        threads.close()
    assert seen == ["ends"] * 3 + ["seized"] * 4


def test_spokesmen_that_end_one_after_the_other_are_not_followed_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    ids = itertools.count(2)
    asked: list[int] = []
    monkeypatch.setattr("checkpoint.linux.procfs.live_thread.spokesman_of", lambda _: next(ids))

    def question(tid: int) -> None:
        asked.append(tid)
        assert len(asked) <= SPOKESMEN_MAX, "for ever"

    with pytest.raises(ProbeError, match="its threads end while failover examines it"):
        told_by_spokesman(1, question)


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
        while not freezer.freeze():
            """It is False as well while another child of this process is within the kernel: this machine is busy."""
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
