"""Programs of several threads: a freeze misses none, and none is ever left stopped, whichever step fails."""

from __future__ import annotations

import gc
import itertools
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, RestoreOptions, Session
from checkpoint.errors import CaptureError, MismatchError, ProcessGoneError, UnsupportedError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_program, spawn_vessel
from checkpoint.linux.trace.tracee import Tracee, no_stop
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    expect_three_lives,
    protected,
    restored,
    start,
    start_tracee,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

RACES = int(os.environ.get("FAILOVER_TEST_RACES", "100"))
"""Captures that race with the birth and the end of threads; ten thousand take some minutes."""
SIGCHLD = signal.SIGCHLD


def states(pid: int) -> str:
    """One letter for each thread that is there."""
    found = ""
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found += (task / "stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended
    return found


def tracers(pid: int) -> set[str]:
    """Who traces any of its threads."""
    found = set()
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found |= {line.split()[1] for line in (task / "status").read_text().splitlines() if line.startswith("TracerPid")}
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found


def tracer_of(pid: int, tid: int) -> int:
    """Who traces one of its threads."""
    return procfs.parse_status((Path(f"/proc/{pid}/task/{tid}/status")).read_text()).tracer


def open_descriptors() -> list[str]:
    """Ours, without those that earlier tests have left in cycles: a collection would close them at any moment."""
    gc.collect()
    return sorted(os.listdir("/proc/self/fd"))


@pytest.mark.timeout(3600)
def test_captures_that_race_with_births_and_ends_lose_nothing(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("births", "-O2"), tmp_path)) as tracee:
        before = open_descriptors()
        with protected(tracee) as session:
            counts = set()
            for sequence in range(1, RACES + 1):
                snapshot = captured_at_last(session, CaptureOrder(sequence=sequence))
                session.acknowledge(snapshot.position)
                counts.add(len(snapshot.threads))
                assert len({thread.tid for thread in snapshot.threads}) == len(snapshot.threads)
            whole = transported(captured_at_last(session, CaptureOrder(base=True, sequence=RACES + 1)))
        assert open_descriptors() == before
        assert len(counts) > 1, f"only ever saw {counts} threads: nobody was born meanwhile"
        assert tracers(tracee.pid) == {"0"}
        assert "t" not in states(tracee.pid)
        tracee.tell()
        expect_ok(tracee)
    (tmp_path / "go").unlink()
    with ended(restored(whole, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_many_restores_of_a_program_that_gives_birth_to_threads(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("births", "-O2"), tmp_path)
    for _ in range(10):
        with ended(tracee):
            snapshot = captured_and_killed(tracee)
        tracee = restored(snapshot, tmp_path)
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


def test_a_thread_that_does_not_stop_is_let_go_later_and_nobody_else_waits_for_it(compiled: Compiled, tmp_path: Path) -> None:
    handler = signal.getsignal(SIGCHLD)
    with ended(start_tracee(compiled("vforks", "-O2"), tmp_path)) as tracee, protected(tracee) as session:
        session.capture(CaptureOrder(sequence=1))
        (tmp_path / "in").touch()
        tracee.wait_until(lambda: "D" in states(tracee.pid), "a thread inside the kernel")
        for sequence in (2, 3):
            with pytest.raises((CaptureError, UnsupportedError)):
                session.capture(CaptureOrder(sequence=sequence))
            assert "t" not in states(tracee.pid)
        assert "other rights" not in " ".join(ENGINE.probe(tracee.pid).reasons)  # we trace one thread still, and not the first
        late = next(tid for tid in thread_ids(tracee.pid) if tracer_of(tracee.pid, tid) == os.getpid())
        with pytest.raises(CaptureError, match="failover traces it since an earlier capture"):
            Tracee(late).seize()
        (tmp_path / "leave").touch()
        tracee.wait_for_line("came out")
        tracee.wait_until(lambda: tracers(tracee.pid) == {"0"}, "nobody to trace it")
        assert signal.getsignal(SIGCHLD) == handler
        session.capture(CaptureOrder(sequence=4))
        tracee.tell()
        expect_ok(tracee)


def test_of_a_thread_that_does_not_stop_it_is_told_whether_it_is_ready_to_run(tmp_path: Path) -> None:
    assert "the machine leaves it no processor" in str(no_stop(os.getpid(), 2.0))
    with ended(start(["/bin/sleep", "600"], tmp_path)) as program:
        program.wait_until(lambda: procfs.stat(program.pid).state == "S", "it to sleep")
        assert "it waits inside the kernel" in str(no_stop(program.pid, 2.0))


def test_a_program_killed_while_it_is_held_ends_for_its_parent(compiled: Compiled, tmp_path: Path) -> None:
    handler = signal.getsignal(SIGCHLD)
    with ended(start_tracee(compiled("threads", "-O2"), tmp_path)) as tracee:
        with protected(tracee) as session:
            session.capture(CaptureOrder(hold=True))
            assert set(states(tracee.pid)) == {"t"}
            os.kill(tracee.pid, signal.SIGKILL)
            tracee.wait_until(lambda: tracee.poll() is not None, "its end")
        assert tracee.status == -signal.SIGKILL
    assert signal.getsignal(SIGCHLD) == handler


def capture_for_ever(session: Session) -> None:
    """One after the other."""
    for sequence in itertools.count(1):
        captured_at_last(session, CaptureOrder(sequence=sequence))


def test_a_program_that_ends_while_it_is_captured_ends(compiled: Compiled, tmp_path: Path) -> None:
    for attempt in range(10):
        directory = tmp_path / str(attempt)
        directory.mkdir()
        with ended(start_tracee(compiled("births", "-O2"), directory)) as tracee:
            with protected(tracee) as session:
                tracee.tell()
                with pytest.raises(ProcessGoneError):
                    capture_for_ever(session)
            expect_ok(tracee)


def test_a_stopped_program_of_many_threads_is_still_stopped_after_a_capture(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("threads", "-O2"), tmp_path)) as tracee:
        os.kill(tracee.pid, signal.SIGSTOP)
        tracee.wait_until(lambda: set(states(tracee.pid)) == {"T"}, "all stopped")
        for _ in range(3):
            captured(tracee)
        tracee.wait_until(lambda: set(states(tracee.pid)) == {"T"}, "all stopped again")  # each of them has some way there
        deadline = time.monotonic() + 0.1
        while time.monotonic() < deadline:
            assert set(states(tracee.pid)) == {"T"}
        tracee.tell()
        os.kill(tracee.pid, signal.SIGCONT)
        expect_ok(tracee)


def test_an_unfinished_restore_that_is_given_up_leaves_nothing(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("threads", "-O2"), tmp_path)) as tracee:
        snapshot = captured_and_killed(tracee)
    born = spawn_vessel(Birth(inner_pid=snapshot.process.pid))
    ENGINE.restore(born.pid, snapshot, RestoreOptions())
    assert set(states(born.pid)) == {"t"}
    assert len(states(born.pid)) == len(snapshot.threads)
    discard(born)
    assert not Path(f"/proc/{born.pid}").exists()


def test_a_program_is_discarded_also_while_its_threads_are_traced(compiled: Compiled, tmp_path: Path) -> None:
    program = compiled("threads", "-O2")
    born = spawn_program([str(program)], os.environ, tmp_path, 0o22, Birth())
    while len(states(born.pid)) < 7:
        time.sleep(0.01)
    traced = [Tracee(tid) for tid in thread_ids(born.pid)]
    for tracee in traced:
        tracee.seize()
    for tracee in traced:
        tracee.freeze()
    discard(born)
    assert not Path(f"/proc/{born.pid}").exists()


def test_without_its_pid_a_program_of_many_threads_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("threads", "-O2"), tmp_path)) as tracee:
        snapshot = captured_and_killed(tracee)
    with pytest.raises(MismatchError, match="it has 7 threads, and pid"):
        restored(snapshot, tmp_path, keep_pid=False)


LOCKS = """
import fcntl, sys, time
file = open(sys.argv[1], "w+b")
fcntl.lockf(file, fcntl.LOCK_EX)
print("locked", flush=True)
time.sleep(600)
"""
"""In a process of its own: whoever closes a file loses its locks on it, and restores open and close files here."""


def test_threads_that_wait_at_descriptors_answer_in_turn_after_three_restores(compiled: Compiled, tmp_path: Path) -> None:
    (tmp_path / "locker").mkdir()
    with ended(start([sys.executable, "-c", LOCKS, tmp_path / "locked"], tmp_path / "locker")) as locker:
        locker.wait_for_line("locked")
        tracee = start_tracee(compiled("workers", "-O2", "-pthread"), tmp_path)
        for _ in range(3):
            with ended(tracee):
                captured(tracee)
                snapshot = captured_and_killed(tracee)
            tracee = restored(snapshot, tmp_path)
        with ended(tracee):
            captured(tracee)
            tracee.tell()
            tracee.wait_for_line("unlock")
            locker.kill()
            expect_ok(tracee)


OPENS_A_THREAD = """
import os, sys, threading, time
thread = threading.Thread(target=time.sleep, args=(600,), daemon=True)
thread.start()
os.open(f"/proc/self/task/{thread.native_id}/stat", getattr(os, sys.argv[1]))
print("ready", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("way", ["O_PATH", "O_RDONLY"])
def test_a_descriptor_that_shows_one_of_its_threads_is_refused(way: str, tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", OPENS_A_THREAD, way], tmp_path)) as program:
        program.wait_for_line("ready")
        with pytest.raises(UnsupportedError, match=r"of one of its threads: let the program close it"):
            ENGINE.protect(program.pid, ProtectOrder("/test/thread"))


QUEUES = """
import os, queue, threading, time
first, second, third = queue.Queue(8), queue.Queue(8), queue.Queue(8)
def feed():
    for number in range(5000):
        first.put(number)
        if not os.path.exists("go"):
            time.sleep(0.001)
    first.put(None)
def pipe(source, target, change):
    while (number := source.get()) is not None:
        target.put(change(number))
    target.put(None)
threads = [threading.Thread(target=feed), threading.Thread(target=pipe, args=(first, second, lambda n: n * n % 9973)),
           threading.Thread(target=pipe, args=(second, third, lambda n: n ^ 1234))]
for thread in threads:
    thread.start()
total = 0
while (number := third.get()) is not None:
    total = (total * 31 + number) % 1000003
    print(number, total, flush=True)
for thread in threads:
    thread.join()
print("end", total, flush=True)
"""


def whole_output(argv: list[str], directory: Path) -> str:
    """What a program writes undisturbed."""
    directory.mkdir()
    (directory / "go").touch()
    with ended(start(argv, directory)) as program:
        assert program.finish() == 0
    return program.output


def three_lives(argv: list[str], directory: Path, expected: str) -> Snapshot:
    """What it writes with three deaths is the same; its last snapshot.

    Without a go file it takes its time: a busy machine may not leave us a processor before it has ended.
    """
    directory.mkdir()
    program = start(argv, directory)
    size = 0
    for round_number in (1, 2, 3):
        with ended(program):
            program.wait_for_output(max(size, len(expected) * round_number // 20))
            size = (directory / "out").stat().st_size
            snapshot = captured_and_killed(program)
        program = restored(snapshot, directory)
    with ended(program):
        program.tell()
        assert program.finish() == 0, program.complaints
    assert program.output == expected
    return snapshot


def test_cpython_with_four_threads_and_queues_computes_the_same(tmp_path: Path) -> None:
    argv = [sys.executable, "-c", QUEUES]
    snapshot = three_lives(argv, tmp_path / "disturbed", whole_output(argv, tmp_path / "undisturbed"))
    assert len(snapshot.threads) == 4


POOL = """
import os, time
import numpy as np
matrix = np.random.default_rng(7).integers(0, 9, (256, 256)).astype(float)
power = np.eye(256)
for number in range(200):
    power = np.round(power @ matrix) % 9973
    print(number, int(power.sum()), flush=True)
    if not os.path.exists("go"):
        time.sleep(0.02)
"""


def test_numpy_with_its_thread_pool_computes_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4")
    argv = [sys.executable, "-c", POOL]
    snapshot = three_lives(argv, tmp_path / "disturbed", whole_output(argv, tmp_path / "undisturbed"))
    if len(snapshot.threads) == 1:
        pytest.skip("this numpy has no thread pool")


def test_threads_with_directories_and_descriptors_of_their_own_have_them_after_three_lives(
    compiled: Compiled, tmp_path: Path
) -> None:
    expect_three_lives(start_tracee(compiled("thread_tables", "-O2"), tmp_path), tmp_path)


def test_a_program_in_pids_of_its_own_keeps_its_thread_ids(compiled: Compiled, tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    tracee = start([compiled("threads", "-O2"), "go"], tmp_path, isolate=True)
    with ended(tracee):
        tracee.wait_for_line("ready")
        snapshot = captured_and_killed(tracee)
    if not snapshot.process.isolated:
        pytest.skip("this machine gives a program no PIDs of its own")
    assert snapshot.threads[0].tid == snapshot.process.pid
    assert all(thread.tid < 50 for thread in snapshot.threads), "ids as the program sees them"
    born = spawn_vessel(Birth(inner_pid=snapshot.process.pid, isolate=True, stdio=_streams(tmp_path)))
    ENGINE.restore(born.pid, snapshot, RestoreOptions()).resume()
    with ended(Program(born, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def _streams(directory: Path) -> tuple[int, int, int]:
    output = os.open(directory / "out", os.O_WRONLY | os.O_APPEND)
    return os.open("/dev/null", os.O_RDONLY), output, output
