"""Which processes belong to a component: orphans by their session and streams, not a shell's jobs, and a thousand children."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE, goes_through_three_lives
from tests.checkpoint.round_trip import (
    captured_at_last,
    ended,
    everybody_below,
    expect_ok,
    protected,
    restored,
    start,
    transported,
)

pytestmark = pytest.mark.root

STRAYS = """
if os.getsid(0) != os.getpid():
    os.setsid()

def lead():
    os.setsid()
    os.waitpid(born(leave_behind), 0)
    Path("led").touch()
    wait_for_go()

def leave_behind():
    born(live_alone)

def live_alone():
    mine = os.getpgid(0), os.getsid(0)
    Path(f"alone{os.getpid()}").touch()
    wait_for_go()
    expect("group and session of an orphan", (os.getpgid(0), os.getsid(0)), mine)
    Path(f"alone{os.getpid()}").unlink()

os.waitpid(born(leave_behind), 0)
leader = born(lead)
while len(list(Path(".").glob("alone*"))) < 2 or not Path("led").exists():
    time.sleep(0.01)
is_ready()
expect_child(leader)
while list(Path(".").glob("alone*")):
    time.sleep(0.01)
print("ok", flush=True)
"""


@pytest.mark.parametrize("crowded", [False, True], ids=["", "where stand-ins find their pids taken"])
def test_processes_that_have_lost_their_parent_are_told_by_their_session(crowded: bool, tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + STRAYS], tmp_path)
    with ended(program):
        program.wait_for_line("ready")
        strays = set(descendants.component(program.pid)) - set(everybody_below(program.pid))
        with protected(program) as session:
            snapshot = transported(captured_at_last(session, CaptureOrder(hold=True)))
            everybody = [member.process.pid for member in snapshot.members]
            assert (len(everybody), len(strays)) == (3, 2)
            for pid in everybody:
                os.kill(pid, signal.SIGKILL)
            program.kill()
        for pid in strays | set(everybody):
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)
    highest = (pid for pid in range(procfs.pid_max() - 1, 0, -1) if pid not in {program.pid, *everybody})
    there = [spawn_vessel(Birth(inner_pid=pid)) for pid in itertools.islice(highest, 2 if crowded else 0)]
    try:
        again = restored(snapshot, tmp_path)
    finally:
        for one in there:
            discard(one)
    with ended(again):
        again.tell()
        expect_ok(again)
    for pid in strays:
        os.waitpid(pid, 0)


LEFT_BEHIND = """
import ctypes
if sys.argv[1:] == ["asks"]:
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
read_end, write_end = os.pipe()

def lead():
    os.setsid()
    born(live_alone)

def live_alone():
    mine = os.getsid(0)
    while os.getppid() == mine:
        time.sleep(0.01)
    os.write(write_end, b".")
    wait_for_go()
    expect("its session", os.getsid(0), mine)
    return 21

os.waitpid(born(lead), 0)
os.read(read_end, 1)
is_ready()
if sys.argv[1:] == ["asks"]:
    expect("the end of an orphan", os.waitstatus_to_exitcode(os.waitpid(-1, 0)[1]), 21)
print("ok", flush=True)
"""
"""The leader of a session has ended, and somebody of it lives on."""


def test_an_orphan_of_a_session_that_has_lost_its_leader_is_again_its_foster_parent_s(tmp_path: Path) -> None:
    goes_through_three_lives(LEFT_BEHIND, tmp_path, "asks")


def test_an_orphan_of_a_session_that_has_lost_its_leader_is_told_by_its_standard_streams(tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", PREAMBLE + LEFT_BEHIND], tmp_path)) as program:
        program.wait_for_line("ready")
        (stray,) = set(descendants.component(program.pid)) - {program.pid}
        assert stray not in everybody_below(program.pid)
        program.tell()
        expect_ok(program)
        os.waitpid(stray, 0)


def test_the_other_half_of_a_pipeline_of_a_shell_is_nobody_s_orphan(tmp_path: Path) -> None:
    pipeline = "set -m; sleep 60 | sleep 60 & jobs -p; wait"
    program = start(["/bin/bash", "-c", pipeline], tmp_path, isolate=True)
    with ended(program):
        program.wait_until(lambda: len(everybody_below(program.pid)) == 2, "both halves")
        leader, _ = everybody_below(program.pid)
        assert os.getpgid(leader) == leader
        assert descendants.component(leader) == []


def test_what_a_shell_has_started_together_and_left_behind_are_strangers(tmp_path: Path) -> None:
    shell = subprocess.run(
        ["/bin/bash", "-c", "sleep 60 >&2 & sleep 60 >&2 & jobs -p"], stdout=subprocess.PIPE, check=True, start_new_session=True
    )
    left = [int(line) for line in shell.stdout.split()]
    try:
        assert os.getsid(left[0]) == os.getsid(left[1])
        assert [descendants.component(pid) for pid in left] == [[], []]
    finally:
        for pid in left:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def test_a_thousand_children_are_all_seen(tmp_path: Path) -> None:
    """The kernel tells some seven hundred at once."""
    births = "for _ in range(1000):\n    if not os.fork():\n        time.sleep(600)\n"
    births = f"import os, time\n{births}print('ready', flush=True)\ntime.sleep(600)"
    program = start([sys.executable, "-c", births], tmp_path, isolate=True)
    with ended(program):
        program.wait_for_line("ready")
        children = descendants.Children(program.pid)
        assert len(set(children.read([program.pid]))) == len(set(descendants.children(program.pid))) == 1000
        children.close()
