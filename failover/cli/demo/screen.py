"""Output of the demo: lines, and on a terminal a table above which they scroll."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from failover.cli.output import render

COLUMNS: Final = ("program", "runs on", "state", "snapshots", "lag", "freeze", "output", "newest line")


class PlainScreen:
    """Lines, each with the time since the beginning. ``transcript`` keeps them."""

    def __init__(self, quiet: bool = False) -> None:
        self.transcript: list[str] = []
        self._quiet = quiet
        self._began = time.monotonic()

    def __enter__(self) -> PlainScreen:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def say(self, text: str) -> None:
        """Tell one thing that happened."""
        line = f"{time.monotonic() - self._began:6.2f} s  {text}"
        self.transcript.append(line)
        self.show_line(line)

    def show_line(self, line: str) -> None:
        """Put a line where the person looks."""
        if not self._quiet:
            print(line, flush=True)

    def draw(self, lines: Sequence[Sequence[str]], share: float, caption: str) -> None:
        """Nothing: `say` prints all that matters."""


class LiveScreen(PlainScreen):
    """A table redrawn in place, with the lines scrolling above it."""

    def __enter__(self) -> LiveScreen:
        self._board = render.LiveBoard().__enter__()
        return self

    def __exit__(self, *reason: object) -> None:
        self._board.__exit__(*reason)

    def show_line(self, line: str) -> None:
        self._board.say(line)

    def draw(self, lines: Sequence[Sequence[str]], share: float, caption: str) -> None:
        self._board.draw(COLUMNS, lines, share, caption)
