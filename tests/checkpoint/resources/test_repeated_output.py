"""Output that comes twice after a takeover is told beforehand, with the cure: what others read, and files that do not travel."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Terms
from tests.checkpoint.round_trip import ENGINE, at_last, captured_at_last, ended, start

pytestmark = [pytest.mark.root]

WRITES = """
import os, sys, time
files = [os.open(name, int(flags) | os.O_CREAT) for name, flags in zip(sys.argv[1::2], sys.argv[2::2])]
for file in files:
    os.write(file, b"line")
print("ready", file=sys.stderr, flush=True)
time.sleep(1000)
"""
APPENDS, WRITES_ON, CHANGES = os.O_WRONLY | os.O_APPEND, os.O_WRONLY, os.O_RDWR


@contextlib.contextmanager
def read_by_cat(how: str, numbers: tuple[str, ...], directory: Path) -> Iterator[tuple[int, int]]:
    """A program whose output another process reads: the pids of both."""
    ours, theirs = socket.socketpair() if how == "socket" else map(os.fdopen, os.pipe(), ("rb", "wb"))
    with (directory / "read").open("wb") as read, (directory / "err").open("wb") as err:
        cat = subprocess.Popen(["cat"], stdin=ours, stdout=read)
        streams = {name: theirs if name in numbers else err for name in ("stdout", "stderr")}
        program = subprocess.Popen([sys.executable, "-c", WRITES], cwd=directory, stdin=subprocess.DEVNULL, **streams)  # type: ignore[call-overload]
    ours.close()
    theirs.close()
    try:
        yield program.pid, cat.pid
    finally:
        for one in (program, cat):
            one.kill()
            one.wait()


@pytest.mark.parametrize("how", ["pipe", "socket"])
@pytest.mark.parametrize(
    ("numbers", "named"), [(("stdout",), "output is"), (("stdout", "stderr"), "output and standard error are")]
)
def test_output_that_another_process_reads_is_told_with_the_cure(
    how: str, numbers: tuple[str, ...], named: str, tmp_path: Path
) -> None:
    with read_by_cat(how, numbers, tmp_path) as (pid, cat):
        notes = [note for note in ENGINE.probe(pid).notes if " read by " in note]
    assert len(notes) == 1 and "come twice" in notes[0] and f"its standard {named} read by pid {cat} (cat)" in notes[0], notes
    assert "failover run" in notes[0]


def test_files_that_it_appends_to_are_told_with_the_cure(tmp_path: Path) -> None:
    files = [("appended", APPENDS), ("from_its_begin", WRITES_ON), ("database", CHANGES)]
    words = [word for name, flags in files for word in (tmp_path / name, str(flags))]
    with ended(start([sys.executable, "-c", WRITES, *words], tmp_path)) as program:
        program.wait_until(lambda: "ready" in program.complaints, "its files")
        notes = [note for note in ENGINE.probe(program.pid).notes if "come twice" in note]
        assert len(notes) == 1 and f"--carry {tmp_path}/" in notes[0], notes
        told = notes[0].partition(", which")[0]
        assert {name for name in ("appended", "from_its_begin", "database") if f"/{name}" in told} <= {
            "appended",
            "from_its_begin",
        }
        assert "and 2 more" in told  # with its two standard streams

        def noted(terms: Terms, names: dict[str, str] | None = None) -> list[str]:
            order = ProtectOrder("/test/writes", terms=terms, names={} if names is None else names)
            with contextlib.closing(at_last(lambda: ENGINE.protect(program.pid, order))) as session:
                return [note for note in captured_at_last(session, CaptureOrder()).notes if "come twice" in note]

        assert noted(Terms()) == notes
        (left,) = noted(Terms(Carry((str(tmp_path / "appended"), str(tmp_path / "from_its_begin")))))
        assert "/out" in left and "appended" not in left
        assert noted(Terms(Carry((str(tmp_path),)))) == []


def test_what_is_captured_once_and_for_all_repeats_nothing(tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", WRITES, tmp_path / "appended", str(APPENDS)], tmp_path)) as program:
        program.wait_until(lambda: "ready" in program.complaints, "its files")
        with contextlib.closing(at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/pid")))) as session:
            notes = (*session.notes, *captured_at_last(session, CaptureOrder(hold=True)).notes)
            assert not [note for note in notes if "come twice" in note], notes
