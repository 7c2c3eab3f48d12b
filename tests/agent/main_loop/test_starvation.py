"""Whether a silent process could have run, on real processes: busy, asleep, stopped, and kept from running."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from agent.main_loop import starvation
from agent.system import clock

BUSY = "while True: pass"
ASLEEP = "import time; time.sleep(1_000_000)"
PERIOD_S = 1.0


@contextmanager
def program(code: str, policy: int = os.SCHED_OTHER) -> Iterator[int]:
    """A child on the first of our processors."""
    child = subprocess.Popen([sys.executable, "-S", "-c", code])
    try:
        os.sched_setaffinity(child.pid, {min(os.sched_getaffinity(0))})
        os.sched_setscheduler(child.pid, policy, os.sched_param(0))
        yield child.pid
    finally:
        child.kill()
        child.wait()


def had_share(pid: int) -> float:
    """The part of a second that it had."""
    before, began_ns = starvation.look(pid), clock.now_ns()
    time.sleep(PERIOD_S)
    now, passed_ns = starvation.look(pid), clock.now_ns() - began_ns
    assert before is not None and now is not None
    return starvation.had_ns(before, now, passed_ns) / passed_ns


def test_a_process_that_others_keep_from_running_did_not_have_its_time() -> None:
    with program(BUSY) as first, program(BUSY) as second, program(BUSY, os.SCHED_IDLE) as kept:
        assert all(starvation.look(pid) for pid in (first, second))
        assert had_share(kept) < 0.5


def test_a_process_that_sleeps_or_is_stopped_had_its_time() -> None:
    with program(ASLEEP) as asleep, program(BUSY) as stopped:
        os.kill(stopped, signal.SIGSTOP)
        os.waitid(os.P_PID, stopped, os.WSTOPPED)
        while (seen := starvation.look(asleep)) is None or seen.is_ready:
            time.sleep(0.01)
        assert had_share(asleep) > 0.5
        assert had_share(stopped) > 0.5


def test_what_cannot_be_seen_counts_as_having_had_its_time() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert starvation.look(child.pid) is None
    assert starvation.had_ns(None, starvation.look(os.getpid()), 7) == 7
