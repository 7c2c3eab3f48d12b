"""Pseudo-terminals of a program's own: three restores in a row, then it checks what it has."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from checkpoint.engine import ProtectOrder, RestoreOptions
from checkpoint.errors import UnsupportedError
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import (
    ENGINE,
    LIVES,
    PATIENCE_S,
    Program,
    captured,
    captured_and_killed,
    ended,
    expect_ok,
    expect_three_lives,
    restored,
    start,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

CASES = ["plain", "settings", "modes", "several", "controlling", "alone", "hung_up"]


@pytest.mark.parametrize("case", CASES)
def test_a_terminal_of_which_a_program_has_both_ends_comes_back(case: str, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("terminals", "-O2", "-lutil"), tmp_path, case)
    expect_three_lives(tracee, tmp_path)


def test_a_terminal_of_an_isolated_program_keeps_its_number_whatever_others_have_open(compiled: Compiled, tmp_path: Path) -> None:
    ours = pty.openpty()
    try:
        tracee = start([compiled("terminals", "-O2", "-lutil"), "go", "named"], tmp_path, isolate=True)
        tracee.wait_for_line("ready")
        for _ in range(LIVES):
            with ended(tracee):
                snapshot = captured_and_killed(tracee)
                assert [held.facts["terminal"] for held in snapshot.resources if held.kind == "terminals"] == [1, 1]
            tracee = restored(snapshot, tmp_path, isolate=True)
        with ended(tracee):
            tracee.tell()
            expect_ok(tracee)
    finally:
        for descriptor in ours:
            os.close(descriptor)


def test_a_terminal_whose_number_is_taken_gets_another_which_is_said(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("terminals", "-O2", "-lutil"), tmp_path, "alone")
    with ended(tracee):
        number = next(held.facts["terminal"] for held in captured(tracee).resources if held.kind == "terminals")
        snapshot = captured_and_killed(tracee)
    taken: list[tuple[int, int]] = []
    try:
        while not Path(f"/dev/pts/{number}").exists():  # by us, or by anybody
            taken.append(pty.openpty())
        born = spawn_vessel(Birth(inner_pid=snapshot.process.pid))
        try:
            notes = ENGINE.restore(born.pid, snapshot, RestoreOptions()).notes
        finally:
            discard(born)
        assert any(f"/dev/pts/{number}" in note and "another number" in note for note in notes), notes
    finally:
        for ends in taken:
            for descriptor in ends:
                os.close(descriptor)


def test_a_terminal_in_which_something_waits_is_refused_until_it_is_read(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("terminals", "-O2", "-lutil"), tmp_path, "unread")) as tracee:
        with pytest.raises(UnsupportedError, match="with 6 bytes that wait"):
            ENGINE.protect(tracee.pid, ProtectOrder("/test/unread"))
        tracee.tell()
        expect_ok(tracee)


TERMINAL_OF_A_CHILD = """
import os, pty, sys, time
child, master = pty.fork()
if not child:
    print("here", flush=True)
    for line in sys.stdin:
        with open("/dev/tty", "w") as own:
            print(line.strip().upper(), os.ttyname(0) == os.ttyname(1), os.tcgetpgrp(0) == os.getpgrp(), os.isatty(2), file=own)
    os._exit(0)
def read_line():
    found = b""
    while not found.endswith(b"\\n"):
        found += os.read(master, 1000)
    return found
read_line()
count = 0
while not os.path.exists("go"):
    os.write(master, b"line %d\\n" % count)
    echo = read_line()
    answer = read_line() if echo.count(b"\\n") == 1 else b""
    print((echo + answer).decode().split(), flush=True)
    count += 1
    time.sleep(0.01)
os.close(master)
print("child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_child_at_a_terminal_of_its_parent_goes_on_at_it(tmp_path: Path) -> None:
    words = [sys.executable, "-c", TERMINAL_OF_A_CHILD]
    program = start(words, tmp_path, isolate=True)
    for round_number in range(LIVES):
        with ended(program):
            program.wait_for_output(3000 * (round_number + 1))
            snapshot = captured_between_answers(program)
        program = restored(snapshot, tmp_path)
    with ended(program):
        program.wait_for_output(3000 * (LIVES + 1))
        program.tell()
        assert program.finish() == 0, program.complaints
    found = [line for line in program.output.splitlines() if line.startswith("[")]
    assert found == [f"['line', '{count}', 'LINE', '{count}', 'True', 'True', 'True']" for count in range(len(found))]
    assert program.output.splitlines()[-1].startswith("child")


def captured_between_answers(program: Program) -> Snapshot:
    """A base, and the program killed; one in whose terminal something waits, or that just writes to it, is asked again."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return captured_and_killed(program)
        except UnsupportedError as error:
            is_passing = "that wait in it" in str(error) or "terminal (/dev/tty)" in str(error)
            if not is_passing or time.monotonic() > deadline:
                raise


COUNTING = "i=0; while :; do echo line $i; echo $i >> counted; i=$((i + 1)); sleep 0.01; done"


def test_a_shell_in_tmux_goes_on_and_so_does_its_screen(tmp_path: Path) -> None:
    if not (tmux := shutil.which("tmux")):
        pytest.skip("needs tmux, which is not installed here")
    at = [tmux, "-S", str(tmp_path / "socket")]
    environment = {"PATH": os.environ["PATH"], "TERM": "xterm", "HOME": str(tmp_path), "LANG": "C.UTF-8", "SHELL": "/bin/sh"}
    counted = tmp_path / "counted"
    program = start([*at, "-D", "-f", "/dev/null"], tmp_path, env=environment, isolate=True)
    seen = 0
    program.wait_until((tmp_path / "socket").exists, "its socket")
    subprocess.run([*at, "new-session", "-d", "-x", "80", "-y", "24", COUNTING], cwd=tmp_path, env=environment, check=True)
    for _ in range(LIVES):
        with ended(program):
            program.wait_until(lambda: counted.exists() and counted.stat().st_size > seen + 100, "more lines")  # noqa: B023
            snapshot = captured_between_answers(program)
        seen = counted.stat().st_size
        program = restored(snapshot, tmp_path)
    with ended(program):
        program.wait_until(lambda: counted.stat().st_size > seen + 100, "more lines")
        shown = subprocess.run([*at, "capture-pane", "-p"], capture_output=True, text=True, check=True, env=environment).stdout
    numbers = [int(line) for line in counted.read_text().split()]
    back = [after for before, after in pairwise(numbers) if after != before + 1]
    assert len(back) <= LIVES, "it went back where nobody restored it"  # what was not open is not cut back
    assert shown.count("line") > 20
    lines = [int(line.removeprefix("line ")) for line in shown.split("\n") if line]
    assert lines == list(range(lines[0], lines[0] + len(lines))), shown
