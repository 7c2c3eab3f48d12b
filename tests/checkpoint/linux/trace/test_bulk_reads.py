"""Facts that the kernel reported of threads while they stood still can be read when they run again."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.trace.bulk_reads import NO_FILE, Readings, Unread
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from tests.checkpoint.round_trip import ended, start

pytestmark = pytest.mark.root

SLEEPS = """
import threading, time
for _ in range(3):
    threading.Thread(target=time.sleep, args=[3600], daemon=True).start()
print("ready", flush=True)
time.sleep(3600)
"""


@pytest.fixture
def threads(tmp_path: Path) -> Iterator[Threads]:
    with ended(start([sys.executable, "-c", SLEEPS], tmp_path)) as program:
        program.wait_for_line("ready")
        found = Threads(Tracee(program.pid))
        try:
            yield found
        finally:
            found.close()


def told(readings: Readings, threads: Threads) -> list[Unread]:
    """Of all of them, who stand still only for this."""
    threads.freeze()
    try:
        tracees = [threads.leader, *threads.others]
        return readings.read(tracees, [NO_FILE] * len(tracees))
    finally:
        threads.thaw()


def test_what_was_told_stays_as_it_was_when_they_are_asked_again(threads: Threads) -> None:
    readings = Readings()
    before = told(readings, threads)
    every = tuple(sorted(os.sched_getaffinity(threads.pid)))
    one = every[:1]
    for tid in thread_ids(threads.pid):
        os.sched_setaffinity(tid, one)
    after = told(readings, threads)
    assert [unread.reading.affinity for unread in before] == [every] * 4
    assert [unread.reading.affinity for unread in after] == [one] * 4
    assert len({unread.reading.registers for unread in before}) == 4


def test_nothing_grows_where_nobody_wants_it_any_more(threads: Threads) -> None:
    readings = Readings()
    told(readings, threads)
    area = readings._area
    kept = [unread.reading for unread in told(readings, threads)]
    assert readings._area is area
    told(readings, threads)
    assert readings._area is area
    assert len(kept) == 4


def test_priority_and_nice_value_are_as_the_kernel_tells_them_elsewhere(threads: Threads) -> None:
    """One in real time, one that is nice, one that is the contrary."""
    _, in_real_time, nice, urgent = thread_ids(threads.pid)
    os.setpriority(os.PRIO_PROCESS, nice, 19)
    os.setpriority(os.PRIO_PROCESS, urgent, -20)
    os.setpriority(os.PRIO_PROCESS, in_real_time, 3)
    os.sched_setscheduler(in_real_time, os.SCHED_RR, os.sched_param(7))
    found = [unread.reading for unread in told(Readings(), threads)]
    assert [(reading.priority, reading.nice) for reading in found] == [(0, 0), (7, 3), (0, 19), (0, -20)]
    stats = [procfs.thread_stat(threads.pid, tid) for tid in thread_ids(threads.pid)]
    assert [(stat.priority, stat.nice) for stat in stats] == [(0, 0), (7, 3), (0, 19), (0, -20)]
