"""A file with two names, one of which is gone, comes back as one file: the inode counts.

sem_open(3) links a temporary name to the real one and unlinks the temporary: the mapping in the process that made a semaphore
looks deleted, that in every other process does not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from checkpoint.model import Snapshot
from tests.checkpoint.engines.ptrace.capture.test_trees import captured_and_ended, grown_by, three_lives
from tests.checkpoint.linux.spawn.test_ids import let_nobody_in
from tests.checkpoint.round_trip import Program, as_nobody, ended, expect_ok, restored, start, start_tracee

pytestmark = pytest.mark.root

Compiled = Callable[..., Path]
MEMORY = Path("/dev/shm")


@pytest.fixture
def memory() -> Iterator[Path]:
    """A directory of shared memory."""
    place = MEMORY / f"failover-{uuid4().hex}"
    place.mkdir()
    yield place
    for left in place.iterdir():
        left.unlink()
    place.rmdir()


def told_and_ok(tracee: Program) -> None:
    with ended(tracee):
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.compiler
def test_a_semaphore_is_one_for_who_made_it_and_for_who_opened_it(compiled: Compiled, tmp_path: Path) -> None:
    name = f"/failover-{uuid4().hex}"
    program = compiled("two_names", "-O2", "-pthread")
    try:
        tracee, taken = three_lives(
            start_tracee(program, tmp_path, "semaphore", "semaphore", "", name, isolate=True), lambda _: True
        )
        told_and_ok(tracee)
    finally:
        (MEMORY / f"sem.{name[1:]}").unlink(missing_ok=True)
    assert paths_of(taken[0], "sem.") == {str(MEMORY / f"sem.{name[1:]}")}


def paths_of(state: Snapshot, part: str) -> set[str]:
    """Of files that are mapped by any process, as far as they are called so."""
    files = (vma.file for one in state.processes for vma in one.vmas if vma.file is not None)
    return {file.path for file in files if part in file.path or file.deleted}


@pytest.mark.compiler
def test_a_semaphore_is_made_where_it_is_missing(compiled: Compiled, tmp_path: Path) -> None:
    name = f"/failover-{uuid4().hex}"
    place = MEMORY / f"sem.{name[1:]}"
    tracee = start_tracee(compiled("two_names", "-O2", "-pthread"), tmp_path, "semaphore", "semaphore", "", name, isolate=True)
    with ended(tracee):
        base = captured_and_ended(tracee)
    place.unlink()
    back = restored(base, tmp_path)
    try:
        told_and_ok(back)
        assert place.exists()
    finally:
        place.unlink(missing_ok=True)


HELD = [("map", "map"), ("map", "open"), ("open", "map"), ("open", "open"), ("lock", "lock")]


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.parametrize(("mine", "theirs"), HELD)
@pytest.mark.parametrize("where", ["memory", "disk", "far"])
def test_a_file_under_two_names_is_one(
    where: str, mine: str, theirs: str, compiled: Compiled, memory: Path, tmp_path: Path
) -> None:
    lost, kept = places(where, memory, tmp_path)
    program = compiled("two_names", "-O2", "-pthread")
    tracee, _ = three_lives(start_tracee(program, tmp_path, mine, theirs, str(lost), str(kept), isolate=True), lambda _: True)
    told_and_ok(tracee)


def places(where: str, memory: Path, directory: Path) -> tuple[Path, Path]:
    """The name that goes, and the one that stays."""
    if where == "far":  # from the one nobody finds the other who does not ask the other process
        for name in ("one/a/b/c/d", "other/a/b"):
            (directory / name).mkdir(parents=True)
        return directory / "one/a/b/c/d/lost", directory / "other/a/b/kept"
    place = memory if where == "memory" else directory
    return place / "lost", place / "kept"


@pytest.mark.compiler
@pytest.mark.parametrize("mine", ["map", "open", "read"])
@pytest.mark.parametrize("where", ["memory", "disk"])
def test_one_process_has_the_file_of_the_name_that_is_left(
    where: str, mine: str, compiled: Compiled, memory: Path, tmp_path: Path
) -> None:
    lost, kept = places(where, memory, tmp_path)
    tracee = start_tracee(compiled("two_names", "-O2", "-pthread"), tmp_path, mine, "nobody", str(lost), str(kept), isolate=True)
    for _ in range(2):
        with ended(tracee):
            base = captured_and_ended(tracee)
        tracee = restored(base, tmp_path)
    told_and_ok(tracee)


@pytest.mark.compiler
def test_an_ordinary_user_has_one_semaphore_too(compiled: Compiled, tmp_path: Path) -> None:
    """The kernel shows files that are mapped to root alone."""
    name = f"/failover-{uuid4().hex}"
    program = compiled("two_names", "-O2", "-pthread")
    let_nobody_in(tmp_path, program)

    def act() -> str:
        tracee, _ = three_lives(start_tracee(program, tmp_path, "semaphore", "semaphore", "", name, isolate=True), lambda _: True)
        told_and_ok(tracee)
        return "ok"

    try:
        assert as_nobody(act) == "ok"
    finally:
        (MEMORY / f"sem.{name[1:]}").unlink(missing_ok=True)


SPAWNED = """
import multiprocessing, os, time

def square(number):
    return number * number

if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        number = 0
        while not os.path.exists("go"):
            print(number, *pool.map(square, range(number, number + 5)), flush=True)
            number += 1
            time.sleep(0.005)
    print("ok", flush=True)
"""


def test_a_pool_of_spawned_processes_works_on(tmp_path: Path) -> None:
    (tmp_path / "pool.py").write_text(SPAWNED)
    program, taken = three_lives(start([sys.executable, "pool.py"], tmp_path, isolate=True), grown_by(10))
    with ended(program):
        goes_on = grown_by(program.output.count("\n") + 10)
        program.wait_until(lambda: goes_on(program), "that it goes on")
        program.tell()
        assert (program.finish(), program.output.splitlines()[-1]) == (0, "ok"), program.output[-500:] + program.complaints
    assert len(taken[0].members) >= 2
