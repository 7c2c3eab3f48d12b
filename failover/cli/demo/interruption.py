"""Ends the demo on request (Ctrl-C, SIGTERM, SIGHUP): at once between steps, never in the middle of a start or an end.

A signal may arrive between the start of a process and the line that records it, or while everything is being ended: it would
leave something behind. So the handler only records it, except where `allowed`.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

NUMBERS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """The order to end, noted; raised as KeyboardInterrupt, once, where that is allowed. Of the main thread only."""

    def __init__(self) -> None:
        self._came = False
        self._allowed = False

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note the signals for the body; their actions of before are put back."""
        before = {number: signal.signal(number, self._arrive) for number in NUMBERS}
        try:
            yield
        finally:
            for number, action in before.items():
                signal.signal(number, action)

    @contextmanager
    def allowed(self) -> Iterator[None]:
        """Raise in the body, also for a signal that has come before it. No signal disturbs the code that ends the body."""
        self._set_allowed(True)
        try:
            yield
        finally:
            self._allowed = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let the body, short, come to its end first. If it fails, all is being ended, and nothing is raised any more."""
        before, self._allowed = self._allowed, False
        yield
        self._set_allowed(before)

    def _set_allowed(self, allowed: bool) -> None:
        self._allowed = allowed
        if allowed and self._came:
            self._raise()

    def _arrive(self, _number: int, _frame: FrameType | None) -> None:
        self._came = True
        if self._allowed:
            self._raise()

    def _raise(self) -> None:
        self._allowed = False
        raise KeyboardInterrupt
