"""PIDs and namespaces in every combination: what a restored program knows of itself, and what is reported of the rest."""

from __future__ import annotations

import ctypes
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.engine import RestoreOptions
from checkpoint.linux.spawn.vessel import Birth, Born, discard, spawn_vessel
from tests.checkpoint.round_trip import (
    ENGINE,
    NOBODY,
    Program,
    as_nobody,
    captured_and_killed,
    ended,
    expect_ok,
    expect_three_lives,
    restored,
    start,
    start_tracee,
)

Compiled = Callable[..., Path]

CLONE_NEWUSER = 0x10000000

pytestmark = [pytest.mark.compiler, pytest.mark.root]


def round_trip(tracee: Path, directory: Path, *, isolate: bool, isolate_there: bool) -> tuple[Program, tuple[str, ...]]:
    """Start a program, end it, bring it back: that, and what was noted of its PID."""
    program = start([tracee, "go"], directory, isolate=isolate)
    with ended(program):
        program.wait_for_line("ready")
        assert program.born.isolated is isolate, program.born.notes
        snapshot = captured_and_killed(program)
    assert snapshot.process.isolated is isolate
    clocks = snapshot.clocks if isolate_there else None
    born = spawn_vessel(Birth(snapshot.process.pid, isolate_there, clocks, stdio=streams(directory)))
    try:
        assert born.isolated is isolate_there, born.notes
        ENGINE.restore(born.pid, snapshot, RestoreOptions()).resume()
    except BaseException:
        discard(born)
        raise
    return Program(born, directory), born.notes


def streams(directory: Path) -> tuple[int, int, int]:
    """Its standard streams, as `round_trip.start` gives them; ours to close when this process ends."""
    out, err = (os.open(directory / name, os.O_WRONLY | os.O_APPEND) for name in ("out", "err"))
    return os.open("/dev/null", os.O_RDONLY), out, err


@pytest.mark.parametrize(
    ("isolate", "isolate_there"),
    [(True, True), (False, True), (False, False)],  # a PID of a namespace, a small number, is always somebody's elsewhere
    ids=["from namespace to namespace", "from none to a namespace", "from none to none"],
)
def test_a_program_knows_itself_by_the_same_number(
    isolate: bool, isolate_there: bool, compiled: Compiled, tmp_path: Path
) -> None:
    tracee = compiled("knows_itself", "-O2")
    program, notes = round_trip(tracee, tmp_path, isolate=isolate, isolate_there=isolate_there)
    with ended(program):
        assert not [note for note in notes if "pid" in note.lower()], notes
        program.tell()
        expect_ok(program)


def let_nobody_in(directory: Path, tracee: Path) -> None:
    """Have an ordinary user write to a directory, and run a program."""
    os.chown(directory, NOBODY, NOBODY)
    everybodys = Path(tempfile.gettempdir())
    for place in {directory, *directory.parents, *tracee.parents}:
        if everybodys in place.parents:
            place.chmod(place.stat().st_mode | 0o711)


def test_an_ordinary_user_gets_the_same_in_a_user_namespace(compiled: Compiled, tmp_path: Path) -> None:
    tracee = compiled("knows_itself", "-O2")
    let_nobody_in(tmp_path, tracee)

    def act() -> str:
        program, _ = round_trip(tracee, tmp_path, isolate=True, isolate_there=True)
        with ended(program):
            program.tell()
            expect_ok(program)
        return "ok"

    assert as_nobody(act) == "ok"


def test_an_ordinary_user_has_each_of_its_shared_memories_to_itself_again(compiled: Compiled, tmp_path: Path) -> None:
    """The kernel shows files that are mapped to root alone: which is which is told all the same."""
    tracee = compiled("memory_objects", "-O2")
    let_nobody_in(tmp_path, tracee)

    def act() -> str:
        expect_three_lives(start_tracee(tracee, tmp_path, "posix_unlinked"), tmp_path)
        return "ok"

    assert as_nobody(act) == "ok"


@contextmanager
def somebody_with(pid: int) -> Iterator[Born]:
    """A process that has this PID."""
    born = spawn_vessel(Birth(pid))
    try:
        assert born.pid == pid
        yield born
    finally:
        discard(born)


def test_a_program_whose_number_is_taken_gets_another_and_that_is_noted(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start([compiled("knows_itself", "-O2"), "go", "other"], tmp_path)) as program:
        program.wait_for_line("ready")
        snapshot = captured_and_killed(program)
    with somebody_with(snapshot.process.pid), ended(restored(snapshot, tmp_path)) as program:
        assert program.pid != snapshot.process.pid
        assert any(str(snapshot.process.pid) in note for note in program.born.notes), program.born.notes
        program.tell()
        expect_ok(program)


def forbid_namespaces() -> None:
    """From now on this process and its children can make no namespaces, nor choose PIDs."""
    if ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWUSER):
        pytest.skip(f"no user namespaces here: {os.strerror(ctypes.get_errno())}")
    for kind in ("pid", "time", "user"):
        Path(f"/proc/sys/user/max_{kind}_namespaces").write_text("0\n")


def test_where_namespaces_are_forbidden_a_program_gets_another_number(compiled: Compiled, tmp_path: Path) -> None:
    tracee = compiled("knows_itself", "-O2")
    let_nobody_in(tmp_path, tracee)

    def act() -> str:
        forbid_namespaces()
        program = start([tracee, "go", "other"], tmp_path, isolate=True)
        with ended(program):
            program.wait_for_line("ready")
            assert not program.born.isolated and program.born.notes
            snapshot = captured_and_killed(program)
        with ended(restored(snapshot, tmp_path)) as program:
            assert any(str(snapshot.process.pid) in note for note in program.born.notes), program.born.notes
            program.tell()
            expect_ok(program)
        return "ok"

    assert as_nobody(act) == "ok"
