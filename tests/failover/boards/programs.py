"""Programs that use a board: Python in processes of their own, told what to do and answering line by line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[3]
BEGIN = """
import os, sys, time
import failover
from failover import Item
board = failover.board()
def say(*words): print(*words, flush=True)
def hear(): return sys.stdin.readline().strip()
"""


class Program:
    """One of them. ``hear`` waits for its next line; ``tell`` gives it one."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.pid = process.pid

    def hear(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"program {self.pid} ended: {self.process.wait()}"
        return line.strip()

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def program(text: str, before: Sequence[str] = ()) -> Iterator[Program]:
    """Run a text after `BEGIN`, by a command that stands before it; killed at the end if it has not ended."""
    process = subprocess.Popen(
        [*before, sys.executable, "-c", BEGIN + text],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ.copy(),
    )
    running = Program(process)
    try:
        yield running
    finally:
        running.kill()
        assert process.stdin is not None and process.stdout is not None
        process.stdin.close()
        process.stdout.close()
