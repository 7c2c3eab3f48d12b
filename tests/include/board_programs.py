"""Programs in C with a board, driven line by line; and boards that they share with this process."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.include.programs import STRICT, program

SHARED_MEMORY = Path("/dev/shm")
EMULATOR = "qemu-aarch64-static"


class Tool:
    """board_tool.c: each order is a line, each answer one too."""

    def __init__(self, place: Path, command: Sequence[str | Path], **variables: str) -> None:
        environment = {"PATH": os.environ["PATH"], "FAILOVER_BOARD": str(place), **variables}
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)

    @property
    def pid(self) -> int:
        return self.process.pid

    def say(self, *words: object) -> str:
        """Give an order and read the answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(" ".join(map(str, words)) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, f"board_tool ended at {words}: {self.process.wait()}"
        return line.rstrip("\n")

    def ok(self, *words: object) -> None:
        """Give an order that must work."""
        assert self.say(*words) == "ok"

    def kill(self) -> None:
        """End it as a power cut does."""
        self.process.kill()
        self.process.communicate()


@contextmanager
def tool(place: Path, *, opened: bool = True, sums: bool = False, **variables: str) -> Iterator[Tool]:
    """One that runs for the body; ``sums``: it writes and examines sums, as on processors that reorder."""
    made = program("board_tool_sums", "board_tool.c", flags=("-O2", *STRICT, "-DFB_SUMS=1")) if sums else program("board_tool")
    with _running([made], place, opened, variables) as started:
        yield started


@contextmanager
def emulated_tool(place: Path) -> Iterator[Tool]:
    """One for aarch64, run by an emulator."""
    made = program("board_tool_aarch64", "board_tool.c", flags=("-O2", *STRICT, "-static"), compiler="aarch64-linux-gnu-gcc")
    with _running([EMULATOR, made], place, True, {}) as started:
        yield started


@contextmanager
def _running(command: Sequence[str | Path], place: Path, opened: bool, variables: Mapping[str, str]) -> Iterator[Tool]:
    started = Tool(place, command, **variables)
    try:
        if opened:
            started.ok("open")
        yield started
    finally:
        started.kill()


@contextmanager
def place_for_board() -> Iterator[Path]:
    """A directory of a board that is not there yet; nothing of it is left afterwards."""
    place = SHARED_MEMORY / f"failover-{secrets.token_hex(6)}-robot1"
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
