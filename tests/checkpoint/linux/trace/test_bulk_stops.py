"""Many threads seized, stopped, waited for and let go in one batch; a thread that behaves unlike most is handled singly."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.arch import stubs
from checkpoint.linux import batch_syscalls
from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.trace.bulk_stops import LOST, NOTHING, STEP, Together
from checkpoint.linux.trace.thread_dispatch import Round
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import PLAIN_STOP, Tracee
from tests.checkpoint.linux.trace.test_threads import states, tracers
from tests.checkpoint.round_trip import Program, ended, start

pytestmark = pytest.mark.root

COUNT = STEP + 1
"""Threads of the program: more than a table has room for at first."""
NOBODY = 0x3FFFFFFF
"""More than any thread's id."""
SLEEPS = f"""
import os, signal, threading, time
here, there = os.pipe()
os.set_blocking(there, False)
signal.set_wakeup_fd(there)
signal.signal(signal.SIGUSR1, lambda *_: None)
for _ in range({COUNT - 1}):
    threading.Thread(target=time.sleep, args=[3600], daemon=True).start()
print("ready", flush=True)
while os.read(here, 1):
    print("heard", flush=True)
"""


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    with ended(start([sys.executable, "-c", SLEEPS], tmp_path)) as started:
        started.wait_for_line("ready")
        yield started


def all_reports(together: Together, tids: list[int], program: Program) -> dict[int, int]:
    """The wait status of each, as it comes."""
    found: dict[int, int] = {}

    def hear() -> bool:
        for tid, report in zip(tids, together.reports(tids), strict=True):
            if report.status is not None:
                found[tid] = report.status
        return len(found) == len(tids)

    program.wait_until(hear, "the stop of every thread")
    return found


def test_all_threads_are_seized_stopped_and_let_go(program: Program) -> None:
    tids, together = thread_ids(program.pid), Together()
    assert together.seize([*tids, NOBODY, os.getpid()]) == [True] * COUNT + [False, False]
    assert together.reports([*tids, NOBODY]) == [NOTHING] * COUNT + [LOST]
    assert together.let_go(tids) == [False] * COUNT, "nobody stands yet"
    assert together.ask_to_stop([*tids, NOBODY]) == [True] * COUNT + [False]
    assert set(all_reports(together, tids, program).values()) == {PLAIN_STOP}
    assert set(states(program.pid)) == {"t"}
    assert together.let_go([*tids, NOBODY]) == [True] * COUNT + [False]
    assert tracers(program.pid) == {"0"}


@pytest.fixture
def stopped(program: Program) -> Iterator[list[int]]:
    """The threads of one that is stopped by SIGSTOP; they are seized."""
    os.kill(program.pid, signal.SIGSTOP)
    program.wait_until(lambda: set(states(program.pid)) == {"T"}, "that it is stopped")
    tids, together = thread_ids(program.pid), Together()
    assert all(together.seize(tids))
    yield tids
    assert all(together.let_go(tids))


def test_who_stands_already_is_not_asked_to_stop_once_more(stopped: list[int]) -> None:
    """He would stop a second time, as soon as he is to run for us."""
    assert Together().ask_to_stop(stopped) == [False] * COUNT


def test_nobody_at_a_desk_is_asked_to_stop_when_one_stands_already(stopped: list[int]) -> None:
    round_of_all = Round(COUNT)
    round_of_all._address(stopped)
    assert round_of_all.ask_to_stop() is None


@pytest.mark.parametrize("is_seen", [True, False], ids=["seen", "unseen"])
def test_a_signal_that_comes_before_the_stop_is_delivered(
    is_seen: bool, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = Together.ask_to_stop

    def ask_after_a_signal(self: Together, tids: list[int]) -> list[bool]:
        assert ctypes.CDLL(None).tgkill(program.pid, tids[-1], signal.SIGUSR1) == 0
        program.wait_until(lambda: "t" in states(program.pid), "a thread that stands for a signal")
        return ask(self, tids) if is_seen else [Tracee(tid).interrupt() is None for tid in tids]

    monkeypatch.setattr(Together, "ask_to_stop", ask_after_a_signal)
    threads = Threads(Tracee(program.pid))
    threads.freeze()
    assert set(states(program.pid)) == {"t"}
    threads.thaw()
    threads.close()
    program.wait_for_line("heard")


@pytest.mark.timeout(60)
@pytest.mark.parametrize("way", [batch_syscalls._in_machine_code_that_may_wait, lambda: batch_syscalls.one_by_one_that_may_wait])
def test_other_threads_of_ours_go_on_while_a_call_waits(
    way: Callable[[], batch_syscalls.Loop], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seizing may wait for what one of them does (`checkpoint.linux.child_reaper`)."""
    loop = way()
    monkeypatch.setattr(batch_syscalls, "_patient_loop", lambda: loop)
    here, there = os.pipe()
    us, number = threading.get_native_id(), str(stubs.SYSTEM_CALLS["read"])

    def write_when_we_wait() -> None:
        while Path(f"/proc/self/task/{us}/syscall").read_text().split()[:2] != [number, hex(here)]:
            os.sched_yield()
        os.write(there, b".")

    read = bytearray(1)
    table = OwnCalls([row("read", here, ctypes.addressof((ctypes.c_char * 1).from_buffer(read)), 1)])
    helper = threading.Thread(target=write_when_we_wait)
    helper.start()
    table.run(may_wait=True)
    helper.join()
    assert read == b"."
    os.close(here)
    os.close(there)
