"""A base and many deltas, taken at random instants, equal the program, however it changed its memory in between.

``tests/tracees/mutator.c`` changes its memory in every way that can hide a write, and its transcript is the same in every run
with the same seed; so a restored mutator must continue with the very lines of an undisturbed one. The seed is in the test's
name. FAILOVER_TEST_SEEDS=100 tries that many more.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from checkpoint.engine import CaptureOrder, Session
from checkpoint.engines.ptrace.capture import memory
from checkpoint.engines.ptrace.capture.memory import MemoryCapture, RunningCopy
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.errors import UnsupportedError
from checkpoint.linux.memory.pagemap import PageScanner
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.memory.write_protect import PagemapTracker
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import (
    Program,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored,
    start,
    start_tracee,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root, pytest.mark.timeout(600)]

Compiled = Callable[..., Path]

WAYS = {
    "writes": "wpz",
    "forgotten_pages": "dDp",
    "mapped_again_at_the_same_address": "mMp",
    "mapped_over": "op",
    "moved_away_and_back": "rp",
    "pages_that_change_places": "Sp",
    "sealed_after_the_write": "jp",
    "written_by_the_kernel": "xp",
    "written_through_proc": "vj",
    "short_lived_mappings": "cp",
    "a_heap_that_grows_and_shrinks": "b",
    "shared_memory": "s",
    "huge_pages": "hH",
    "a_private_file_mapping": "k",
    "a_mapped_file_that_is_deleted": "Kpd",
    "guards": "gp",
    "everything": "wpzdDmMorSjxvcbshHk",
}
SEEDS = range(1, 2 + int(os.environ.get("FAILOVER_TEST_SEEDS", "0")))
DELTAS = 20
NAP_US = "300"
MORE_ROUNDS = 30


def _undisturbed(program: Path, directory: Path, ways: str, seed: int, rounds: int) -> list[str]:
    """The lines of a run that nobody looked at."""
    argv = [str(program), "never", ways, str(seed), str(rounds), "0"]
    return subprocess.run(argv, cwd=directory, capture_output=True, text=True, check=True).stdout.splitlines()


def _rounds(program: Program) -> int:
    return program.output.count("\n")


def _nap(dice: random.Random) -> None:
    """Let the program run for a moment of random length: the instant of the next capture is the point."""
    time.sleep(dice.uniform(0, 0.008))


@pytest.fixture(autouse=True)
def passes(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Where snapshots get lost, also small deltas are copied beforehand: as if every one of them were large."""
    if "some_lost" in request.node.name:
        monkeypatch.setattr(memory, "LARGE_COUNT", 1)
        monkeypatch.setattr(memory, "WORTH_COUNT", 1)


def _captured(session: Session, order: CaptureOrder) -> Snapshot:
    """A capture; where the program holds something unsupported for a moment (/proc/self/mem), the next one that works."""
    while True:
        try:
            return captured_at_last(session, order)
        except UnsupportedError:
            continue


def _chain(session: Session, dice: random.Random, *, lost: float) -> list[Snapshot]:
    """A base and its deltas; a part of them is lost on the way and never acknowledged."""
    base = _captured(session, CaptureOrder(base=True, sequence=1))
    chain = [transported(base)]
    session.acknowledge(base.position)
    for sequence in range(2, DELTAS + 2):
        _nap(dice)
        delta = _captured(session, CaptureOrder(base=False, sequence=sequence))
        last = sequence == DELTAS + 1
        if dice.random() < lost and not last:
            continue
        assert delta.parent == chain[-1].position
        session.acknowledge(delta.position)
        chain.append(transported(delta))
    return chain


@pytest.mark.sampled(3)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("lost", [0.0, 0.4], ids=["all_acknowledged", "some_lost"])
@pytest.mark.parametrize("ways", WAYS)
def test_a_base_and_its_deltas_are_the_program(ways: str, lost: float, seed: int, compiled: Compiled, tmp_path: Path) -> None:
    program, dice = compiled("mutator", "-O2"), random.Random(seed)
    with ended(start_tracee(program, tmp_path, WAYS[ways], str(seed), "1000000", NAP_US)) as tracee:
        tracee.wait_for_output(len("ready\n"))
        with protected(tracee) as session:
            chain = _chain(session, dice, lost=lost)
            tracee.kill()
    _expect_the_same_story(program, tmp_path, chain, ["mutator", WAYS[ways], seed])


def test_scans_that_nobody_acknowledges_are_joined_and_none_is_forgotten(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "UNACKNOWLEDGED_LIMIT", 3)
    program, dice, ways = compiled("mutator", "-O2"), random.Random(8), WAYS["everything"]
    with ended(start_tracee(program, tmp_path, ways, "8", "1000000", NAP_US)) as tracee:
        with protected(tracee) as session:
            chain = _chain(session, dice, lost=0.85)
            assert isinstance(session, PtraceSession)
            assert len(session._first.memory._unacknowledged) <= 3
            assert len(session._builder._totals_at) <= 4
            tracee.kill()
    _expect_the_same_story(program, tmp_path, chain, ["mutator", ways, 8])


def _expect_the_same_story(program: Path, directory: Path, chain: list[Snapshot], told: list[object]) -> None:
    """Bring the chain back, let it do some more rounds, and compare its whole output with an undisturbed run's."""
    with ended(restored(chain, directory)) as back:
        known = _rounds(back)
        back.wait_until(lambda: _rounds(back) > known + MORE_ROUNDS, f"{MORE_ROUNDS} more rounds")
        back.tell()
        status = back.finish()
    lines = back.output.splitlines()
    assert (status, lines[-1]) == (0, "ok"), lines[-20:]
    quiet = directory / "quiet"
    quiet.mkdir()
    wanted = _undisturbed(program, quiet, str(told[1]), int(str(told[2])), len(lines) - 2)
    assert lines == wanted


@pytest.mark.parametrize("seed", SEEDS)
def test_generated_code_survives_base_and_deltas(seed: int, compiled: Compiled, tmp_path: Path) -> None:
    program, dice = compiled("jit", "-O2"), random.Random(seed)
    with ended(start_tracee(program, tmp_path, "1000000", "1")) as tracee:
        with protected(tracee) as session:
            chain = _chain(session, dice, lost=0.3)
            tracee.kill()
    with ended(restored(chain, tmp_path)) as back:
        known = _rounds(back)
        back.wait_until(lambda: _rounds(back) > known + MORE_ROUNDS, f"{MORE_ROUNDS} more rounds")
        back.tell()
        assert back.finish() == 0, back.output[-2000:]
    lines = back.output.splitlines()
    wanted = subprocess.run([program, "never", str(len(lines) - 2), "0"], capture_output=True, text=True, check=True).stdout
    assert lines == wanted.splitlines()


def test_generations_follow_one_another(compiled: Compiled, tmp_path: Path) -> None:
    """Four lives: each is a base with deltas, and each goes on where the last one stood."""
    program, dice, ways = compiled("mutator", "-O2"), random.Random(5), WAYS["everything"]
    tracee = start_tracee(program, tmp_path, ways, "5", "1000000", NAP_US)
    for _ in range(3):
        with ended(tracee), protected(tracee) as session:
            chain = _chain(session, dice, lost=0.2)
            tracee.kill()
        tracee = restored(chain, tmp_path)
    with ended(tracee), protected(tracee) as session:
        chain = _chain(session, dice, lost=0.2)
        tracee.kill()
    _expect_the_same_story(program, tmp_path, chain, ["mutator", ways, 5])


def test_the_pages_of_a_quiet_program_are_not_sent_again(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("bss", "-O2"), tmp_path)) as tracee, protected(tracee) as session:
        base = session.capture(CaptureOrder(sequence=1))
        session.acknowledge(base.position)
        for sequence in range(2, 8):
            delta = _captured(session, CaptureOrder(base=False, sequence=sequence))
            session.acknowledge(delta.position)
            assert len(delta.contents) <= 64 * 4096 < len(base.contents)
        tracee.tell()
        assert tracee.finish() == 0


def test_a_sparse_mapping_costs_its_populated_pages_only(compiled: Compiled, tmp_path: Path) -> None:
    """The kernel calls every page of a fresh registration written, and makes page tables for 64 GiB if asked carelessly."""
    with ended(start_tracee(compiled("sparse", "-O2"), tmp_path)) as tracee, protected(tracee) as session:
        base = session.capture(CaptureOrder(sequence=1))
        session.acknowledge(base.position)
        delta = session.capture(CaptureOrder(base=False, sequence=2))
        assert len(base.contents) < 4 << 20
        assert len(delta.contents) < 1 << 20
        tables = next(line for line in Path(f"/proc/{tracee.pid}/status").read_text().splitlines() if line.startswith("VmPTE"))
        assert int(tables.split()[1]) < 8192, tables
        tracee.tell()
        assert tracee.finish() == 0


OBEDIENT = """
import mmap, os, sys, time
arena = mmap.mmap(-1, 32 << 20, flags=mmap.MAP_PRIVATE)
arena[:] = b"x" * len(arena)
orders, done = sys.argv[1] + "/orders", 0
print("ready", flush=True)
while True:
    wanted = int(open(orders).read()) if os.path.exists(orders) else 0
    while done < wanted:
        arena[done * 4096 % len(arena)] ^= 1
        done += 1
        if done == wanted:
            print(done, flush=True)
    time.sleep(float(sys.argv[2]))
"""
"""Writes as many pages, one after the other, as it is told to, says when it has; rests for as long as it is told."""


@pytest.mark.write_protection
@pytest.mark.parametrize("is_base", [True, False], ids=["base", "delta"])
def test_a_freeze_copies_only_what_was_written_since_the_last_pass(
    is_base: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much was written before: the program writes during each pass, less and less."""
    told = 0

    def write(program: Program, count: int) -> None:
        nonlocal told
        told += count
        (tmp_path / "next").write_text(str(told))
        (tmp_path / "next").replace(tmp_path / "orders")
        program.wait_for_line(str(told))

    copy_everything, catch_up, counts = MemoryCapture._copy_everything, MemoryCapture._catch_up, [2000, 1000, 50]
    with (
        ended(start([sys.executable, "-S", "-c", OBEDIENT, tmp_path, "0.001"], tmp_path)) as program,
        protected(program) as session,
    ):
        assert isinstance(session, PtraceSession)
        program.wait_for_line("ready")
        if not is_base:
            session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
        write(program, 4000)

        def written_after(genuine: Callable[..., None]) -> Callable[..., None]:
            def passing(self: MemoryCapture, copied: RunningCopy) -> None:
                genuine(self, copied)
                if counts:
                    write(program, counts.pop(0))

            return passing

        if is_base:
            monkeypatch.setattr(MemoryCapture, "_copy_everything", written_after(copy_everything))
        monkeypatch.setattr(MemoryCapture, "_catch_up", written_after(catch_up))
        snapshot = session.capture(CaptureOrder(base=is_base, sequence=2))
        program.kill()
    assert not counts, "there was a pass for each"
    assert len(snapshot.contents) >= (32 << 20 if is_base else 7000 * 4096)
    own = 200  # pages of the interpreter's, between two looks for orders
    assert 50 <= session.frozen_size // 4096 <= 50 + own


class LateGate:
    """Opens after so many questions; before each the program writes."""

    def __init__(self, count: int, passing: Callable[[], None]) -> None:
        self._count, self._passing = count, passing

    def opens(self, pids: tuple[int, ...]) -> bool:
        self._count -= 1
        if self._count:
            self._passing()
        return not self._count

    def closes(self, *, stood_still: bool) -> None:
        """As of a gate that keeps no account."""


@pytest.mark.write_protection
def test_a_capture_that_waits_long_keeps_one_copy_of_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program writes all of its arena in each slice of the wait."""
    told, sizes, take = 0, [], MemoryCapture.take

    def write() -> None:
        nonlocal told
        told += 8192
        (tmp_path / "next").write_text(str(told))
        (tmp_path / "next").replace(tmp_path / "orders")
        program.wait_for_line(str(told))

    def measured(self: MemoryCapture, copied: RunningCopy, **named: Any) -> Any:
        sizes.append(sum(len(copy.content) for copy in copied.copies))
        return take(self, copied, **named)

    monkeypatch.setattr(MemoryCapture, "take", measured)
    with (
        ended(start([sys.executable, "-S", "-c", OBEDIENT, tmp_path, "0.001"], tmp_path)) as program,
        protected(program) as session,
    ):
        program.wait_for_line("ready")
        snapshot = session.capture(CaptureOrder(sequence=1, gate=LateGate(6, write)))
        program.kill()
    assert len(snapshot.contents) >= 32 << 20
    assert sizes and max(sizes) < 3 * 32 << 20, "one copy of the arena, and the first one with the rest of the program"


def test_between_two_captures_no_page_is_held(tmp_path: Path) -> None:
    """Else a keeper needs as much memory as its program while a large snapshot travels, and twice as much for the next one."""
    size = 24 << 20
    script = f"import os, time; held = os.urandom({size}); print('ready', flush=True); time.sleep(1000)"
    with ended(start([sys.executable, "-S", "-c", script], tmp_path)) as program:
        program.wait_for_line("ready")
        tracemalloc.start()
        try:
            with protected(program) as session:
                assert len(captured_at_last(session, CaptureOrder()).contents) > size
                assert tracemalloc.get_traced_memory()[0] < size // 4
        finally:
            tracemalloc.stop()


@pytest.mark.write_protection
def test_a_small_delta_is_copied_while_the_program_runs(tmp_path: Path) -> None:
    """What was written a while ago does not wait for the freeze, as little as it is."""
    with ended(start([sys.executable, "-S", "-c", OBEDIENT, tmp_path, "1"], tmp_path)) as program, protected(program) as session:
        assert isinstance(session, PtraceSession)
        program.wait_for_line("ready")
        session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
        (tmp_path / "next").write_text("100")
        (tmp_path / "next").replace(tmp_path / "orders")
        program.wait_for_line("100")
        snapshot = session.capture(CaptureOrder(base=False, sequence=2))
        program.kill()
    assert len(snapshot.contents) >= 100 * 4096
    assert session.frozen_size < 100 * 4096, "of the hundred pages, and some of the interpreter's, few were left"


def test_memory_that_is_written_while_its_base_is_taken_is_of_one_instant(compiled: Compiled, tmp_path: Path) -> None:
    """The base takes long enough for much to be written during it, and after it until the delta."""
    with ended(start_tracee(compiled("hard_writer", "-O2"), tmp_path, "96")) as tracee, protected(tracee) as session:
        chain = []
        for sequence in (1, 2):
            snapshot = session.capture(CaptureOrder(base=sequence == 1, sequence=sequence))
            session.acknowledge(snapshot.position)
            chain.append(transported(snapshot))
        tracee.kill()
    assert len(chain[0].contents) >= 96 << 20
    with ended(restored(chain, tmp_path)) as back:
        back.tell()
        expect_ok(back)


@pytest.mark.write_protection
def test_writes_that_were_begun_land_before_a_pass_reads(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel writes for a program past the protection (access_remote_vm() in mm/memory.c): what it had begun is not named."""
    monkeypatch.setattr(memory, "LARGE_COUNT", 1)
    steps: list[str] = []

    def noted(owner: type, name: str, step: str) -> None:
        genuine = getattr(owner, name)

        def noting(*arguments: Any, **named: Any) -> Any:
            answer = genuine(*arguments, **named)
            steps.append(step)
            return answer

        monkeypatch.setattr(owner, name, noting)

    noted(PageScanner, "written_where_protected", "protected")
    noted(PagemapTracker, "_let_writers_finish", "landed")
    noted(Memory, "readable_pages_into", "read")
    with ended(start_tracee(compiled("hard_writer", "-O2"), tmp_path, "4")) as tracee, protected(tracee) as session:
        session.capture(CaptureOrder(sequence=1))
    seen = [step for step, before in zip(steps, ["", *steps], strict=False) if step != before]
    assert seen[:3] == ["protected", "landed", "read"] and seen == seen[:3] * (len(seen) // 3)


DROPPER = """
import mmap, os, sys, time
def step(name):
    print(name, flush=True)
    while not os.path.exists(os.path.join(sys.argv[1], "after " + name)):
        time.sleep(0.002)
forgotten, gone = mmap.mmap(-1, 1 << 20, flags=mmap.MAP_PRIVATE), mmap.mmap(-1, 1 << 20, flags=mmap.MAP_PRIVATE)
forgotten[:] = gone[:] = b"x" * (1 << 20)
step("ready")
forgotten[:] = b"y" * (1 << 20)
step("written")
forgotten.madvise(mmap.MADV_DONTNEED)
gone.close()
step("dropped")
print(set(forgotten[:]), flush=True)
"""


@pytest.mark.parametrize("is_base", [True, False], ids=["base", "delta"])
def test_what_is_dropped_after_it_was_copied_is_not_in_the_snapshot(
    is_base: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program gives memory back between the pass that copies it and the freeze."""

    def go_on(program: Program, done: str, expected: str) -> None:
        (tmp_path / f"after {done}").touch()
        program.wait_for_line(expected)

    monkeypatch.setattr(memory, "LARGE_COUNT", 1)
    copy_running = MemoryCapture.copy_running
    with ended(start([sys.executable, "-c", DROPPER, tmp_path], tmp_path)) as program, protected(program) as session:

        def dropped_afterwards(self: MemoryCapture, **named: Any) -> RunningCopy:
            copied = copy_running(self, **named)
            go_on(program, "written", "dropped")
            return copied

        program.wait_for_line("ready")
        chain = []
        if not is_base:
            chain.append(transported(session.capture(CaptureOrder(sequence=1))))
            session.acknowledge(chain[0].position)
        go_on(program, "ready", "written")
        monkeypatch.setattr(MemoryCapture, "copy_running", dropped_afterwards)
        chain.append(transported(session.capture(CaptureOrder(base=is_base, sequence=2))))
        program.kill()
    with ended(restored(chain, tmp_path)) as back:
        (tmp_path / "after dropped").touch()
        assert back.finish() == 0, back.complaints
        assert back.output.splitlines()[-1] == "{0}"


NEWCOMER = """
import os, sys, time
def step(name):
    print(name, flush=True)
    while not os.path.exists(os.path.join(sys.argv[1], "after " + name)):
        time.sleep(0.002)
step("ready")
late = bytearray(8 << 20)
step("mapped")
late[5 << 20] = 1
step("written")
late[6 << 20] = 2
step("written again")
print(late[5 << 20], late[6 << 20], flush=True)
"""


def test_a_mapping_that_came_before_a_second_base_is_followed(tmp_path: Path) -> None:
    """The first base was lost on its way, so that another is taken while a mapping is there that the first did not have."""

    def go_on(program: Program, done: str, expected: str) -> None:
        (tmp_path / f"after {done}").touch()
        program.wait_for_line(expected)

    with ended(start([sys.executable, "-c", NEWCOMER, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        session.capture(CaptureOrder(base=True, sequence=1))
        go_on(program, "ready", "mapped")
        chain = [transported(session.capture(CaptureOrder(base=True, sequence=2)))]
        session.acknowledge(chain[0].position)
        go_on(program, "mapped", "written")
        chain.append(transported(session.capture(CaptureOrder(base=False, sequence=3))))
        session.acknowledge(chain[1].position)
        go_on(program, "written", "written again")
        chain.append(transported(session.capture(CaptureOrder(base=False, sequence=4))))
        program.kill()
    with ended(restored(chain, tmp_path)) as back:
        (tmp_path / "after written again").touch()
        assert back.finish() == 0, back.complaints
        assert back.output.splitlines()[-1] == "1 2"


GIVER_UP = """
import mmap, os, sys, time
def step(name):
    print(name, flush=True)
    while not os.path.exists(os.path.join(sys.argv[1], "after " + name)):
        time.sleep(0.002)
with open("content", "wb") as file:
    file.write(b"f" * (1 << 20))
with open("content", "rb") as file:
    mapped = mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE)
mapped[:] = b"y" * len(mapped)
step("ready")
for page in (2, 3, 100):
    mapped.madvise(mmap.MADV_DONTNEED, page * 4096, 4096)
step("given up")
print("".join(chr(mapped[page * 4096]) for page in (1, 2, 3, 4, 99, 100, 101)), flush=True)
"""


def test_where_a_program_gave_up_its_copy_of_a_files_page_it_finds_the_file_again(tmp_path: Path) -> None:
    """Nothing has looked at the page since, so it is not there, and looks as if it were swapped out."""
    with ended(start([sys.executable, "-c", GIVER_UP, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        chain = [transported(captured_at_last(session, CaptureOrder(sequence=1)))]
        session.acknowledge(chain[0].position)
        chain.append(transported(captured_at_last(session, CaptureOrder(base=False, sequence=2))))
        session.acknowledge(chain[1].position)
        (tmp_path / "after ready").touch()
        program.wait_for_line("given up")
        chain.append(transported(captured_at_last(session, CaptureOrder(base=False, sequence=3))))
        program.kill()
    with ended(restored(chain, tmp_path)) as back:
        (tmp_path / "after given up").touch()
        assert back.finish() == 0
        assert back.output.splitlines()[-1] == "yffyyfy"
