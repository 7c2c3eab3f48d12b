"""Programs that are stopped, and have been sent SIGSTOP once more: it waits for ever, as SIGCONT takes it away."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from checkpoint.arch import cpu
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.engines.ptrace.capture import process
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace import entry, remote_syscalls, syscall_desk
from checkpoint.linux.trace.thread_dispatch import Round
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE, goes_through_three_lives
from tests.checkpoint.engines.ptrace.restore.test_tree_states import state_of
from tests.checkpoint.round_trip import ENGINE, Program, ended, expect_ok, protected, start

pytestmark = pytest.mark.root

PATIENCE_S = 60.0

STOPS = """
import ctypes, threading
libc = ctypes.CDLL(None, use_errno=True)

def run_several():
    threading.Thread(target=wait_for_go, daemon=True).start()
    wait_for_go()

def threads_of(pid):
    return sorted(map(int, os.listdir(f"/proc/{pid}/task")))

def states_of(pid):
    return {Path(f"/proc/{pid}/task/{tid}/stat").read_text().rpartition(")")[2].split()[0] for tid in threads_of(pid)}

def wait_until(holds):
    while not holds():
        time.sleep(0.001)

def stop_again_and_again(pid):
    os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: states_of(pid) == {"T"})
    for tid in threads_of(pid):
        expect("the second stop", libc.tgkill(pid, tid, signal.SIGSTOP), 0)
    os.kill(pid, signal.SIGSTOP)
"""

CHILDREN = """
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
def hear():
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGUSR1])
    time.sleep(3600)
def hear_by_handler():
    heard = []
    signal.signal(signal.SIGUSR1, lambda *_: heard.append(1))
    os.write(write_end, b".")
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGUSR1])
    wait_for_go()
    return len(heard) - 1
read_end, write_end = os.pipe()
several, ending, hearing = (born(act) for act in (run_several, hear, hear_by_handler))
os.read(read_end, 1)
wait_until(lambda: len(threads_of(several)) == 2)
for child in (several, ending, hearing):
    stop_again_and_again(child)
    if child != several:
        os.kill(child, signal.SIGUSR1)
is_ready()
for child in (several, ending, hearing):
    expect("what is told of the stop", os.waitpid(child, os.WUNTRACED | os.WNOHANG), (child, signal.SIGSTOP << 8 | 0x7F))
    expect("the states of a child", states_of(child), {"T"})
for child in (several, ending, hearing):
    os.kill(child, signal.SIGCONT)
expect_child(several)
expect_child(hearing)
expect("one that goes on to its end", os.waitpid(ending, 0), (ending, signal.SIGUSR1))
print("ok", flush=True)
"""


def test_children_that_were_stopped_twice_stay_stopped_and_go_on_once(tmp_path: Path) -> None:
    goes_through_three_lives(STOPS + CHILDREN, tmp_path)


@pytest.mark.parametrize("kind", ["alone", "with_child"])
def test_a_program_that_was_stopped_twice_stays_stopped(kind: str, tmp_path: Path) -> None:
    act = (
        'if sys.argv[1] == "with_child": born(wait_for_go)\nprint("ready", flush=True)\nrun_several()\nprint("ok", flush=True)\n'
    )
    program = start([sys.executable, "-c", PREAMBLE + STOPS + act, kind], tmp_path, isolate=True)
    program.wait_for_line("ready")
    program.wait_until(lambda: len(os.listdir(f"/proc/{program.pid}/task")) == 2, "its second thread")

    def is_stopped(one: Program) -> bool:
        return state_of(one) == "T"

    for _ in range(2):
        os.kill(program.pid, signal.SIGSTOP)
        program.wait_until(lambda: is_stopped(program), "that it is stopped")
    last, _ = three_lives(program, is_stopped)
    with ended(last):
        last.wait_until(lambda: is_stopped(last), "that it is stopped")
        last.tell()
        os.kill(last.pid, signal.SIGCONT)
        expect_ok(last)


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def waiting_stops(pid: int) -> int:
    """How many SIGSTOP wait, for the process and for its threads."""
    texts = [procfs.read_bytes(pid, f"task/{tid}/status") for tid in os.listdir(f"/proc/{pid}/task")]
    sets = [procfs.signal_sets(text) for text in texts]
    own = sum(of_thread >> (signal.SIGSTOP - 1) & 1 for _, of_thread, _ in sets)
    return own + (sets[0][2] >> (signal.SIGSTOP - 1) & 1)


def test_no_call_made_inside_a_stopped_program_meets_a_stop_that_waits() -> None:
    """It would stand there until the look is given up."""
    program = "import threading, time\nthreading.Thread(target=time.sleep, args=[3600]).start()\ntime.sleep(3600)"
    child = subprocess.Popen([sys.executable, "-c", program])
    try:
        wait_until(lambda: len(os.listdir(f"/proc/{child.pid}/task")) == 2)
        os.kill(child.pid, signal.SIGSTOP)
        wait_until(lambda: procfs.stat(child.pid).state == "T")
        for tid in os.listdir(f"/proc/{child.pid}/task"):
            assert ctypes.CDLL(None).tgkill(child.pid, int(tid), signal.SIGSTOP) == 0
        os.kill(child.pid, signal.SIGSTOP)
        assert waiting_stops(child.pid) == 3
        threads = Threads(Tracee(child.pid))
        threads.freeze()
        assert waiting_stops(child.pid) == 0
        assert threads.leader.stopped_by == signal.SIGSTOP
        threads.thaw()
        wait_until(lambda: procfs.stat(child.pid).state == "T")
        threads.close()
    finally:
        child.kill()
        child.wait()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_stop_that_comes_while_a_thread_makes_calls_for_us_takes_effect_and_delays_nothing(
    threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a guard whose lease ends: the program would stand there until the look is given up, and the look would fail."""
    act = "for _ in range(int(sys.argv[1]) - 1): threading.Thread(target=wait_for_go, daemon=True).start()\n"
    act += 'print("ready", flush=True)\nwait_for_go()\nprint("ok", flush=True)\n'
    start_of, stopped = Round.start, []

    def stopped_first(self: Round, tracees: Sequence[Tracee], *rest: Any) -> bool:
        stopped.append(len(tracees))
        os.kill(program.pid, signal.SIGSTOP)
        return start_of(self, tracees, *rest)

    with ended(start([sys.executable, "-c", PREAMBLE + STOPS + act, str(threads)], tmp_path)) as program:
        program.wait_for_line("ready")
        program.wait_until(lambda: len(os.listdir(f"/proc/{program.pid}/task")) == threads, "its threads")
        with protected(program) as session:
            monkeypatch.setattr(Round, "start", stopped_first)
            monkeypatch.setattr(remote_syscalls, "BATCH_TIMEOUT_S", PATIENCE_S)
            session.capture(CaptureOrder(base=True, generation=1, sequence=1))
            monkeypatch.undo()
        assert stopped
        program.wait_until(lambda: state_of(program) == "T", "that it is stopped")
        program.tell()
        os.kill(program.pid, signal.SIGCONT)
        expect_ok(program)


@pytest.mark.parametrize("is_late", [False, True])
def test_a_stop_that_comes_while_a_keeper_enters_takes_effect_and_delays_nothing(
    is_late: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does the program run where that keeper is late: it waits there for long, as any that is stopped."""
    stub_for, wait = entry._stub, entry._wait_in_call

    def stopped_first(*arguments: Any) -> tuple[int, bytes]:
        os.kill(program.pid, signal.SIGSTOP)
        return stub_for(*arguments)

    def wait_long(*arguments: Any) -> None:
        wait(*arguments)
        time.sleep(0.05 if is_late else 0)

    act = 'print("ready", flush=True)\nwait_for_go()\nprint("ok", flush=True)\n'
    with ended(start([sys.executable, "-c", PREAMBLE + act], tmp_path)) as program:
        program.wait_for_line("ready")
        with monkeypatch.context() as patched:
            patched.setattr(entry, "_stub", stopped_first)
            patched.setattr(entry, "_wait_in_call", wait_long)
            patched.setattr(entry, "BATCH_TIMEOUT_S", PATIENCE_S)
            patched.setattr(cpu, "ENTRY_TIMEOUT_NS", 1_000_000)
            patched.setattr(syscall_desk, "_busy", threading.Event())
            patched.setattr(process, "RAN_ON_MAX", 1)
            session = ENGINE.protect(program.pid, ProtectOrder("/test/stopped"))
        with contextlib.closing(session):
            program.wait_until(lambda: state_of(program) == "T", "that it is stopped")
        program.tell()
        os.kill(program.pid, signal.SIGCONT)
        expect_ok(program)
