"""Carried files: what the program writes comes back as it was at the checkpoint, with the memory of the same instant."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, Carry, Session
from tests.checkpoint.round_trip import ENGINE, Program, captured_at_last, ended, restored, start, transported

COUNTER = Path(__file__).with_name("sqlite_counter.py")

SLEEPER = "import time\nprint('ready', flush=True)\nwhile True: time.sleep(0.01)\n"


@contextlib.contextmanager
def carrying(program: Program, *paths: Path, size_max: int = 1 << 28) -> Iterator[Session]:
    """Hold a program under protection whose files travel with it."""
    session = ENGINE.protect(program.pid, "/test/carried", None, Carry(tuple(map(str, paths)), size_max))
    try:
        yield session
    finally:
        session.close()


@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_a_database_and_the_memory_of_its_program_come_back_as_of_one_instant(tmp_path: Path, mode: str) -> None:
    """Killed at a moment of its own in each round, the folder lost: what was counted stands in the database, and no more."""
    folder, last = tmp_path / "kept", 600
    folder.mkdir()
    program = start([sys.executable, COUNTER, folder / "steps.db", mode, str(last)], tmp_path)
    for round_number in range(3):
        with ended(program):
            program.wait_for_line(str(100 * round_number + 20))
            with carrying(program, folder) as session:
                chain = [transported(captured_at_last(session, CaptureOrder()))]
                for sequence in range(2, 6):
                    session.acknowledge(chain[-1].position)
                    size = (tmp_path / "out").stat().st_size
                    program.wait_for_output(size + 20)
                    chain.append(transported(captured_at_last(session, CaptureOrder(base=False, sequence=sequence))))
                program.wait_for_output((tmp_path / "out").stat().st_size + 7 * round_number)
                program.kill()
        shutil.rmtree(folder)
        program = restored(chain, tmp_path)
    with ended(program):
        assert program.finish() == 0, program.output[-400:] + program.complaints
        assert program.output.splitlines()[-2:] == [str(last), "ok"]
