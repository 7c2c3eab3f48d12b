"""The ready copy of several processes equals them all: built from a base, updated by deltas, resumed when they have ended."""

from __future__ import annotations

import gc
import os
import random
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, RestoreOptions
from checkpoint.engines.ptrace.restore import memory as restored_memory
from checkpoint.engines.ptrace.restore import threads as restored_threads
from checkpoint.engines.ptrace.restore.memory import KERNEL_NAMES
from checkpoint.engines.ptrace.restore.restore import RestoredProgram
from checkpoint.engines.ptrace.standby_copy import lay
from checkpoint.engines.ptrace.standby_copy.tree import FamilyCopy
from checkpoint.errors import CaptureError, ProcessGoneError, RestoreError, UnsupportedError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.spawn.vessel import Born, discard
from checkpoint.model import Member, PageRun, Snapshot
from checkpoint.pages import page_set
from checkpoint.store import chain
from checkpoint.store.member_pages import MemberPages
from checkpoint.store.xor_cache import Sender
from tests.checkpoint.engines.ptrace.capture.test_trees import FAMILY, POOL
from tests.checkpoint.engines.ptrace.restore import test_tree_orphans as orphans
from tests.checkpoint.engines.ptrace.restore import test_tree_shared as shared
from tests.checkpoint.engines.ptrace.restore import test_tree_states as states
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE
from tests.checkpoint.engines.ptrace.restore.test_tree_memory import BORN_LATE, SHARED, shared_out
from tests.checkpoint.engines.ptrace.restore.test_tree_states import STOPPED
from tests.checkpoint.engines.ptrace.standby_copy.test_single import (
    age_ns,
    base_of,
    deltas_of,
    takes_whole_continuing_deltas_only,
    vessel_for,
)
from tests.checkpoint.round_trip import (
    ENGINE,
    PATIENCE_S,
    Program,
    captured,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    start,
    transported,
)

pytestmark = pytest.mark.root

MUTABLE = Path(__file__).parents[4] / "tracees" / "mutable_family.py"
SEEDS = int(os.environ.get("FAILOVER_TEST_FAMILY_SEEDS", "3"))
DELTAS = 12
XOR_CACHE = 64 << 20
MORE = 30
"""Lines that it writes before it is captured, and after it was brought back."""


def mutable(directory: Path, seed: int = 1) -> Program:
    program = start([sys.executable, MUTABLE, str(seed)], directory, isolate=True)
    program.wait_for_line(str(MORE))
    return program


@dataclass(slots=True)
class Standby:
    """Vessels and the copy in them."""

    born: Born
    copy: FamilyCopy
    directory: Path
    is_program: bool = False

    def becomes_the_program(self) -> Program:
        """It runs from here on."""
        restored = self.copy.finish(RestoreOptions(age_ns(self.copy.state)))
        self.is_program = True
        restored.resume()
        return Program(self.born, self.directory)


@contextmanager
def laid(base: Snapshot, directory: Path) -> Iterator[Standby]:
    """A copy of a base; ended with the body, also when it has become the program."""
    born = vessel_for(base, directory)
    try:
        copy = lay.lay(born.pid, base, RestoreOptions())
        assert isinstance(copy, FamilyCopy)
        standby = Standby(born, copy, directory)
        try:
            yield standby
        finally:
            if not standby.is_program:
                copy.end()
    finally:
        discard(born)


def goes_on_to_its_end(back: Program) -> None:
    known = back.output.count("\n")
    back.wait_until(lambda: back.output.count("\n") > known + MORE, "that it goes on")
    back.tell()
    expect_ok(back)
    assert back.output.splitlines()[1:-1] == [str(number) for number in range(back.output.count("\n") - 2)]


@pytest.mark.parametrize("seed", range(1, SEEDS + 1))
def test_a_copy_of_a_family_that_follows_the_deltas_is_the_family(seed: int, tmp_path: Path) -> None:
    with ended(mutable(tmp_path, seed)) as program, protected(program) as session:
        base = base_of(session)
        with laid(base, tmp_path) as standby:
            for delta in deltas_of(session, random.Random(seed), DELTAS):
                standby.copy.advance(delta)
                standby.copy.require_clocks(age_ns(delta))
                assert standby.copy.position == delta.position
            program.kill()
            goes_on_to_its_end(standby.becomes_the_program())


def test_a_copy_that_is_laid_holds_no_other_copy_of_the_pages(tmp_path: Path) -> None:
    with ended(mutable(tmp_path)) as program, protected(program) as session:
        base = base_of(session)
        program.kill()
    assert base.copies
    with laid(base, tmp_path) as standby:
        assert standby.copy.position == base.position
        assert not [one for one in gc.get_objects() if isinstance(one, MemberPages)]


def everything_of(restored: RestoredProgram) -> list[dict[int, bytes]]:
    """Of each process what lies in its mappings, by their beginnings; those of the kernel are its."""
    found = []
    for threads in (restored.threads, *restored.others):
        memory, every = Memory(threads.pid), mappings_of(threads.pid)
        ours = [one for one in every if one.protection and not one.name.startswith(KERNEL_NAMES)]
        found.append({one.start: bytes(memory.read_pages(_extents(one.start, one.end))) for one in ours})
    return found


def _extents(start: int, end: int) -> page_set.Words:
    return page_set.extents([PageRun(start, end)])


def different_places(ours: dict[int, bytes], theirs: dict[int, bytes]) -> set[int]:
    """Where the two are not the same."""
    found: set[int] = set()
    for begin, content in ours.items():
        if content != theirs[begin]:
            found.update(begin + n for n, (one, other) in enumerate(zip(content, theirs[begin], strict=True)) if one != other)
    return found


def told_by_kernel(process: Snapshot | Member) -> set[int]:
    """Where the kernel says on which processor a thread runs: struct rseq without the critical section that it points to."""
    areas = [thread.rseq.address for thread in process.threads if thread.rseq is not None]
    return {area + n for area in areas for n in (*range(8), *range(20, 32))}


def looks_of(restored: RestoredProgram) -> list[tuple[object, ...]]:
    """Of each process what the kernel tells of it, as far as it does not say where it lies in this machine."""
    found: list[tuple[object, ...]] = []
    for threads in (restored.threads, *restored.others):
        status = procfs.status(threads.pid)
        descriptors = sorted(int(name) for name in os.listdir(f"/proc/{threads.pid}/fd"))
        ids = status.pids[-1], status.pgids[-1], status.sids[-1], status.threads
        found.append((ids, descriptors, mappings_of(threads.pid), threads.leader.registers()))
    return found


def mappings_of(pid: int) -> list[MapsLine]:
    """Each of them without device and inode; those that lie side by side, and are of one kind, as one."""
    found: list[MapsLine] = []
    for line in procfs.parse_maps(procfs.read_text(pid, "maps")):
        one = replace(line, device=0, inode=0, offset=line.offset if line.inode else 0)
        last = found[-1] if found else one
        goes_on = last.offset + last.size if line.inode else 0
        if (
            found
            and replace(one, start=last.start, offset=last.offset, end=last.end) == last
            and ((one.start, one.offset) == (last.end, goes_on))
        ):
            found[-1] = replace(last, end=one.end)
        else:
            found.append(one)
    return found


@pytest.mark.parametrize("seed", range(1, SEEDS + 1))
def test_what_is_made_of_a_copy_equals_what_its_chain_leads_to_byte_by_byte(seed: int, tmp_path: Path) -> None:
    """The copy hears of pages as differences from what it has."""
    sender, differences = Sender(), 0
    with ended(mutable(tmp_path, seed)) as program, protected(program) as session:
        snapshots = [base_of(session)]
        with laid(snapshots[0], tmp_path) as standby:
            for delta in deltas_of(session, random.Random(seed), DELTAS):
                told, _ = sender.told(delta, XOR_CACHE)
                standby.copy.advance(transported(told))
                sender.acknowledge(delta.position)
                snapshots.append(delta)
                differences += len(told.differences)
            assert differences
            program.kill()
            of_copy = standby.copy.finish(RestoreOptions(age_ns(standby.copy.state)))
            with from_chain(snapshots, tmp_path) as of_chain:
                for one, other in zip(looks_of(of_copy), looks_of(of_chain), strict=True):
                    assert one == other
                processes = standby.copy.state.processes
                for process, ours, theirs in zip(processes, everything_of(of_copy), everything_of(of_chain), strict=True):
                    assert ours.keys() == theirs.keys()
                    assert different_places(ours, theirs) <= told_by_kernel(process), f"in process {process.process.pid}"


@contextmanager
def from_chain(snapshots: Sequence[Snapshot], directory: Path) -> Iterator[RestoredProgram]:
    whole = chain.fold(snapshots)
    born = vessel_for(whole, directory)
    try:
        accepted = tuple(str(directory / name) for name in ("out", "err"))  # the copy has them open as well
        restored = ENGINE.restore(born.pid, whole, RestoreOptions(age_ns(whole), accept_changed=accepted))
        assert isinstance(restored, RestoredProgram)
        try:
            yield restored
        finally:
            for threads in (*restored.others, restored.threads):
                restored_threads.end(threads.leader, threads.others)
    finally:
        discard(born)


def test_a_copy_has_sessions_groups_orphans_and_ended_ones_as_the_family_has(tmp_path: Path) -> None:
    program = start([sys.executable, FAMILY, "go"], tmp_path, isolate=True)
    with ended(program), protected(program) as session:
        program.wait_until(lambda: program.output.count("\n") > MORE, "that it counts")
        base = base_of(session)
        assert base.zombies
        with laid(base, tmp_path) as standby:
            for delta in deltas_of(session, random.Random(1), DELTAS):
                standby.copy.advance(delta)
            program.kill()
            back = standby.becomes_the_program()
            known = back.output.count("\n")
            back.wait_until(lambda: back.output.count("\n") > known + MORE, "that it goes on")
            back.tell()
            expect_ok(back)


def test_memory_that_a_family_has_in_common_since_a_fork_is_there_once_in_its_copy(tmp_path: Path) -> None:
    common = 32 << 20
    script = f"memory = os.urandom({common})\nchildren = [born(wait_for_go) for _ in range(4)]\nis_ready()\n"
    program = start([sys.executable, "-c", PREAMBLE + script], tmp_path, isolate=True)
    with ended(program):
        program.wait_for_line("ready")
        base = captured(program)
        with laid(base, tmp_path) as standby:
            assert common < standby.copy.size < 2 * common
            assert standby.copy.size >= shared_out(standby.copy.pids()) * 0.9


OF_EACH_OTHER = {
    "SHARED": SHARED,
    "MAPPED_ALONE": shared.MAPPED_ALONE,
    "NAMELESS": shared.NAMELESS,
    "NAMED_PIPES": shared.NAMED_PIPES,
    "OWNERS": shared.OWNERS,
    "RIGHTS": states.RIGHTS,
    "KILLED": states.KILLED,
    "LEFT_BEHIND": orphans.LEFT_BEHIND,
    "SERVERS": shared.SERVERS,
    "CONNECTED_AS_NOBODY": shared.CONNECTED_AS_NOBODY,
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("program", OF_EACH_OTHER)
def test_what_processes_are_to_each_other_comes_back_from_their_copy_over_two_lives(program: str, tmp_path: Path) -> None:
    """Each of these programs says what differs."""
    tmp_path.chmod(0o755)
    arguments = ["asks"] if program == "LEFT_BEHIND" else []
    life = start([sys.executable, "-c", PREAMBLE + OF_EACH_OTHER[program], *arguments], tmp_path, isolate=True)
    goes_through_copies(life, tmp_path, 2)


def goes_through_copies(life: Program, directory: Path, lives: int) -> None:
    with ended(life):
        if not lives:
            life.tell()
            expect_ok(life)
            return
        life.wait_for_line("ready")
        with protected(life) as session:
            base = base_of(session)
            with laid(base, directory) as standby:
                for delta in deltas_of(session, random.Random(lives), 3):
                    standby.copy.advance(delta)
                life.kill()
                goes_through_copies(standby.becomes_the_program(), directory, lives - 1)


# --- Torn, half arrived, killed ---


def test_a_delta_that_breaks_off_in_the_middle_leaves_all_of_them_torn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ended(mutable(tmp_path)) as program, protected(program) as session:
        base = base_of(session)
        with laid(base, tmp_path) as standby:
            first, second = deltas_of(session, random.Random(2), 2)
            filled: list[object] = []
            fill = restored_memory.fill

            def breaks(*arguments: object) -> None:
                if filled:
                    raise CaptureError("the second process has gone")
                filled.append(fill(*arguments))  # type: ignore[arg-type,func-returns-value]

            with monkeypatch.context() as patched:
                patched.setattr(restored_memory, "fill", breaks)
                with pytest.raises(CaptureError):
                    standby.copy.advance(first)
            assert standby.copy.torn
            assert standby.copy.position == base.position, "it never claims what it has not"
            for use in (lambda: standby.copy.advance(second), lambda: standby.copy.finish(RestoreOptions())):
                with pytest.raises(RestoreError, match="torn"):
                    use()


def test_what_does_not_continue_it_or_has_not_come_whole_changes_nothing_of_any_process(tmp_path: Path) -> None:
    with ended(mutable(tmp_path)) as program, protected(program) as session:
        base = base_of(session)
        with laid(base, tmp_path) as standby:
            takes_whole_continuing_deltas_only(standby.copy, session)
            program.kill()
            goes_on_to_its_end(standby.becomes_the_program())


def killed_while_it_fills(vessel_pid: int, base: Snapshot, delta: Snapshot) -> list[int]:
    """Have a process of its own lay a copy, which is killed when the delta is in the first process's memory: who was born."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        copy = lay.lay(vessel_pid, base, RestoreOptions())
        assert isinstance(copy, FamilyCopy)
        os.write(write_end, " ".join(map(str, copy.pids())).encode())
        fill, filled = restored_memory.fill, []

        def dies(*arguments: Any) -> None:
            if filled:
                os.kill(os.getpid(), signal.SIGKILL)
            filled.append(fill(*arguments))  # type: ignore[func-returns-value]

        restored_memory.fill = dies
        copy.advance(delta)
        os._exit(1)
    os.close(write_end)
    with os.fdopen(read_end) as told:
        pids = [int(pid) for pid in told.read().split()]
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
    return pids


def test_who_is_killed_in_the_middle_of_a_delta_takes_all_of_them_along(tmp_path: Path) -> None:
    with ended(mutable(tmp_path)) as program, protected(program) as session:
        base, delta = base_of(session), next(deltas_of(session, random.Random(4), 1))
        program.kill()
    born = vessel_for(base, tmp_path)
    try:
        everybody = killed_while_it_fills(born.pid, base, delta)
        assert len(everybody) == 3
        assert everybody[0] == born.pid
        _, status = os.waitpid(born.pid, 0)
        assert os.WTERMSIG(status) == signal.SIGKILL
        until_gone(everybody[1:])
    finally:
        discard(born)
    with laid(base, tmp_path) as standby:  # from the chain
        standby.copy.advance(delta)
        goes_on_to_its_end(standby.becomes_the_program())


def lives(pid: int) -> bool:
    try:
        return procfs.stat(pid).state not in "ZX"
    except ProcessGoneError:
        return False


def until_gone(pids: Iterable[int]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while left := [pid for pid in pids if lives(pid)]:
        assert time.monotonic() < deadline, f"{left} live on"
        time.sleep(0.002)


# --- What is not followed, and what can have none ---


def test_a_copy_is_to_be_laid_again_when_a_process_was_born(tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", PREAMBLE + "born(wait_for_go)\n" + BORN_LATE], tmp_path, isolate=True)) as program:
        with protected(program) as session:
            program.wait_for_line("begun")
            base = base_of(session)
            with laid(base, tmp_path) as standby:
                (tmp_path / "fork").touch()
                program.wait_for_line("ready")
                delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2, hold=True)))
                with pytest.raises(RestoreError, match="its processes have changed"):
                    standby.copy.advance(delta)
                assert not standby.copy.torn
            program.kill()
        with laid(chain.fold([base, delta]), tmp_path) as standby:
            back = standby.becomes_the_program()
            back.tell()
            expect_ok(back)


def test_what_several_processes_hold_that_a_copy_does_not_keep_is_told(tmp_path: Path) -> None:
    (tmp_path / "pool").mkdir()
    with ended(start([sys.executable, "-c", POOL], tmp_path / "pool", isolate=True)) as program:
        program.wait_until(lambda: program.output.count("\n") > 3, "that it works")
        assert_refused(captured(program), tmp_path, r"it maps /dev/shm/psm_\w+ shared")
    (tmp_path / "stopped").mkdir()
    with ended(start([sys.executable, "-c", PREAMBLE + STOPPED], tmp_path / "stopped", isolate=True)) as program:
        program.wait_for_line("ready")
        assert_refused(captured(program), tmp_path, "a process of it is stopped")


def assert_refused(base: Snapshot, directory: Path, why: str) -> None:
    with pytest.raises(UnsupportedError, match=why), laid(base, directory):
        pass
