"""The gate of a keeper: a capture of a real process that runs tasks begins between two activations."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent import slack_gate
from agent.slack_gate import SlackGate
from checkpoint.keeper.messages import Slack
from failover.boards import SCHEDULE_NAME, directory
from failover.boards.openings import held_rows, openings_of, rows_of
from failover.boards.schedule_file import ScheduleFile
from failover.core.schedule import layout

LAG_NS = 5_000_000_000
TWO_PROCESSORS = pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
STEADY = """
import sys, time, failover
with failover.scheduled(sys.argv[1], period=0.2) as task:
    for tick in task:
        begun = time.monotonic_ns()
        time.sleep(0.1)
        print(begun, time.monotonic_ns(), flush=True)
"""
REST = """
import sys, failover
with failover.scheduled(sys.argv[1], period=1000, cpus=tuple(map(int, sys.argv[2:]))):
    print(flush=True)
    sys.stdin.read()
"""
BUSY = """
import sys, failover
with failover.scheduled("busy", period=0.2) as task:
    for tick in task:
        print(flush=True)
        sys.stdin.read()
"""
IDLE = "import sys; print(flush=True); sys.stdin.read()"
POSING = """
import fcntl, os, sys
from failover.boards import directory, locks
from failover.core.schedule.layout import ROW_LOCKS
locks.take(os.open(os.environ[directory.VARIABLE] + "/schedule", os.O_RDWR), ROW_LOCKS)
print(flush=True)
sys.stdin.read()
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory with a schedule."""
    directory.make_schedule(tmp_path, "robot1", mode=0o600)
    return tmp_path


@pytest.fixture
def steady(place: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that runs a task half of the time, and says when."""
    with process(STEADY, place, "steady") as child:
        yield child


@contextmanager
def process(program: str, place: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has said its first line."""
    environment = {**os.environ, directory.VARIABLE: str(place)}
    command = [sys.executable, "-c", program, *words]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        yield child
        child.kill()


def captured(gate: SlackGate, pid: int, lag_ns: int = LAG_NS, *, stood_still: bool = True) -> Slack | None:
    gate.begin(lag_ns)
    while not gate.opens((pid,)):
        pass
    gate.closes(stood_still=stood_still)
    return gate.outcome


def test_captures_begin_between_two_activations(steady: subprocess.Popen[str]) -> None:
    gate, began = slack_gate.gate(), []
    for _ in range(20):
        found = captured(gate, steady.pid)
        assert found is not None and (found.task, found.period_ns) == ("steady", 200_000_000)
        assert not found.is_squeezed
        began.append(found.began_ns)
        time.sleep(0.03)  # so that they ask at different instants of a period
    assert steady.stdout is not None
    activations: list[tuple[int, int]] = []
    while not activations or activations[-1][0] < began[-1]:
        begun, ended = steady.stdout.readline().split()
        activations.append((int(begun), int(ended)))
    assert not [one for one in began for begun, ended in activations if begun <= one < ended]


@pytest.mark.parametrize("stood_still", [True, False])
def test_only_a_program_that_stood_still_was_delayed(place: Path, stood_still: bool) -> None:
    """One that commits its state goes on while its commit is read."""
    with process(BUSY, place) as child:
        found = captured(slack_gate.gate(), child.pid, lag_ns=1_000_000, stood_still=stood_still)
    assert found is not None and found.is_squeezed is stood_still


def test_the_wait_for_an_end_leaves_no_flag_behind(steady: subprocess.Popen[str], place: Path) -> None:
    captured(slack_gate.gate(), steady.pid)
    file = ScheduleFile.open(place / SCHEDULE_NAME)
    row = file.row_of("steady")
    assert row is not None and not layout.is_awaited(file.table, row)
    file.close()


SHORTENED = """
import os, sys
from agent import slack_gate
gate, pid = slack_gate.gate(), int(sys.argv[1])
def captured():
    gate.begin(5_000_000_000)
    while not gate.opens((pid,)):
        pass
    gate.closes(stood_still=True)
    return gate.outcome
assert captured().task == "steady"
os.truncate(sys.argv[2], int(sys.argv[3]))
gate.begin(5_000_000_000)
gate.opens((pid,))
gate.closes(stood_still=True)
captured()
print("captured")
"""


@pytest.mark.parametrize("size", [0, layout.row_at(0), layout.FILE_SIZE // 2])
def test_who_makes_the_schedule_shorter_ends_no_keeper(steady: subprocess.Popen[str], place: Path, size: int) -> None:
    """The kernel would end it by SIGBUS, if it touched the mapping."""
    command = [sys.executable, "-c", SHORTENED, str(steady.pid), str(place / SCHEDULE_NAME), str(size)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (0, "captured\n"), ran.stderr


FULL = """
import ctypes, os, sys
from agent import slack_gate
from failover.boards.unmapped_schedule import UnmappedSchedule
gate, pid, schedule = slack_gate.gate(), int(sys.argv[1]), sys.argv[2]
while not gate.opens((pid,)):
    pass
size = os.stat(schedule).st_size
os.truncate(schedule, 64)
os.truncate(schedule, size)  # the rows are a hole now
with open(os.path.dirname(schedule) + "/more", "wb", buffering=0) as more:
    try:
        while True:
            more.write(bytes(4096))
    except OSError:
        pass
gate.begin(5_000_000_000)
gate.opens((pid,))
gate.closes(stood_still=True)
gate.begin(5_000_000_000)
gate.opens((pid,))
gate.closes(stood_still=True)
print("captured")
"""


@pytest.mark.root
def test_a_full_file_system_ends_no_keeper(tmp_path: Path) -> None:
    """A page that the file has lost cannot be written any more."""
    place = tmp_path / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(place)], check=True)
    try:
        directory.make_schedule(place, "robot1", mode=0o600)
        with process(REST, place, "rests") as child:
            command = [sys.executable, "-c", FULL, str(child.pid), str(place / SCHEDULE_NAME)]
            ran = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (ran.returncode, ran.stdout) == (0, "captured\n"), ran.stderr
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def test_it_waits_no_more_for_the_end_of_an_activation_once_the_schedule_is_shorter(place: Path) -> None:
    with process(BUSY, place) as child:
        gate = slack_gate.gate()
        gate.begin(LAG_NS)
        assert not gate.opens((child.pid,)), "it runs"
        os.truncate(place / SCHEDULE_NAME, 0)
        assert gate.opens((child.pid,))


def test_a_program_without_tasks_is_captured_at_once(place: Path) -> None:
    with process(IDLE, place) as child:
        assert captured(slack_gate.gate(), child.pid) is None
    assert captured(slack_gate.gate(), 2**22 - 1) is None  # it has ended


def test_the_kernel_tells_which_rows_a_process_runs(steady: subprocess.Popen[str], place: Path) -> None:
    (opening,) = openings_of(steady.pid)
    file = ScheduleFile.open(place / SCHEDULE_NAME)
    assert opening.rows == (file.row_of("steady"),)
    assert rows_of(os.getpid(), file.identity) == set(opening.rows), "of its descendants, too"
    assert rows_of(steady.pid, (0, 0)) == set(), "of another schedule"
    file.close()
    assert held_rows("pos:\t0\nlock:\t1: OFDLCK ADVISORY  WRITE -1 00:1a:77 2199023255554 2199023255555\n") == (2, 3)
    assert held_rows("lock:\t1: OFDLCK ADVISORY  READ -1 00:1a:77 2199023255554 2199023255555\n") == ()
    assert held_rows("lock:\t1: OFDLCK ADVISORY  WRITE -1 00:1a:77 0 EOF\nlock:\t2:\n") == ()


@pytest.mark.parametrize(("cpus", "waits"), [(("0", "0"), True), pytest.param(("0", "1"), False, marks=TWO_PROCESSORS)])
def test_two_programs_of_one_processor_are_not_frozen_at_the_same_time(place: Path, cpus: tuple[str, str], waits: bool) -> None:
    with process(REST, place, "first", cpus[0]) as one, process(REST, place, "second", cpus[1]) as other:
        first, second = slack_gate.gate(), slack_gate.gate()
        first.begin(LAG_NS)
        second.begin(LAG_NS)
        assert first.opens((one.pid,))
        assert second.opens((other.pid,)) is not waits
        first.closes(stood_still=True)
        assert second.opens((other.pid,))


def test_a_schedule_that_is_none_stands_in_no_capture(tmp_path: Path) -> None:
    place = tmp_path / "other"
    place.mkdir()
    (place / SCHEDULE_NAME).write_bytes(b"x" * 100)
    with process(POSING, place) as child:
        assert openings_of(child.pid)
        assert captured(slack_gate.gate(), child.pid) is None
