"""Progress of a wait, on standard error: one line that moves on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TextIO

from failover.cli.output import render
from failover.cli.output.team_tree import size as size_told

PATIENCE_S: Final = 1.0
"""A wait that is over sooner is not told of."""

MOVES_S: Final = 0.1
PLAIN_S: Final = 5.0
"""Between two states on a terminal, and between two lines elsewhere."""

COLUMNS: Final = 80
"""Of a terminal that does not say how many it has."""

LOOK_S: Final = 0.25


class Progress:
    """What is waited for, told again and again. A context manager; at its end the line that moves is gone.

    Args:
        is_quiet: say nothing (--json).
    """

    def __init__(
        self, *, is_quiet: bool = False, stream: TextIO | None = None, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._stream = stream if stream is not None else sys.stderr  # None where the shell has closed it
        self._is_quiet, self._now = is_quiet or self._stream is None, now
        self._moves = not self._is_quiet and self._stream.isatty()
        self._due_s = now() + PATIENCE_S
        self._is_shown, self._last = False, ""

    def tell(self, sentence: str) -> None:
        """How far it is now."""
        now_s = self._now()
        if self._is_quiet or now_s < self._due_s or (sentence == self._last and not self._moves):
            return
        self._due_s, self._last = now_s + (MOVES_S if self._moves else PLAIN_S), sentence
        told = render.spoken(sentence)
        self._write(f"\r{told[: self._columns() - 1]}\x1b[K" if self._moves else f"{told}\n")
        self._is_shown = True

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the reader has gone: the wait goes on
            self._stream.write(text)
            self._stream.flush()

    def _columns(self) -> int:
        """Of the terminal: a line that went on below could not be taken back."""
        with contextlib.suppress(OSError, ValueError):
            return os.get_terminal_size(self._stream.fileno()).columns or COLUMNS
        return COLUMNS

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_shown and self._moves:
            self._write("\r\x1b[K")


def share(done: int, size: int) -> str:
    """So much of so much, in bytes."""
    return f"{size_told(min(done, size))} of {size_told(size)} ({100 * min(done, size) // max(size, 1)} %)"


@contextmanager
def of_reading(pid: int, what: str, size: int, progress: Progress) -> Iterator[None]:
    """Tell how much of a file of ``size`` bytes a process has read, by all that it reads during the body; Source: proc(5), io."""
    over = threading.Event()
    first = _read_by(pid)

    def look() -> None:
        while not over.wait(LOOK_S):
            if (read := _read_by(pid)) >= first > 0:  # it may have ended, or not be ours to look at
                progress.tell(f"{what}: {share(read - first, size)}")

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    try:
        yield
    finally:
        over.set()
        looking.join()


def _read_by(pid: int) -> int:
    with contextlib.suppress(OSError, ValueError):
        for line in Path(f"/proc/{pid}/io").read_text().splitlines():
            if line.startswith("rchar: "):
                return int(line.partition(" ")[2])
    return 0
