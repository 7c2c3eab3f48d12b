"""A keeper that is killed at any instant leaves the program unharmed, and an unfinished restore leaves nothing.

``FAILOVER_KILLS`` says how often each is tried (10 unless set; 200 for a long look).
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import pytest

from checkpoint import arch
from checkpoint.arch import cpu
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.engines.ptrace.capture import process
from checkpoint.engines.ptrace.capture import session as session_module
from checkpoint.engines.ptrace.capture.frozen_process import Onlooker
from checkpoint.engines.ptrace.capture.process import RAN_ON_MAX
from checkpoint.errors import CaptureError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel, ChannelError, Reply
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.vessel import Birth, Born, spawn_vessel
from checkpoint.linux.trace import entry, remote_syscalls, syscall_desk
from checkpoint.linux.trace.syscall_desk import Desk
from checkpoint.linux.trace.thread_dispatch import Round
from checkpoint.linux.trace.tracee import Tracee
from tests.checkpoint.round_trip import (
    ENGINE,
    PATIENCE_S,
    Program,
    calls_of,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    start,
    start_tracee,
)

Wanted = TypeVar("Wanted")

LATE_S = 0.05
"""By so much a keeper is late on purpose, where a program that runs waits for less."""

KILLS = int(os.environ.get("FAILOVER_KILLS", "10"))

WORKER = """
import hashlib, sys, time
digest, heap = b"", [bytes([n % 251]) * 4096 for n in range(800)]
print("ready", flush=True)
for turn in range(1 << 30):
    heap[turn % len(heap)] = bytes([turn % 251]) * 4096
    digest = hashlib.blake2b(digest + heap[turn * 7 % len(heap)]).digest()
    if turn % 50 == 0:
        with open("turn", "w") as file:
            file.write(str(turn))
        time.sleep(0.0005)
    if turn % 1000 == 0:
        import os
        if os.path.exists("go"):
            print(turn, digest.hex(), flush=True)
            break
"""


def expected_end(turns: int) -> str:
    """What an undisturbed run prints when it is told to stop at this turn."""
    import hashlib

    digest, heap = b"", [bytes([n % 251]) * 4096 for n in range(800)]
    for turn in range(turns + 1):
        heap[turn % len(heap)] = bytes([turn % 251]) * 4096
        digest = hashlib.blake2b(digest + heap[turn * 7 % len(heap)]).digest()
    return f"{turns} {digest.hex()}"


class Keeper:
    """A keeper process, and our end of its channel."""

    def __init__(self) -> None:
        ours, theirs = messages.pair()
        with theirs:
            command = [sys.executable, "-m", "checkpoint", "keeper", str(theirs.fileno())]
            self.process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
        self.link: Channel[Reply] = Channel(ours, Reply)

    def ask(self, request: messages.Request, descriptors: tuple[int, ...] = ()) -> tuple[Reply, tuple[int, ...]]:
        self.link.send(request, descriptors)
        return self.link.receive()

    def kill_after(self, seconds: float) -> threading.Timer:
        timer = threading.Timer(seconds, self.process.kill)
        timer.start()
        return timer

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self.link.close()


@contextlib.contextmanager
def keeping() -> Iterator[Keeper]:
    keeper = Keeper()
    try:
        keeper.ask(messages.Probe(os.getpid()))  # it has imported everything now
        yield keeper
    finally:
        keeper.end()


def answer_at_last(keeper: Keeper, request: messages.Request, wanted: type[Wanted]) -> tuple[Wanted, tuple[int, ...]]:
    """What it answers that is asked again while the machine is too busy for it."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        answer, descriptors = keeper.ask(request)
        if isinstance(answer, wanted):
            return answer, descriptors
        messages.close_all(descriptors)
        assert time.monotonic() < deadline, answer


def a_keepers_life(keeper: Keeper, pid: int) -> None:
    """Protect, a base, two deltas, release: every step that touches the program."""
    keeper.ask(messages.Protect(pid, "/test/worker"))
    for sequence in (1, 2, 3):
        answer, descriptors = keeper.ask(messages.Capture(sequence == 1, 1, sequence))
        messages.close_all(descriptors)
        if isinstance(answer, messages.Captured):
            keeper.link.send(messages.Acknowledge(answer.position))
    keeper.ask(messages.Release())


def goes_on(worker: Program) -> bool:
    before = (worker.directory / "turn").read_text()
    worker.wait_until(lambda: (worker.directory / "turn").read_text() not in ("", before), "the next turn")
    return True


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Program]:
    with ended(start([sys.executable, "-c", WORKER], tmp_path)) as program:
        program.wait_for_line("ready")
        program.wait_until((tmp_path / "turn").exists, "its first turn")
        yield program


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_keeper_killed_at_any_instant_leaves_the_program_unharmed(worker: Program) -> None:
    seed = random.randrange(1 << 30)
    print(f"seed {seed}")
    dice = random.Random(seed)
    with keeping() as keeper:
        began = time.perf_counter()
        a_keepers_life(keeper, worker.pid)
        life_s = time.perf_counter() - began
    for attempt in range(KILLS):
        with keeping() as keeper:
            timer = keeper.kill_after(life_s * (attempt + dice.random()) / KILLS)
            with contextlib.suppress(ChannelError):
                a_keepers_life(keeper, worker.pid)
            timer.join()
            keeper.process.wait()
        assert goes_on(worker), f"attempt {attempt}"
        descriptors = {number for number in os.listdir(f"/proc/{worker.pid}/fd") if int(number) > 3}
        assert len(descriptors) <= 1, f"attempt {attempt}: left open {descriptors}"  # the file that it is writing
    with keeping() as keeper:
        a_keepers_life(keeper, worker.pid)  # and it can be protected again
    expect_undisturbed(worker)


def expect_undisturbed(worker: Program) -> None:
    """Tell it to end: it has computed what it computes when nobody looks."""
    worker.tell()
    assert worker.finish() == 0
    turns = int(worker.output.split()[1])
    assert worker.output.splitlines() == ["ready", expected_end(turns)]


def test_a_keeper_that_is_late_does_not_send_the_program_back_to_where_it_stood(
    worker: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its code in the program waits for it, not for ever; by now the program has run on by itself."""
    wait_in_time = remote_syscalls._tables_when_done
    tried: list[int] = []

    def wait_too_long(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
        tables = wait_in_time(memory, desks, end)
        assert goes_on(worker)
        tried.append(len(tried))
        return tables

    with protected(worker) as session:
        snapshot = captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
        session.acknowledge(snapshot.position)
        monkeypatch.setattr(remote_syscalls, "_tables_when_done", wait_too_long)
        with pytest.raises(CaptureError, match=f"pid {worker.pid} has run on while failover examined it"):
            session.capture(CaptureOrder(base=False, generation=1, sequence=2))
        assert goes_on(worker)
        assert len(tried) == RAN_ON_MAX, "it was tried again, with more patience"
        assert syscall_desk.patience_ns(Tracee(worker.pid)) == syscall_desk.BUSY_TIMEOUT_NS
        monkeypatch.undo()
        captured_at_last(session, CaptureOrder(base=False, generation=1, sequence=2))
    expect_undisturbed(worker)


@pytest.mark.parametrize("step", ["gather", "_with_contents"])
def test_what_fails_while_the_program_makes_our_calls_leaves_it_undisturbed(
    step: str, worker: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its descriptors are read meanwhile, before it is asked to stop, and while it does."""

    def fail(onlooker: Onlooker, *opened: object) -> None:
        raise CaptureError("cannot look into it")

    with protected(worker) as session:
        for sequence in range(1, 4):
            snapshot = captured_at_last(session, CaptureOrder(base=sequence == 1, generation=1, sequence=sequence))
            session.acknowledge(snapshot.position)
        monkeypatch.setattr(Onlooker, step, fail)
        with pytest.raises(CaptureError, match="cannot look into it"):
            session.capture(CaptureOrder(base=False, generation=1, sequence=4))
        assert goes_on(worker)
        monkeypatch.undo()
        captured_at_last(session, CaptureOrder(base=False, generation=1, sequence=4))
    expect_undisturbed(worker)


def test_a_keeper_that_is_late_with_its_first_entry_does_no_harm_either(worker: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_in_time = entry._wait_in_call

    def wait_too_long(*arguments: Any) -> None:
        wait_in_time(*arguments)
        assert goes_on(worker)

    monkeypatch.setattr(entry, "_wait_in_call", wait_too_long)
    with pytest.raises(CaptureError, match="has run on while failover examined it"):
        ENGINE.protect(worker.pid, ProtectOrder("/test/worker")).close()
    monkeypatch.undo()
    with protected(worker) as session:
        captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
    expect_undisturbed(worker)


@pytest.mark.parametrize("late", ["the first entry", "a batch"])
def test_a_sleep_is_not_cut_short_where_a_keeper_is_late(late: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor where it dies: the thread gives itself everything back, and the kernel remembers no sleep any more by then."""
    monkeypatch.setattr(session_module, "RAN_ON_MAX", 1)
    monkeypatch.setattr(process, "RAN_ON_MAX", 1)
    with ended(start([sys.executable, "-c", SLEEPER], tmp_path)) as program:
        program.wait_for_line("ready")
        program.wait_until(lambda: procfs.stat(program.pid).state == "S", "it to sleep")
        if late == "a batch":
            with protected(program) as session:
                monkeypatch.setattr(remote_syscalls, "_tables_when_done", too_late(remote_syscalls._tables_when_done))
                with pytest.raises(CaptureError, match="has run on while failover examined it"):
                    session.capture(CaptureOrder(base=True, generation=1, sequence=1))
        else:
            monkeypatch.setattr(entry, "_wait_in_call", too_late(entry._wait_in_call))
            with pytest.raises(CaptureError, match="has run on while failover examined it"):
                ENGINE.protect(program.pid, ProtectOrder("/test/sleeper")).close()
        assert program.finish() == 0, program.output
        assert program.output.splitlines() == ["ready", "0 True"]


SLEEPER = """
import ctypes, time
libc, seconds = ctypes.CDLL(None), 5
asked, remaining = (ctypes.c_long * 2)(seconds, 0), (ctypes.c_long * 2)()
print("ready", flush=True)
began = time.monotonic()
result = libc.nanosleep(asked, remaining)
print(result, time.monotonic() - began >= seconds, flush=True)
"""


def too_late(genuine: Callable[..., Any]) -> Callable[..., Any]:
    """The same, until whoever makes calls of ours has gone on by itself."""

    def act(*arguments: Any) -> Any:
        answer = genuine(*arguments)
        time.sleep(3 * cpu.ENTRY_TIMEOUT_NS / 1e9)
        return answer

    return act


def test_a_program_that_is_stopped_does_not_run_because_a_keeper_is_late(
    worker: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one whose lease is over: whoever has stopped it relies on that."""

    def late(genuine: Callable[..., Any]) -> Callable[..., Any]:
        def act(*arguments: Any) -> Any:
            answer = genuine(*arguments)
            time.sleep(LATE_S)
            return answer

        return act

    os.kill(worker.pid, signal.SIGSTOP)
    worker.wait_until(lambda: procfs.stat(worker.pid).state == "T", "it to be stopped")
    turn = (worker.directory / "turn").read_bytes()
    monkeypatch.setattr(cpu, "ENTRY_TIMEOUT_NS", 1_000_000)
    monkeypatch.setattr(entry, "_wait_in_call", late(entry._wait_in_call))
    monkeypatch.setattr(remote_syscalls, "_tables_when_done", late(remote_syscalls._tables_when_done))
    session = ENGINE.protect(worker.pid, ProtectOrder("/test/worker"))
    session.capture(CaptureOrder(base=True, generation=1, sequence=1))
    session.close()
    monkeypatch.undo()
    worker.wait_until(lambda: procfs.stat(worker.pid).state == "T", "it to be stopped as it was")
    assert (worker.directory / "turn").read_bytes() == turn
    os.kill(worker.pid, signal.SIGCONT)
    expect_undisturbed(worker)


def test_a_program_that_is_stopped_while_it_makes_calls_for_a_keeper_does_not_run_either(
    worker: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, wait_in_time = Round.start, remote_syscalls._tables_when_done

    def stopped_first(self: Round, *rest: Any) -> bool:
        os.kill(worker.pid, signal.SIGSTOP)
        return start(self, *rest)

    def wait_too_long(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
        tables = wait_in_time(memory, desks, end)
        time.sleep(LATE_S)
        return tables

    with protected(worker) as session:
        with monkeypatch.context() as patched:
            patched.setattr(cpu, "ENTRY_TIMEOUT_NS", 1_000_000)
            patched.setattr(syscall_desk, "_busy", threading.Event())
            patched.setattr(session_module, "RAN_ON_MAX", 1)
            patched.setattr(process, "RAN_ON_MAX", 1)
            patched.setattr(Round, "start", stopped_first)
            patched.setattr(remote_syscalls, "_tables_when_done", wait_too_long)
            session.capture(CaptureOrder(base=True, generation=1, sequence=1))  # refused where it has run on
        worker.wait_until(lambda: procfs.stat(worker.pid).state == "T", "it to be stopped")
    os.kill(worker.pid, signal.SIGCONT)
    expect_undisturbed(worker)


def test_a_program_that_is_stopped_stays_so_when_its_keeper_dies_until_it_is_continued(
    worker: Program,
) -> None:
    """It stands in the code of its keeper, in a wait that was to be long."""
    os.kill(worker.pid, signal.SIGSTOP)
    worker.wait_until(lambda: procfs.stat(worker.pid).state == "T", "it to be stopped")
    keeper = os.fork()
    if not keeper:
        entry._wait_in_call = functools.partial(_wait_and_die, entry._wait_in_call)
        with contextlib.suppress(BaseException):
            ENGINE.protect(worker.pid, ProtectOrder("/test/worker"))
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(keeper, 0)[1]) == -signal.SIGKILL
    worker.wait_until(lambda: procfs.stat(worker.pid).state == "T", "it to be stopped as it was")
    os.kill(worker.pid, signal.SIGCONT)
    assert goes_on(worker)
    with protected(worker) as session:
        captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
    expect_undisturbed(worker)


def _wait_and_die(wait: Callable[..., None], *arguments: Any) -> None:
    wait(*arguments)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.compiler
def test_a_keeper_that_is_late_sends_none_of_many_threads_back(
    compiled: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_in_time, waiting = remote_syscalls._tables_when_done, str(cpu.SYSCALLS["rt_sigtimedwait"])

    def wait_too_long(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
        tables = wait_in_time(memory, desks, end)
        if len(desks) > 1:
            tracee.wait_until(lambda: waiting not in calls_of(memory.pid), "all to go on by themselves")
        return tables

    with ended(start_tracee(compiled("threads", "-O2"), tmp_path, "many")) as tracee:
        with protected(tracee) as session:
            monkeypatch.setattr(remote_syscalls, "_tables_when_done", wait_too_long)
            with pytest.raises(CaptureError, match=r"has run on while failover examined it|leaves it no processor"):
                session.capture(CaptureOrder(base=True, generation=1, sequence=1))
            monkeypatch.undo()
            captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.compiler
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_keeper_killed_at_any_instant_leaves_no_thread_stopped(compiled: Callable[..., Path], tmp_path: Path) -> None:
    dice = random.Random(12)
    with ended(start_tracee(compiled("threads", "-O2"), tmp_path, "many")) as tracee:
        with keeping() as keeper:
            began = time.perf_counter()
            a_keepers_life(keeper, tracee.pid)
            life_s = time.perf_counter() - began
        for attempt in range(KILLS):
            with keeping() as keeper:
                timer = keeper.kill_after(life_s * (attempt + dice.random()) / KILLS)
                with contextlib.suppress(ChannelError):
                    a_keepers_life(keeper, tracee.pid)
                timer.join()
                keeper.process.wait()
            for task in Path(f"/proc/{tracee.pid}/task").iterdir():
                assert "\nTracerPid:\t0\n" in (task / "status").read_text(), f"attempt {attempt}"
        tracee.tell()
        expect_ok(tracee)


HOLDER = f"""
import ctypes, os, sys, time
number = ctypes.CDLL(None).syscall({arch.number_of("userfaultfd")}, os.O_CLOEXEC | os.O_NONBLOCK | 1)
print(number, flush=True)
print("ready", flush=True)
while True:
    time.sleep(0.01)
"""


def test_a_userfaultfd_that_a_keeper_could_not_close_is_closed_by_the_next_one(tmp_path: Path) -> None:
    """It gives up after a second where the program is frozen by its cgroup between two calls."""
    with ended(start([sys.executable, "-c", HOLDER], tmp_path)) as program, keeping() as keeper:
        program.wait_for_line("ready")
        number = int(program.output.split()[0])
        if number < 0:
            pytest.skip("this system gives nobody a userfaultfd")
        answer_at_last(keeper, messages.Protect(program.pid, "/test/holder"), messages.Protected)
        assert str(number) not in os.listdir(f"/proc/{program.pid}/fd")
        _, descriptors = answer_at_last(keeper, messages.Capture(True, 1, 1), messages.Captured)
        messages.close_all(descriptors)


def mappings_of(pid: int) -> list[str]:
    """Lines of its maps; none of a dead one."""
    return Path(f"/proc/{pid}/maps").read_text().splitlines()


def vessel_gone(born: Born) -> bool:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        pid, status = os.waitpid(born.pid, os.WNOHANG)
        if pid:
            return os.WIFSIGNALED(status)
        time.sleep(0.002)
    return False


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_keeper_killed_in_the_middle_of_a_restore_leaves_nothing(worker: Program, tmp_path: Path) -> None:
    with keeping() as keeper:
        answer_at_last(keeper, messages.Protect(worker.pid, "/test/worker"), messages.Protected)
        _, (snapshot,) = answer_at_last(keeper, messages.Capture(True, 1, 1, hold=True), messages.Captured)
        worker.kill()
    null = os.open("/dev/null", os.O_RDWR)
    birth = Birth(stdio=(null, null, null))
    with keeping() as keeper:
        born = spawn_vessel(birth)
        began = time.perf_counter()
        answer, _ = keeper.ask(messages.Restore(born.pid, "/test/worker"), (snapshot,))
        assert isinstance(answer, messages.Restored), answer
        restore_s = time.perf_counter() - began
    assert vessel_gone(born), "a restore that was not resumed dies with its keeper"
    dice = random.Random(11)
    fresh = spawn_vessel(birth)
    untouched = len(mappings_of(fresh.pid))
    os.kill(fresh.pid, 9)
    assert vessel_gone(fresh)
    for attempt in range(KILLS):
        with keeping() as keeper:
            born = spawn_vessel(birth)
            timer = keeper.kill_after(restore_s * (attempt + dice.random()) / KILLS)
            with contextlib.suppress(ChannelError):
                keeper.ask(messages.Restore(born.pid, "/test/worker"), (snapshot,))
            timer.join()
            keeper.process.wait()
        deadline = time.monotonic() + PATIENCE_S  # the kernel ends it when its tracer has gone, which takes it a moment
        while len(mappings_of(born.pid)) > untouched:
            assert time.monotonic() < deadline, f"attempt {attempt}: a half restored program is still there"
            time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            os.kill(born.pid, 9)  # one that had not been seized yet still waits for us, its parent
        assert vessel_gone(born), f"attempt {attempt}"
    os.close(snapshot)
    os.close(null)
