"""Programs that are measured: started, waited for until they have all their memory, and ended."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

PROGRAMS: Final = Path(__file__).parent / "programs"
PATIENCE_S: Final = 60.0
POLL_S: Final = 0.005


class BenchmarkError(Exception):
    """Something that was to be measured did not come about; says what."""


@dataclass(frozen=True, slots=True)
class Running:
    """A program that has said "ready"; ``output`` is the file that its streams go to."""

    pid: int
    output: Path

    def records(self) -> list[tuple[int, int]]:
        """The whole lines of two numbers that it has written after "ready"."""
        whole, _, _ = self.output.read_text().rpartition("\n")
        return [(int(first), int(second)) for first, second in (line.split() for line in whole.splitlines()[1:])]

    def records_until(self, instant_ns: int) -> list[tuple[int, int]]:
        """The same, once the newest line's first number, an instant on our clock, is past ``instant_ns``.

        Raises:
            BenchmarkError: it writes no more.
        """
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            found = self.records()
            if found and found[-1][0] > instant_ns:
                return found
            time.sleep(POLL_S)
        raise BenchmarkError(f"the measured program (pid {self.pid}) stands still; it said {self.output.read_text()[-200:]!r}")


@contextmanager
def running(program: str, *arguments: int, directory: Path) -> Iterator[Running]:
    """Start one of `PROGRAMS` with files as its standard streams; ended with the body.

    Raises:
        BenchmarkError: it ended before it was ready.
    """
    python = getattr(sys, "_base_executable", sys.executable)
    output = directory / f"{program}.output"
    with output.open("wb") as file:
        process = subprocess.Popen(
            [python, str(PROGRAMS / f"{program}.py"), *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
        )
    try:
        while output.stat().st_size == 0:
            if process.poll() is not None:
                raise BenchmarkError(f"{program}.py ended at once with status {process.returncode}")
            time.sleep(POLL_S)
        yield Running(process.pid, output)
    finally:
        process.kill()
        process.wait()


def wait_until_gone(pid: int) -> None:
    """Wait until a killed process that is not our child has been reaped."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(POLL_S)
    raise BenchmarkError(f"pid {pid} was killed and is still there")
