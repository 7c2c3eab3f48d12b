"""Unprepared programs, captured, killed and restored three times in a row: they compute what they would have."""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.errors import ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.model import Snapshot
from tests.checkpoint.programs import CASES, PLAIN, Case
from tests.checkpoint.round_trip import (
    NOBODY,
    Program,
    as_nobody,
    captured_at_last,
    ended,
    protected,
    restored,
    start,
    transported,
)

ROUNDS = 3
ATTEMPTS = 20
PATIENCE_S = 60.0
ENVIRONMENT = {
    **{name: os.environ[name] for name in ("PATH", "PYTHONPATH") if name in os.environ},  # where numpy lies, on some machines
    "LANG": "C",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "HOME": "/tmp",
}


@pytest.fixture
def prepared(tmp_path: Path) -> Callable[[Case, str], Path]:
    """Makes a directory with a program's files in it."""
    return functools.partial(lay_out, tmp_path)


def lay_out(place: Path, case: Case, name: str) -> Path:
    """Make a directory with a program's files in it."""
    directory = place / name
    directory.mkdir()
    for file, content in case.files:
        (directory / file).write_text(content if file != "text" else some_text())
    return directory


def some_text() -> str:
    """Some megabytes that a compressor has to work on."""
    state, words = 7, []
    for _ in range(400_000):
        state = state * 1103515245 + 12345 & 0x7FFFFFFF
        words.append(f"{state >> 12 & 0xFFFF:x}")
    return " ".join(words)


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.slow
def test_a_program_brought_back_three_times_computes_the_same(case: Case, prepared: Callable[[Case, str], Path]) -> None:
    if shutil.which(case.needs) is None:
        pytest.skip(f"needs {case.needs}, which is not installed here")
    may_choose_ids = os.geteuid() == 0
    if case.has_threads and not may_choose_ids:
        pytest.skip("its threads come back under the ids that they had, which an ordinary user may not choose")
    three_lives(case, prepared, keep_pid=may_choose_ids)


AS_USER = [replace(case, argv=("/usr/bin/python3", *case.argv[1:])) for case in PLAIN if case.name.startswith("cpython")] + [
    case for case in PLAIN if case.name in ("bc", "lua", "sqlite3", "xz")
]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", AS_USER, ids=str)
@pytest.mark.root
@pytest.mark.slow
def test_an_ordinary_user_brings_programs_back_under_a_new_pid(case: Case) -> None:
    if shutil.which(case.needs) is None:
        pytest.skip(f"needs {case.needs}, which is not installed here")
    with tempfile.TemporaryDirectory() as place:
        os.chown(place, NOBODY, NOBODY)
        assert as_nobody(lambda: three_lives(case, functools.partial(lay_out, Path(place)), keep_pid=False)) == "the same"


def three_lives(case: Case, prepared: Callable[[Case, str], Path], *, keep_pid: bool = True) -> str:
    """Run a program twice, once undisturbed and once with three deaths: what it leaves must be the same.

    A program that ended before the test could capture it, on a busy machine, is begun again, and captured earlier.
    """
    undisturbed = prepared(case, "undisturbed")
    expected, status = run_to_the_end(case, undisturbed)
    for attempt in itertools.count(1):
        disturbed = prepared(case, f"disturbed-{attempt}")
        try:
            ended_with = disturbed_life(case, disturbed, expected, ROUNDS + 4 * attempt, keep_pid=keep_pid)
        except (ProcessGoneError, ProbeError):
            if attempt == ATTEMPTS or left_by(case, disturbed) != left_by(case, undisturbed):
                raise
            continue
        assert ended_with == status
        break
    for name, content in left_by(case, undisturbed).items():
        assert (disturbed / name).read_bytes() == content, f"{name} differs"
    return "the same"


def left_by(case: Case, directory: Path) -> dict[str, bytes]:
    """What a program has left so far."""
    return {name: path.read_bytes() for name in ("out", *case.results) if (path := directory / name).exists()}


def disturbed_life(case: Case, disturbed: Path, expected: dict[str, int], parts: int, *, keep_pid: bool) -> int:
    """Run a program with three deaths; its exit code.

    Args:
        expected: the sizes of the files that it leaves.
        parts: it dies after each of the first parts of its work, of so many.

    Raises:
        ProcessGoneError, ProbeError: it had ended before it could be captured.
    """
    program = start(case.argv, disturbed, env=environment_of(case))
    size = 0
    for round_number in range(1, ROUNDS + 1):
        with ended(program):
            least = expected[case.progress] * round_number // parts
            size = wait_until_grown(program, disturbed / case.progress, least, size)
            snapshot = captured_between_locks(program, hold=case.in_place)
        program = restored(snapshot, disturbed, keep_pid=keep_pid)
        assert (program.pid == snapshot.process.pid) == keep_pid
    with ended(program):
        status = program.finish()
        assert status == 0, program.complaints
        return status


def environment_of(case: Case) -> dict[str, str]:
    """What a program finds in its environment."""
    return ENVIRONMENT | dict(case.environment)


def run_to_the_end(case: Case, directory: Path) -> tuple[dict[str, int], int]:
    """Run a program undisturbed: the sizes of what it leaves, and its exit code."""
    program = start(case.argv, directory, env=environment_of(case))
    with ended(program):
        status = program.finish()
    assert status == 0, program.complaints
    return {name: (directory / name).stat().st_size for name in ("out", *case.results)}, status


def wait_until_grown(program: Program, file: Path, size: int, least: int) -> int:
    """Wait until a file has reached a size and is longer than it was at the round before: its size."""
    deadline = time.monotonic() + PATIENCE_S
    while not file.exists() or file.stat().st_size <= max(size, least):
        if program.poll() is not None:
            raise ProcessGoneError(f"ended with {program.status}: {program.complaints}")
        assert time.monotonic() < deadline, f"{file} does not grow"
        time.sleep(0.002)
    return file.stat().st_size


def captured_between_locks(program: Program, *, hold: bool) -> Snapshot:
    """A base, and the program killed; one that holds a file lock for a moment is asked again."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            with protected(program) as session:
                snapshot = transported(captured_at_last(session, CaptureOrder(hold=hold)))
                program.kill()
                return snapshot
        except UnsupportedError as error:
            if "lock" not in str(error) or time.monotonic() > deadline:
                raise
