"""Programs that nobody prepared, captured, killed and brought back three times in a row: they compute what they would have."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.errors import UnsupportedError
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import Program, ended, protected, restored, start, transported

ROUNDS = 3
PATIENCE_S = 60.0
ENVIRONMENT = {"PATH": os.environ["PATH"], "LANG": "C", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HOME": "/tmp"}


@dataclass(frozen=True)
class Case:
    """One program.

    Attributes:
        argv: its words; relative file names lie in its working directory.
        files: what stands there before it starts.
        results: files that it leaves, besides its output.
        progress: the file whose growth shows how far it is.
        in_place: it writes into the middle of files, so it must not run on between capture and kill.
    """

    name: str
    argv: tuple[str, ...]
    files: tuple[tuple[str, str], ...] = ()
    results: tuple[str, ...] = ()
    progress: str = "out"
    in_place: bool = False

    def __str__(self) -> str:
        return self.name

    @property
    def needs(self) -> str:
        """The command that must be installed."""
        return self.argv[0]


PYTHON = """
import random, time
random.seed(7)
table = {}
for i in range(600):
    table[i] = random.random()
    print(i, sum(table.values()), flush=True)
    time.sleep(0.004)
"""
NUMPY = """
import time
import numpy as np
a = np.random.default_rng(7).random((120, 120))
for i in range(400):
    a = a @ a.T / 40 + np.sin(a)
    a /= np.abs(a).max()
    print(i, repr(float(a.sum())), flush=True)
    time.sleep(0.004)
"""
BC = "scale=300\nfor (i = 1; i < 360; i++) { a(1/i) }\nquit\n"
PERL = """
$| = 1; srand(7);
for my $i (1..600) {
    $h{$i} = rand(); my $s = 0; $s += $h{$_} for 1..$i;
    printf "%d %.6f\\n", $i, $s; select(undef, undef, undef, 0.004)
}
"""
GAWK = """BEGIN {
    srand(7)
    for (i = 0; i < 600; i++) { a[i] = rand(); s = 0; for (k = 0; k < 4000; k++) s += sin(k * a[i]); print i, s; fflush() }
}"""
LUA = """
local t = {}
for i = 1, 900 do
    t[#t + 1] = math.sin(i)
    local s = 0
    for k = 1, #t do for j = 1, 40 do s = s + t[k] * j end end
    print(i, s) io.flush()
end
"""
COUNTED = "(with recursive c(n) as (select 1 union all select n + 1 from c limit {}) select n from c)"
SQL = "create table t(i integer primary key, x text);\n" + "".join(
    f"insert into t select {i}, group_concat(n) from {COUNTED.format(60)};\n"
    f"select {i}, count(*), sum(length(x)) from t;\n"
    f"select sum(n) from {COUNTED.format(40000)};\n"
    for i in range(120)
)
OCTAVE = "x=ones(40); for i=1:300, x=x*x'; x=x/norm(x); printf('%d %.10g\\n', i, sum(x(:))); fflush(stdout); pause(0.004); end"

CASES = [
    Case("bc", ("bc", "-ql", "script.bc"), (("script.bc", BC),)),
    Case("cpython", (sys.executable, "script.py"), (("script.py", PYTHON),)),
    Case("numpy", (sys.executable, "script.py"), (("script.py", NUMPY),)),
    Case("perl", ("perl", "-e", PERL)),
    Case("gawk", ("gawk", GAWK)),
    Case("lua", ("lua", "-e", LUA)),
    Case("sqlite3", ("sqlite3", "t.db", ".read script.sql"), (("script.sql", SQL),), ("t.db",), in_place=True),
    Case("xz", ("xz", "-k", "-6", "-T1", "text"), (("text", "text"),), ("text.xz",), progress="text.xz"),
    pytest.param(
        Case("octave", ("octave-cli", "-q", "--no-init-file", "--no-history", "--eval", OCTAVE)),
        marks=pytest.mark.xfail(
            reason="refused: it has a thread that waits for signals, and threads are not kept yet", strict=True
        ),
    ),
]


@pytest.fixture
def prepared(tmp_path: Path) -> Callable[[Case, str], Path]:
    """A directory with a program's files in it."""

    def prepare(case: Case, name: str) -> Path:
        directory = tmp_path / name
        directory.mkdir()
        for file, content in case.files:
            (directory / file).write_text(content if file != "text" else some_text())
        return directory

    return prepare


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
    if case.needs != sys.executable and not _is_installed(case.needs):
        pytest.skip(f"needs {case.needs}, which is not installed here")
    undisturbed = prepared(case, "undisturbed")
    expected, status = run_to_the_end(case, undisturbed)
    disturbed = prepared(case, "disturbed")
    program = start(case.argv, disturbed, env=ENVIRONMENT)
    size = 0
    for round_number in range(1, ROUNDS + 1):
        with ended(program):
            size = wait_until_grown(
                program, disturbed / case.progress, expected[case.progress] * round_number // (ROUNDS + 4), size
            )
            snapshot = captured_between_locks(program, hold=case.in_place)
        program = restored(snapshot, disturbed)
    with ended(program):
        assert program.finish() == status, program.complaints
    for name in ("out", *case.results):
        assert (disturbed / name).read_bytes() == (undisturbed / name).read_bytes(), f"{name} differs"


def run_to_the_end(case: Case, directory: Path) -> tuple[dict[str, int], int]:
    """Run a program undisturbed: the sizes of what it leaves, and its exit code."""
    program = start(case.argv, directory, env=ENVIRONMENT)
    with ended(program):
        status = program.finish()
    assert status == 0, program.complaints
    return {name: (directory / name).stat().st_size for name in ("out", *case.results)}, status


def wait_until_grown(program: Program, file: Path, size: int, least: int) -> int:
    """Wait until a file has reached a size and is longer than it was at the round before: its size."""
    deadline = time.monotonic() + PATIENCE_S
    while not file.exists() or file.stat().st_size <= max(size, least):
        assert program.poll() is None, f"ended with {program.status}: {program.complaints}"
        assert time.monotonic() < deadline, f"{file} does not grow"
        time.sleep(0.002)
    return file.stat().st_size


def captured_between_locks(program: Program, *, hold: bool) -> Snapshot:
    """A base, and the program killed; one that holds a file lock for a moment is asked again."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            with protected(program) as session:
                snapshot = transported(session.capture(CaptureOrder(hold=hold)))
                program.kill()
                return snapshot
        except UnsupportedError as error:
            if "lock" not in str(error) or time.monotonic() > deadline:
                raise


def _is_installed(command: str) -> bool:
    return subprocess.run(["/bin/sh", "-c", f"command -v {command}"], capture_output=True, check=False).returncode == 0
