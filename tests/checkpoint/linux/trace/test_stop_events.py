"""A process that waits for a thread to stop sleeps where that thread needs the processor, and is woken by its stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.linux.procfs.cpu_of_thread import Whereabouts
from checkpoint.linux.trace.stop_events import Reports, sleep_until_report
from tests.checkpoint.round_trip import PATIENCE_S, ended, start

LONG_S = 600.0


@pytest.fixture
def reports() -> Iterator[Reports]:
    ours = Reports()
    yield ours
    ours.give_back()


def _is_kept() -> bool:
    return signal.SIGCHLD in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_a_report_that_came_before_the_sleep_ends_it(reports: Reports) -> None:
    reports.keep()
    signal.raise_signal(signal.SIGCHLD)
    sleep_until_report(LONG_S)
    assert signal.SIGCHLD not in signal.sigpending()


STOPS = """
import os, sys
from checkpoint.linux.trace.stop_events import Reports, sleep_until_report
from checkpoint.linux.trace.tracee import Tracee
tracee, reports = Tracee(int(sys.argv[1])), Reports()
assert len(os.listdir("/proc/self/task")) == 1
reports.keep()
tracee.seize()
tracee.interrupt()
sleep_until_report(600)
while not tracee.has_stopped():
    sleep_until_report(600)
tracee.detach()
"""


def test_a_stop_for_us_ends_the_sleep(tmp_path: Path) -> None:
    """In a process of one thread: of more another may take a report that comes before the sleep, which is a short one then."""
    alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with ended(start(["sleep", "600"], tmp_path)) as program:
        subprocess.run([sys.executable, "-c", STOPS, str(program.pid)], check=True, timeout=PATIENCE_S, env=alone)


def test_without_one_it_sleeps_for_so_long(reports: Reports) -> None:
    reports.keep()
    sleep_until_report(0.001)
    reports.give_back()
    sleep_until_report(0.001)


def test_who_has_a_handler_hears_of_what_ended_our_sleep(reports: Reports) -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGCHLD, lambda number, _: heard.append(number))
    try:
        reports.keep()
        signal.raise_signal(signal.SIGCHLD)
        sleep_until_report(LONG_S)
        assert not heard
        reports.give_back()
        assert heard == [signal.SIGCHLD]
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_what_was_blocked_before_stays_so(reports: Reports) -> None:
    assert not _is_kept()
    reports.give_back()
    assert not _is_kept()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGCHLD,))
    try:
        reports.keep()
        reports.give_back()
        assert _is_kept()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    reports.keep()
    reports.keep()
    assert _is_kept()
    reports.give_back()
    assert not _is_kept()


def test_whether_a_thread_is_on_our_processor_is_known_once_that_was_prepared(tmp_path: Path) -> None:
    before = os.sched_getaffinity(0)
    first, *others = sorted(before)
    waits = [sys.executable, "-c", "import time; print('ready', flush=True); time.sleep(600)"]
    try:
        os.sched_setaffinity(0, {first})
        with ended(start(waits, tmp_path)) as program:
            program.wait_for_line("ready")
            whereabouts = Whereabouts(program.pid)
            assert not whereabouts.are_ours()
            whereabouts.prepare()
            assert whereabouts.are_ours()
            for other in others[:1]:
                os.sched_setaffinity(0, {other})
                assert not whereabouts.are_ours()
            whereabouts.close()
            assert not whereabouts.are_ours()
            whereabouts.prepare()
        assert not whereabouts.are_ours()
    finally:
        os.sched_setaffinity(0, before)


def test_of_who_has_ended_nothing_is_known() -> None:
    ours = Whereabouts((1 << 22) - 1)
    ours.prepare()
    assert not ours.are_ours()
    ours.close()
