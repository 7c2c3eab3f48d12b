"""Programs of several processes: all are captured together, and come back with the same relations to each other."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from checkpoint.engine import CaptureOrder, RestoreOptions
from checkpoint.engines.ptrace.capture import enter
from checkpoint.engines.ptrace.capture.process import CapturedProcess, Look
from checkpoint.engines.ptrace.capture.tree import SeenOthers
from checkpoint.engines.ptrace.facts.probe import probe
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.vessel import Birth, spawn_vessel
from checkpoint.linux.trace.entry import Entered
from checkpoint.model import ProcessState, Resource, Snapshot
from checkpoint.resources.events import pidfd
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.snapshot import process_tree
from tests.checkpoint.linux.trace.test_threads import open_descriptors
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    captured,
    captured_at_last,
    ended,
    everybody_below,
    expect_ok,
    protected,
    restored,
    start,
    start_tracee,
    transported,
)

pytestmark = pytest.mark.root


FAMILY = Path(__file__).parents[4] / "tracees" / "family.py"
LIVES = 3
CAPTURES = int(os.environ.get("FAILOVER_TEST_TREE_RACES", "50"))
"""Captures that race with births and ends of processes; a thousand take some minutes."""


def captured_and_ended(program: Program) -> Snapshot:
    """One base, then the end of all of its processes."""
    with protected(program) as session:
        snapshot = captured_at_last(session, CaptureOrder(hold=True))
        program.kill()
    return transported(snapshot)


def three_lives(program: Program, is_ready: Callable[[Program], bool]) -> tuple[Program, list[Snapshot]]:
    """Bring a program back three times, each time that it is ready."""
    taken = []
    for _ in range(LIVES):
        with ended(program):
            program.wait_until(lambda: is_ready(program), "that it is ready to be captured")  # noqa: B023
            taken.append(captured_and_ended(program))
        program = restored(taken[-1], program.directory)
    return program, taken


def grown_by(count: int) -> Callable[[Program], bool]:
    """Whether a program has written so many lines more than when this was asked last."""
    seen = [0]

    def is_ready(program: Program) -> bool:
        lines = program.output.count("\n")
        if lines < seen[0] + count:
            return False
        seen[0] = lines
        return True

    return is_ready


HAS_A_FANOTIFY_FOR_A_WHILE = """
import ctypes, os, time
def wait_for(name):
    while not os.path.exists(name):
        time.sleep(0.01)
child = os.fork()
if not child:
    wait_for("open")
    group = ctypes.CDLL(None).fanotify_init(0, 0)
    open("opened", "w").close()
    wait_for("close")
    os.close(group)
    open("closed", "w").close()
    time.sleep(600)
print("ready", flush=True)
os.wait()
"""


def test_a_family_that_was_refused_once_is_captured_again(tmp_path: Path) -> None:
    def make(name: str, then: str) -> None:
        (tmp_path / name).touch()
        family.wait_until((tmp_path / then).exists, f"it has {then} it")

    family = start([sys.executable, "-c", HAS_A_FANOTIFY_FOR_A_WHILE], tmp_path, isolate=True)
    with ended(family), protected(family) as session:
        family.wait_for_line("ready")
        captured_at_last(session, CaptureOrder())
        report = probe(family.pid)
        assert not report.reasons
        assert [found.text for found in report.findings if found.name == "written pages"] == [
            "failover follows them already: the program is protected"
        ]
        make("open", "opened")
        for _ in range(2):
            with pytest.raises(UnsupportedError, match="fanotify") as refused:
                session.capture(CaptureOrder(base=False, sequence=2))
            assert len(refused.value.reasons) == 1
        make("close", "closed")
        assert session.capture(CaptureOrder(base=False, sequence=2)).position.sequence == 2


def test_a_shell_loop_with_pipelines_counts_on(tmp_path: Path) -> None:
    loop = "i=0; until [ -e go ]; do i=$((i+1)); echo $i; sleep 0.05 | cat; done"
    program, _ = three_lives(start(["/bin/sh", "-c", loop], tmp_path, isolate=True), grown_by(4))
    with ended(program):
        before = program.output.count("\n")
        program.wait_until(lambda: program.output.count("\n") > before + 4, "that it goes on")
        program.tell()
        assert program.finish() == 0
        assert program.output == "".join(f"{i + 1}\n" for i in range(program.output.count("\n")))


def test_a_family_comes_back_in_its_session_from_a_vessel_that_leads_none(tmp_path: Path) -> None:
    program = start(["/bin/sh", "-c", "sleep 600 & echo ready; wait"], tmp_path)
    program.wait_for_line("ready")
    for _ in range(2):
        snapshot = captured(program)
        (child,) = everybody_below(program.pid)
        program.kill()
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)  # it has come to us
        assert [(one.process.sid, one.process.pgid) for one in snapshot.processes] == [(program.pid, program.pid)] * 2
        born = spawn_vessel(Birth(inner_pid=program.pid, own_session=False))  # as `failover restore --wait` has it
        ENGINE.restore(born.pid, snapshot, RestoreOptions()).resume()
        program = Program(born, tmp_path)
    program.kill()
    os.kill(child, signal.SIGKILL)


def processor_time(pid: int) -> int:
    """In ticks, of a process and its descendants."""
    total = 0
    for one in (pid, *everybody_below(pid)):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            words = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
            total += int(words[11]) + int(words[12])
    return total


def test_a_pipeline_of_the_shell_computes_the_same(tmp_path: Path) -> None:
    pipeline = "seq 6000000 | sort | sha256sum"
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    undisturbed.mkdir()
    disturbed.mkdir()
    with ended(start(["/bin/sh", "-c", pipeline], undisturbed, isolate=True)) as alone:
        assert alone.finish() == 0

    def has_worked(program: Program) -> bool:
        return processor_time(program.pid) > 10 and len(everybody_below(program.pid)) >= 2

    program, taken = three_lives(start(["/bin/sh", "-c", pipeline], disturbed, isolate=True), has_worked)
    with ended(program):
        assert (program.finish(), program.output) == (0, alone.output)
    assert any(held.kind == "pipes" for held in taken[0].members[0].resources)


def test_a_family_of_processes_finds_itself_as_it_was(tmp_path: Path) -> None:
    program = start([sys.executable, FAMILY, "go"], tmp_path, isolate=True)
    program, taken = three_lives(program, grown_by(10))
    with ended(program):
        goes_on = grown_by(program.output.count("\n") + 10)
        program.wait_until(lambda: goes_on(program), "that it goes on")
        program.tell()
        assert (program.finish(), program.output.splitlines()[-1]) == (0, "ok"), program.output[-500:] + program.complaints
    assert [zombie.status for zombie in taken[-1].zombies] == [3 << 8, signal.SIGTERM]
    assert len(taken[-1].members) == 4
    alone = sum(run.size for run in process_tree.views(taken[0])[0].runs)
    assert len(taken[0].contents) < 2 * alone, "what five processes have in common is there once"


@pytest.mark.compiler
@pytest.mark.parametrize(("program", "case"), [("kin_descriptors", ""), ("aio", "aio_waiting")])
def test_what_a_process_has_of_another_by_descriptor_is_as_it_was_after_three_lives(
    program: str, case: str, compiled: Callable[..., Path], tmp_path: Path
) -> None:
    tracee, _ = three_lives(start_tracee(compiled(program, "-O2"), tmp_path, case, isolate=True), lambda _: True)
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.compiler
def test_pages_of_a_file_that_a_fork_left_in_common_are_there_once(compiled: Callable[..., Path], tmp_path: Path) -> None:
    tracee, _ = three_lives(start_tracee(compiled("forked_files", "-O2"), tmp_path, isolate=True), lambda _: True)
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.compiler
@pytest.mark.parametrize("kind", ["files", "directories"])
def test_what_a_process_shares_with_its_parent_is_shared_after_three_lives(
    kind: str, compiled: Callable[..., Path], tmp_path: Path
) -> None:
    tracee = start_tracee(compiled("relatives", "-O2"), tmp_path, kind, isolate=True)
    tracee, _ = three_lives(tracee, lambda _: True)
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.compiler
@pytest.mark.parametrize("kind", ["child", "child_of_thread", "zombie_child"])
def test_a_child_is_still_there_after_three_lives(kind: str, compiled: Callable[..., Path], tmp_path: Path) -> None:
    tracee = start_tracee(compiled("refused", "-O2"), tmp_path, kind, isolate=True)
    tracee, taken = three_lives(tracee, lambda _: True)
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)
    assert len(taken[-1].members) + len(taken[-1].zombies) == 1


def tracers(pids: Iterable[int]) -> Iterator[int]:
    """Who traces each of them that lives still: 0 is nobody."""
    for pid in pids:
        with contextlib.suppress(ProcessGoneError, ProbeError):
            yield procfs.status(pid).tracer


@pytest.mark.timeout(3600)
def test_captures_that_race_with_births_and_ends_of_processes_lose_nothing(tmp_path: Path) -> None:
    loop = "i=0; while :; do i=$((i+1)); (:); /bin/true; echo $i | cat >> lines & wait; done"
    program = start(["/bin/sh", "-c", loop], tmp_path, isolate=True)
    before = open_descriptors()
    with ended(program):
        with protected(program) as session:
            for sequence in range(1, CAPTURES + 1):
                snapshot = captured_at_last(session, CaptureOrder(base=sequence % 10 == 1, sequence=sequence))
                if sequence % 2:
                    session.acknowledge(snapshot.position)
        now = {n: os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd") if os.path.lexists(f"/proc/self/fd/{n}")}
        assert open_descriptors() == before, {n: w for n, w in now.items() if n not in before}
        assert not any(tracers((program.pid, *everybody_below(program.pid))))
        size = (tmp_path / "lines").stat().st_size
        program.wait_until(lambda: (tmp_path / "lines").stat().st_size > size + 20, "that it goes on")
        last = captured_and_ended(program)
    lines = (tmp_path / "lines").read_text()
    program = restored(last, tmp_path)
    with ended(program):
        program.wait_until(lambda: (tmp_path / "lines").stat().st_size > len(lines) + 20, "that it goes on")
    numbers = [int(line) for line in (tmp_path / "lines").read_text().split()]
    assert numbers == list(range(1, len(numbers) + 1)), "none is missing, none came twice"


def test_a_capture_that_breaks_off_while_it_describes_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = start(["/bin/sh", "-c", "sleep 1000 & sleep 1000 & wait"], tmp_path, isolate=True)
    describe, gone = CapturedProcess.process, [True]

    def ends_once(process: CapturedProcess, look: Look) -> ProcessState:
        if gone and process.slot:
            gone.clear()
            raise ProcessGoneError(f"process {process.pid} has ended")
        return describe(process, look)

    with ended(program), protected(program) as session:
        session.acknowledge(captured_at_last(session, CaptureOrder(sequence=1)).position)
        monkeypatch.setattr(CapturedProcess, "process", ends_once)
        gc.collect()
        gc.disable()
        try:
            session.capture(CaptureOrder(sequence=2))
            assert not gone, "one broke off"
            assert [one for one in gc.get_objects() if isinstance(one, SeenOthers)] == []
        finally:
            gc.enable()


def test_a_child_that_executes_another_program_right_after_it_was_entered_is_entered_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is opened of it then is the next program's, and our pages are gone with the one before."""
    os.mkfifo(tmp_path / "go")
    script = f"(read line < {tmp_path}/go; exec sleep 1000) & echo ready; wait"
    program = start(["/bin/sh", "-c", script], tmp_path, isolate=True)
    track, executed = enter._tracker_for, []

    def track_once_it_executes(pid: int, entered: Entered) -> Any:
        if pid != program.pid and not executed:
            (tmp_path / "go").write_text("go\n")
            program.wait_until(lambda: procfs.status(pid).name == "sleep", "that it has executed it")
            executed.append(pid)
        return track(pid, entered)

    monkeypatch.setattr(enter, "_tracker_for", track_once_it_executes)
    program.wait_for_line("ready")
    with ended(program), protected(program) as session:
        captured_at_last(session, CaptureOrder())
        assert executed


POOL = """
import multiprocessing, os, time
from multiprocessing import shared_memory

def work(asked, answers, counted, name):
    shared = shared_memory.SharedMemory(name=name)
    while (number := asked.get()) is not None:
        with counted.get_lock():
            counted.value += 1
            shared.buf[0] = (shared.buf[0] + 1) % 256
        answers.put(number * number)

context = multiprocessing.get_context("fork")
asked, answers, counted = context.Queue(), context.Queue(), context.Value("i", 0)
shared = shared_memory.SharedMemory(create=True, size=4096)
workers = [context.Process(target=work, args=(asked, answers, counted, shared.name)) for _ in range(3)]
for worker in workers:
    worker.start()
total = 0
number = 0
while not os.path.exists("go"):
    asked.put(number)
    total += answers.get()
    print(number, total, flush=True)
    number += 1
    time.sleep(0.005)
for worker in workers:
    asked.put(None)
for worker in workers:
    worker.join()
print([worker.exitcode for worker in workers], counted.value, shared.buf[0], flush=True)
shared.close()
shared.unlink()
"""
"""Three workers with queues, a lock, a value and shared memory; every parent of a queue has a thread that feeds it."""


def test_workers_of_multiprocessing_count_on(tmp_path: Path) -> None:
    program, taken = three_lives(start([sys.executable, "-c", POOL], tmp_path, isolate=True), grown_by(40))
    with ended(program):
        program.tell()
        assert program.finish() == 0, program.complaints
    *counted, end = program.output.splitlines()
    assert counted == [f"{number} {sum(n * n for n in range(number + 1))}" for number in range(len(counted))]
    assert end == f"[0, 0, 0] {len(counted)} {len(counted) % 256}"
    assert len(taken[0].members) >= 3


@pytest.mark.compiler
@pytest.mark.command("make")
def test_make_builds_on(tmp_path: Path) -> None:
    for number in range(24):
        (tmp_path / f"f{number}.c").write_text(f"#include <stdio.h>\nint f{number}(int x) {{ return x + {number}; }}\n")
    (tmp_path / "main.c").write_text('#include <stdio.h>\nint f7(int);\nint main(void) { return printf("%d\\n", f7(35)) < 0; }\n')
    objects = " ".join(f"f{number}.o" for number in range(24))
    link = "\t@until [ -e go ]; do sleep 0.01; done\n\tgcc -o $@ $^\n"
    (tmp_path / "Makefile").write_text(f"prog: main.o {objects}\n{link}%.o: %.c\n\tgcc -O2 -c -o $@ $<\n")
    built = [0]

    def has_built(program: Program) -> bool:
        count = len(list(tmp_path.glob("*.o")))
        if count < min(built[0] + 2, 25):  # while it is made ready to be captured it may build all that it can
            return False
        built[0] = count
        return True

    program, _ = three_lives(start(["make", "-j2"], tmp_path, isolate=True), has_built)
    with ended(program):
        program.tell()
        assert program.finish() == 0, program.complaints
    assert subprocess.run([tmp_path / "prog"], capture_output=True, text=True, check=True).stdout == "42\n"


WATCHED = """
import os, subprocess, time
child = subprocess.Popen(["sleep", "60"])
watched = os.pidfd_open(child.pid)
print("ready", flush=True)
child.wait()
"""


def test_a_child_that_ends_while_it_is_described_is_not_taken_for_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = start([sys.executable, "-c", WATCHED], tmp_path, isolate=True)

    def ended_just_now(held: OpenFile, surroundings: Surroundings) -> Resource | None:
        if held.pid == program.pid and held.first.target == pidfd.TARGET:
            raise ProcessGoneError("there is no process 12345 any more")
        return genuine(held, surroundings)

    genuine = pidfd.describe
    with ended(program), protected(program) as session:
        program.wait_for_line("ready")
        captured_at_last(session, CaptureOrder())
        monkeypatch.setattr(pidfd, "describe", ended_just_now)
        with pytest.raises(CaptureError, match="lives on") as raised:
            session.capture(CaptureOrder())
        assert not isinstance(raised.value, ProcessGoneError)
        monkeypatch.setattr(pidfd, "describe", genuine)
        captured_at_last(session, CaptureOrder())


def test_what_is_known_of_processes_costs_few_descriptors(tmp_path: Path) -> None:
    opens = "many = [os.eventfd(0) for _ in range(100)]"
    many = f"import os, time; {opens}; os.fork(); os.fork(); print(1, flush=True); time.sleep(60)"
    program = start([sys.executable, "-c", many], tmp_path, isolate=True)
    with ended(program), protected(program) as session:
        program.wait_until(lambda: program.output.count("1") == 4, "all of them")
        captured_at_last(session, CaptureOrder())
        kept = [target for target in map(_target, os.listdir("/proc/self/fd")) if "/fdinfo/" in target]
        assert len(kept) < 200


def _target(number: str) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{number}")
    except OSError:
        return ""


MANY = """
import os, subprocess, sys, time
children = [subprocess.Popen(["sleep", "1000"]) for _ in range(int(sys.argv[1]))]
print("ready", flush=True)
time.sleep(1000)
"""
MORE: Final = 4
BYTES_A_PROCESS: Final = 5 << 20


def test_a_process_more_takes_little_memory_of_the_keeper(tmp_path: Path) -> None:
    """A shell has short-lived children all day, several at a time."""
    held = []
    for count in (1, 1 + MORE):
        place = tmp_path / str(count)
        place.mkdir()
        with ended(start([sys.executable, "-c", MANY, str(count)], place, isolate=True)) as program:
            program.wait_for_line("ready")
            tracemalloc.start()
            try:
                with protected(program) as session:
                    captured_at_last(session, CaptureOrder())
                    held.append(tracemalloc.get_traced_memory()[0])
            finally:
                tracemalloc.stop()
    assert held[1] - held[0] < MORE * BYTES_A_PROCESS
