"""A program that keeps its state lives on when its first thread has ended; it has ended once all of its threads have."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Session, Terms
from checkpoint.engines.cooperative.engine import CooperativeEngine
from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.model import Snapshot
from failover.cli.verbs import one_shot

BOUND_S = 60.0
ROOT = Path(__file__).parents[4]
PROGRAM = """\
import ctypes, platform, sys, threading
from checkpoint.segment.writer import SegmentWriter
from tests.checkpoint.segments import Telling, layout

state, writer = Telling(), SegmentWriter(layout())
leaves = threading.Event()


def work():
    for line in sys.stdin:
        if line == "leave\\n":
            leaves.set()
        else:
            assert writer.commit(state.sources(writer.number + 1))
            print(writer.number, flush=True)


threading.Thread(target=work).start()
leaves.wait()
ctypes.CDLL(None).syscall({"x86_64": 60, "aarch64": 93}[platform.machine()], 0)  # exit(2): of this thread alone
"""
"""Commits whenever it is told to; its first thread ends when that is told it."""


@dataclass(frozen=True)
class Program:
    """One that runs."""

    process: subprocess.Popen[str]
    file: Path

    @property
    def pid(self) -> int:
        """Its own."""
        return self.process.pid

    def commit(self) -> int:
        """Have it commit; the number of that."""
        print("commit", file=self.process.stdin, flush=True)
        assert self.process.stdout is not None
        return int(self.process.stdout.readline())

    def lose_first_thread(self) -> None:
        """Have that end."""
        print("leave", file=self.process.stdin, flush=True)
        wait_for(lambda: procfs.status(self.pid).state == "Z")
        assert procfs.status(self.pid).threads > 1


def wait_for(condition: Callable[[], bool]) -> None:
    """Look until it holds."""
    deadline = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    command = [sys.executable, "-u", str(file)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))}
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env=environment) as process:
        try:
            yield Program(process, file)
        finally:
            process.kill()


def captured(session: Session, number: int, *, base: bool = False) -> Snapshot:
    """A snapshot, acknowledged."""
    snapshot = session.capture(CaptureOrder(base=base, sequence=number))
    session.acknowledge(snapshot.position)
    return snapshot


def commit_in(snapshot: Snapshot) -> int:
    """Which commit a snapshot is of."""
    (task,) = (held for held in snapshot.resources if held.kind == "task")
    commit = task.facts["commit"]
    assert isinstance(commit, int)
    return commit


@pytest.mark.parametrize("carries", [False, True], ids=["alone", "with a file that travels"])
def test_a_program_whose_first_thread_has_ended_is_captured_as_before(program: Program, tmp_path: Path, carries: bool) -> None:
    log = tmp_path / "log"
    log.write_text("one\n")
    terms = Terms(Carry((str(log),) if carries else ()))
    engine = CooperativeEngine()
    assert program.commit() == 1
    early = engine.protect(program.pid, ProtectOrder("/lab/r1/early", terms=terms))
    before = captured(early, 1, base=True)
    program.lose_first_thread()
    late = engine.protect(program.pid, ProtectOrder("/lab/r1/late", terms=terms))
    assert str(program.file) in engine.probe(program.pid).command
    try:
        assert early.unchanged(0) == before.position
        assert program.commit() == 2
        delta, whole = captured(early, 2), captured(late, 1, base=True)
        assert (delta.parent, commit_in(delta), commit_in(whole)) == (before.position, 2, 2)
        assert whole.process.arguments == before.process.arguments
        assert whole.process.pid == before.process.pid == program.pid
        told = {held.kind: held.facts for held in before.resources if held.kind == "program"}
        assert told and told == {held.kind: held.facts for held in whole.resources if held.kind == "program"}
        os.close(late.open_file(str(program.file), b""))
        program.process.kill()
        wait_for(lambda: procfs.status(program.pid).has_ended)
        with pytest.raises(ProcessGoneError, match="has ended"):
            early.capture(CaptureOrder(base=False, sequence=3))
    finally:
        early.close()
        late.close()


def test_a_process_whose_first_thread_has_ended_is_not_taken_for_one_that_is_about_to_go(program: Program) -> None:
    """Its id will not be free soon: a restore that needs it is not held up."""
    program.lose_first_thread()
    assert not one_shot._is_ending(program.pid)
    program.process.kill()
    wait_for(lambda: one_shot._is_ending(program.pid))
