"""The team's board in a captured program: told, never captured; zeros and /dev/null where it resumes."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, RestoreOptions
from checkpoint.engines.ptrace.facts import probe
from checkpoint.engines.ptrace.standby_copy import eligibility
from checkpoint.linux.memory.tracker import BOARD
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.resources.files import locks
from checkpoint.resources.ipc import boards
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored,
    start_tracee,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

SIZE = 6 * 4096
NAMES = ("own", "own+1000", "peer-robot2")
SECRET = b"what belongs to robot1 alone"
OTHER = (
    "import mmap, os, sys; m = [mmap.mmap(os.open(p, os.O_RDWR), 0) for p in sys.argv[1:]]; print(flush=True); sys.stdin.read()"
)
Compiled = Callable[..., Path]


def test_the_schedule_of_a_robot_without_a_board_is_known_by_its_path() -> None:
    nowhere = "/run/failover-of-a-test"
    assert boards.is_board(os.getpid(), f"{nowhere}/failover-schedule/schedule", (0, 0))
    assert not boards.is_board(os.getpid(), f"{nowhere}/schedule/schedule", (0, 0))
    assert not boards.is_board(os.getpid(), f"{nowhere}/failover-schedule/own", (0, 0))


@pytest.mark.parametrize("name", ["own", "private", "own+1000", "peer-robot2", "guest-world.robot3", "agent", "schedule"])
def test_each_file_of_a_board_is_known_by_its_name_and_no_other_beside_them(name: str) -> None:
    assert boards.is_board(os.getpid(), f"{boards.PLACE}0123-robot1/{name}", (0, 0))
    assert not boards.is_board(os.getpid(), f"{boards.PLACE}0123-robot1/x{name}", (0, 0))


def made(directory: Path) -> Path:
    """A directory with files of a board, as far as a capture looks at them."""
    directory.mkdir()
    for name in NAMES:
        (directory / name).write_bytes((boards.MAGIC + SECRET).ljust(SIZE, b"\x55"))
    return directory


@pytest.fixture
def board() -> Iterator[Path]:
    """One where agents make them."""
    directory = Path(f"{boards.PLACE}{secrets.token_hex(6)}-robot1")
    try:
        yield made(directory)
    finally:
        shutil.rmtree(directory)


@pytest.fixture
def other(board: Path) -> Iterator[None]:
    """Another program that has the same board mapped."""
    words = [sys.executable, "-S", "-c", OTHER, *map(str, sorted(board.iterdir()))]
    program = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert program.stdout is not None
    program.stdout.readline()
    try:
        yield
    finally:
        program.communicate()


def tracee(compiled: Compiled, tmp_path: Path, board: Path, *more: str) -> Program:
    return start_tracee(compiled("board"), tmp_path, str(board), *more)


def of_board(snapshot: Snapshot) -> list[int]:
    """The pages of what is mapped of it."""
    return [vma.size // 4096 for vma in snapshot.vmas if vma.name == BOARD]


@pytest.mark.usefixtures("other")
def test_a_board_that_others_have_mapped_too_is_never_captured_and_comes_back_as_zeros(
    compiled: Compiled, tmp_path: Path, board: Path
) -> None:
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        session.acknowledge(base.position)
        (board / "own").write_bytes(b"\xaa" * SIZE)
        delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))
        program.kill()
    assert of_board(base) == of_board(delta) == [6, 6, 6]
    assert SECRET not in bytes(base.contents)
    places = page_set.extents(vma for vma in base.vmas if vma.name == BOARD)
    assert not len(page_set.intersection(page_set.extents((*base.runs, *delta.runs)), places))
    told = [held.facts["mappings"] for held in delta.resources if held.kind == boards.KIND and "mappings" in held.facts]
    assert len(told) == 1
    assert isinstance(told[0], list)
    assert len(told[0]) == 3
    assert not [held for held in delta.resources if held.kind == boards.KIND and "locks" in held.facts]
    with ended(restored([base, delta], tmp_path)) as program:
        program.tell()
        expect_ok(program)
    assert (board / "own").read_bytes() == b"\xaa" * SIZE, "the restored program wrote to the board that it left"


def test_what_lay_where_a_board_is_mapped_now_is_forgotten(compiled: Compiled, tmp_path: Path, board: Path) -> None:
    with ended(tracee(compiled, tmp_path, board, "over")) as program, protected(program) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        session.acknowledge(base.position)
        (tmp_path / "map").touch()
        program.wait_for_line("mapped")
        delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))
        program.kill()
    assert not of_board(base)
    assert of_board(delta) == [6, 6, 6]
    with ended(restored([base, delta], tmp_path)) as program:
        program.tell()
        expect_ok(program)


def test_a_restore_takes_no_lock_of_the_board_that_the_program_left(compiled: Compiled, tmp_path: Path, board: Path) -> None:
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        program.kill()
    with open(board / "own", "r+b") as own:
        fcntl.flock(own, fcntl.LOCK_EX)
        for byte in (1 << 40, (1 << 41) + 5):
            fcntl.fcntl(own, locks.F_OFD_SETLK, struct.pack("<hh4xqqi4x", fcntl.F_WRLCK, 0, byte, 1, 0))
        with ended(restored(base, tmp_path)) as new:
            new.tell()
            expect_ok(new)


def test_a_board_whose_files_were_removed_is_told_as_one(compiled: Compiled, tmp_path: Path, board: Path) -> None:
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        for name in NAMES:
            (board / name).unlink()
        base = transported(captured_at_last(session, CaptureOrder()))
        program.kill()
    assert of_board(base) == [6, 6, 6]
    assert SECRET not in bytes(base.contents)
    with ended(restored(base, tmp_path)) as program:
        program.tell()
        expect_ok(program)


def test_a_board_in_any_directory_is_known_by_how_its_files_begin(compiled: Compiled, tmp_path: Path) -> None:
    board = made(tmp_path / "anywhere")
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        program.kill()
    assert of_board(base) == [6, 6, 6]
    with ended(restored(base, tmp_path)) as program:
        program.tell()
        expect_ok(program)


def test_a_file_of_such_a_name_that_is_no_board_comes_back_as_it_was(compiled: Compiled, tmp_path: Path) -> None:
    board = made(tmp_path / "anywhere")
    for name in NAMES:
        (board / name).write_bytes(SECRET.ljust(SIZE, b"\x55"))
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        base = captured_at_last(session, CaptureOrder())
    assert not of_board(base)
    assert not [held for held in base.resources if held.kind == boards.KIND]


def test_a_program_with_a_board_can_have_a_ready_copy(compiled: Compiled, tmp_path: Path, board: Path) -> None:
    with ended(tracee(compiled, tmp_path, board)) as program, protected(program) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        session.acknowledge(base.position)
        delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))
        program.kill()
    assert not list(eligibility.hindrances(base))
    born = spawn_vessel(Birth(inner_pid=base.process.pid))
    try:
        copy = ENGINE.lay(born.pid, base, RestoreOptions(0))
        copy.advance(delta)
        assert copy.position == delta.position
    finally:
        discard(born)


@pytest.mark.usefixtures("other")
def test_check_tells_pages_and_address(compiled: Compiled, tmp_path: Path, board: Path) -> None:
    with ended(tracee(compiled, tmp_path, board)) as program:
        report = probe.probe(program.pid)
        told = [found.text for found in report.findings if "board, 6 pages at address 0x" in found.text]
        assert len(told) == 3
        assert not report.reasons
        assert os.path.exists(board / "own")
