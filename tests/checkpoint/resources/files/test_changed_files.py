"""Files that changed between a capture and its restore: cut back where that is right, else refused by name."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.errors import MismatchError
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import captured_and_killed, ended, expect_ok, restored, start_tracee

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


def _snapshot(compiled: Compiled, directory: Path, kind: str) -> Snapshot:
    with ended(start_tracee(compiled("files", "-O2"), directory, kind)) as tracee:
        return captured_and_killed(tracee)


def _expect_ok(snapshot: Snapshot, directory: Path, accept_changed: tuple[str, ...] = ()) -> None:
    with ended(restored(snapshot, directory, accept_changed=accept_changed)) as back:
        back.tell()
        expect_ok(back)


def _expect_refusal(snapshot: Snapshot, directory: Path, path: Path, culprit: str = "") -> None:
    """Refused, by the file's whole name (and who holds it), before anything was touched."""
    before = {entry.name: entry.read_bytes() for entry in directory.iterdir() if entry.is_file()}
    with pytest.raises(MismatchError) as refusal:
        restored(snapshot, directory).kill()
    assert any(str(path) in reason and culprit in reason for reason in refusal.value.reasons), refusal.value.reasons
    assert {entry.name: entry.read_bytes() for entry in directory.iterdir() if entry.is_file()} == before


def test_a_log_that_grew_after_the_capture_is_cut_back(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "append")
    with (tmp_path / "log").open("a") as log:
        log.write("lines of a life that never was\n" * 1000)
    _expect_ok(snapshot, tmp_path)


def test_a_file_that_the_program_wrote_by_its_memory_alone_is_as_it_was(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "mapped_and_closed")
    with (tmp_path / "counters").open("r+b") as counters:
        counters.write(b"counts of a life that never was")
    _expect_ok(snapshot, tmp_path)


def test_a_log_that_shrank_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "append")
    os.truncate(tmp_path / "log", 5)
    _expect_refusal(snapshot, tmp_path, tmp_path / "log")


def test_a_file_that_is_missing_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    (tmp_path / "in").unlink()
    _expect_refusal(snapshot, tmp_path, tmp_path / "in", "bring it here")


def test_a_file_that_the_program_writes_and_that_is_missing_is_to_be_carried(compiled: Compiled, tmp_path: Path) -> None:
    """On another robot it always is, and while the program runs no copy would do for long."""
    snapshot = _snapshot(compiled, tmp_path, "append")
    (tmp_path / "log").unlink()
    _expect_refusal(snapshot, tmp_path, tmp_path / "log", "--carry")


def test_a_file_that_became_a_directory_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    (tmp_path / "in").unlink()
    (tmp_path / "in").mkdir()
    _expect_refusal(snapshot, tmp_path, tmp_path / "in")


def test_other_content_of_the_same_size_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    content = (tmp_path / "in").read_bytes()
    (tmp_path / "in").write_bytes(content[::-1])
    _expect_refusal(snapshot, tmp_path, tmp_path / "in")


def test_other_content_of_the_same_size_and_time_in_a_new_file_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    """As a copy from another machine may be: only the content tells."""
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    path, about = tmp_path / "in", (tmp_path / "in").stat()
    (tmp_path / "other").write_bytes(path.read_bytes()[::-1])
    os.utime(tmp_path / "other", ns=(about.st_atime_ns, about.st_mtime_ns))
    (tmp_path / "other").rename(path)
    _expect_refusal(snapshot, tmp_path, path)


def test_the_same_content_in_another_file_will_do(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    shutil.copyfile(tmp_path / "in", tmp_path / "copy")
    (tmp_path / "copy").rename(tmp_path / "in")
    _expect_ok(snapshot, tmp_path)


def test_a_file_that_was_written_in_its_middle_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "write_offset")
    path = next(Path(str(one.facts["path"])) for one in snapshot.resources if _is_offset_three(one.facts))
    with path.open("r+b") as file:
        file.seek(1)
        file.write(b"!")
    _expect_refusal(snapshot, tmp_path, path)


def test_a_file_that_another_program_writes_to_is_refused_until_it_stops(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "append")
    with subprocess.Popen(["sleep", "1000"], stdout=(tmp_path / "log").open("ab")) as writer:
        try:
            _expect_refusal(snapshot, tmp_path, tmp_path / "log", f"pid {writer.pid} (sleep)")
        finally:
            writer.kill()
    _expect_ok(snapshot, tmp_path)


def test_a_file_that_another_program_reads_is_no_hindrance(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "append")
    with subprocess.Popen(["sleep", "1000"], stdin=(tmp_path / "log").open("rb")) as reader:
        try:
            _expect_ok(snapshot, tmp_path)
        finally:
            reader.kill()


def _is_offset_three(facts: object) -> bool:
    return isinstance(facts, dict) and facts.get("offset") == 3


def test_a_changed_file_can_be_accepted_by_name(compiled: Compiled, tmp_path: Path) -> None:
    snapshot = _snapshot(compiled, tmp_path, "read_offset")
    path = tmp_path / "in"
    path.write_bytes(path.read_bytes() + b"more")
    _expect_refusal(snapshot, tmp_path, path)
    _expect_ok(snapshot, tmp_path, accept_changed=(str(path),))


def test_a_rebuilt_program_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    program = tmp_path / "program"
    shutil.copy(compiled("heap", "-O2"), program)
    with ended(start_tracee(program, tmp_path)) as tracee:
        snapshot = captured_and_killed(tracee)
    program.unlink()
    shutil.copy(compiled("heap", "-O1"), program)
    _expect_refusal(snapshot, tmp_path, program)
    program.unlink()
    _expect_refusal(snapshot, tmp_path, program)


def test_a_working_directory_that_is_missing_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("portrait", "-O2"), tmp_path, "directory")) as tracee:
        snapshot = captured_and_killed(tracee)
    (tmp_path / "a directory").rmdir()
    _expect_refusal(snapshot, tmp_path, tmp_path / "a directory")
