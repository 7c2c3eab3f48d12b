"""A file that several programs write to: detected while all of them run, refused by a restore, or declared shared."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, RestoreOptions, Terms, contradiction
from checkpoint.errors import MismatchError
from checkpoint.linux.procfs import descendants
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    at_last,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    restored,
    start,
    transported,
)

pytestmark = pytest.mark.root

WRITER = """
import mmap, os, sys, time
how, path = sys.argv[1:]
file = os.open(path, os.O_RDWR)
os.lseek(file, 8, os.SEEK_SET)
view = mmap.mmap(file, 4096) if how == "mapped" else None
if how == "forked" and not os.fork():
    time.sleep(600)
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
print(os.lseek(file, 0, os.SEEK_CUR), os.read(file, 5), view[:5] if view else b"", flush=True)
"""
WHOLE = b"begin   after" + bytes(4096 - 13)


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "telemetry.db"
    path.write_bytes(WHOLE)
    return path


@contextmanager
def another_writer(path: Path) -> Iterator[int]:
    """A process that is none of ours and holds the file open for writing."""
    hold = "import sys, time; held = open(sys.argv[1], 'r+b'); print(flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", hold, path], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            yield other.pid
        finally:
            other.kill()


def writing(how: str, database: Path) -> Program:
    program = start([sys.executable, "-c", WRITER, how, database], database.parent, isolate=how == "forked")
    program.wait_for_line("ready")
    return program


def of_another_machine(state: Snapshot) -> Snapshot:
    return replace(state, machine=replace(state.machine, boot_id="another"))


def test_a_restore_beside_another_writer_is_refused_and_says_what_to_give(database: Path) -> None:
    with ended(writing("open", database)) as program:
        base = captured_and_killed(program)
    with another_writer(database) as pid, pytest.raises(MismatchError, match=f"writing by pid {pid} .*--shared {database}"):
        restored(base, database.parent)


@pytest.mark.parametrize("rule", ["file", "folder"])
@pytest.mark.parametrize("how", ["open", "mapped"])
def test_a_shared_file_keeps_its_content_and_the_offset_is_set(how: str, rule: str, database: Path) -> None:
    with ended(writing(how, database)) as program:
        base = captured_and_killed(program)
    with another_writer(database):
        database.write_bytes(b"other   words" + bytes(9000))
        with ended(restored(base, database.parent, shared=(str(database if rule == "file" else database.parent),))) as back:
            back.tell()
            assert back.finish() == 0
        assert back.output.splitlines()[-1] == f"8 {b'words'} {b'other' if how == 'mapped' else b''}"
        assert database.stat().st_size == 9013


def test_a_shared_file_that_is_missing_is_told_beforehand(database: Path) -> None:
    with ended(writing("open", database)) as program:
        base = captured_and_killed(program)
    database.unlink()
    options = RestoreOptions(terms=Terms(shared=(str(database),)))
    (lack,) = ENGINE.lacks(of_another_machine(base), options)
    assert lack.startswith(f"{database}, open as fd 3 and shared, cannot be used")


def test_a_standby_finds_who_writes_to_the_file_there(database: Path) -> None:
    with ended(writing("open", database)) as program:
        base = of_another_machine(captured_and_killed(program))
    assert not ENGINE.lacks(base, RestoreOptions())
    with another_writer(database) as pid:
        (lack,) = ENGINE.lacks(base, RestoreOptions())
        assert f"{database}, open as fd 3, is held open for writing by pid {pid} " in lack
        assert not ENGINE.lacks(base, RestoreOptions(terms=Terms(shared=(str(database.parent),))))


def test_the_program_itself_is_not_in_its_own_way_where_robots_share_a_machine(database: Path) -> None:
    with ended(writing("open", database)) as program:
        assert not ENGINE.lacks(captured(program), RestoreOptions())
        with another_writer(database) as pid:
            assert f"pid {pid} " in "".join(ENGINE.lacks(captured(program), RestoreOptions()))


def test_who_else_writes_is_known_while_the_program_runs(database: Path) -> None:
    with ended(writing("forked", database)) as program:
        base, pid = captured(program), program.pid
        assert descendants.component(pid), "it has a child, which holds the file too"
        assert not ENGINE.contested(base, RestoreOptions(), pid, {"/lab/first": pid})
        with another_writer(database) as other:
            (found,) = ENGINE.contested(base, RestoreOptions(), pid, {"/lab/first": pid, "/lab/second": other})
            assert f"by pid {other} (python" in found and "), of component /lab/second: end that first" in found
            assert found.endswith(f"accept it as shared: --shared {database}")
            shared = RestoreOptions(terms=Terms(shared=(str(database),)))
            assert not ENGINE.contested(base, shared, pid, {})


def test_a_carried_file_that_another_writes_to_is_told_beforehand_too(database: Path) -> None:
    terms = Terms(carry=Carry(paths=(str(database),)))
    with ended(writing("open", database)) as program:
        session = at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/test/carries", terms=terms)))
        try:
            base = transported(captured_at_last(session, CaptureOrder()))
        finally:
            session.close()
        assert not ENGINE.contested(base, RestoreOptions(), program.pid, {})
        assert not ENGINE.lacks(base, RestoreOptions())
        with another_writer(database) as pid:
            (found,) = ENGINE.contested(base, RestoreOptions(), program.pid, {"/lab/second": pid})
            assert f"{database}, which the program carries, is held open for writing by pid {pid} (python" in found
            assert "of component /lab/second" in found
            program.kill()
            (lack,) = ENGINE.lacks(base, RestoreOptions())
            with pytest.raises(MismatchError) as refused:
                restored(base, database.parent)
            assert (lack,) == refused.value.reasons


@pytest.mark.parametrize(
    ("carry", "shared", "is_both"),
    [("/a", "/a", True), ("/a/b", "/a", True), ("/a", "/a/b", True), ("/a", "/ab", False), ("/ab", "/a", False)],
)
def test_what_is_carried_cannot_be_shared(carry: str, shared: str, is_both: bool) -> None:
    assert bool(contradiction((carry,), (shared,))) is is_both
