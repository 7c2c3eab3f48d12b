"""Writes the story down, in a thread: a decision is passed on in a microsecond, whatever the disk does."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

from agent import clock
from agent.story import StoryFile
from failover.core.story import Decision, Line

WAITING_MAX: Final = 512
"""Lines that wait for the disk; beyond it the oldest are given up, and counted."""

RETRY_S: Final = 1.0
"""Pause after the disk has refused."""

REPEAT_NS: Final = 60 * 10**9
"""The same sentence about the same component is written again after this time only, or after another one about it."""

COMPONENTS_MAX: Final = 2_048
"""Components whose last sentence is remembered."""

SENTENCE_MAX: Final = 2_000
"""Characters of one sentence; a program's own error message may be in it."""


class Scribe:
    """One life's lines. `note` and `unwritten` belong to the heart, everything else to the thread.

    Attributes:
        trouble: why the story cannot be written now; "" while it can.
    """

    def __init__(self, state_directory: Path, robot: str, life: int) -> None:
        self.trouble = ""
        self._file = StoryFile(state_directory)
        self._robot, self._life, self._kernel = robot, life, clock.kernel_boot()
        self._number = 0
        self._last: dict[str, tuple[str, int, int]] = {}
        self._waiting: deque[Line] = deque()
        self._given_up = 0
        self._change = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._work, name="scribe", daemon=True)
        self._thread.start()

    def note(self, decisions: Iterable[Decision]) -> None:
        """Pass decisions on to be written; returns at once."""
        lines = [line for decision in decisions if (line := self._line(decision)) is not None]
        if not lines:
            return
        with self._change:
            self._waiting.extend(lines)
            while len(self._waiting) > WAITING_MAX:
                self._waiting.popleft()
                self._given_up += 1
            self._change.notify()

    def unwritten(self) -> tuple[Line, ...]:
        """Lines that are not on the disk yet, oldest first."""
        with self._change:
            return tuple(self._waiting)

    def close(self, patience_s: float) -> None:
        """End once nothing waits; a disk that takes longer is not waited for."""
        with self._change:
            self._ending = True
            self._change.notify()
        self._thread.join(patience_s)

    def _line(self, decision: Decision) -> Line | None:
        """The next line; None where it would only repeat the last one about that component."""
        sentence, at_ns, repeats = self._last.get(decision.component, ("", 0, 0))
        is_new = decision.sentence != sentence
        if not is_new and decision.at_ns - at_ns < REPEAT_NS:
            self._last[decision.component] = (sentence, at_ns, repeats + 1)
            return None
        if len(self._last) >= COMPONENTS_MAX:
            self._last.clear()
        self._last[decision.component] = (decision.sentence, decision.at_ns, 0)
        self._number += 1
        short = replace(decision, sentence=decision.sentence[:SENTENCE_MAX])
        return Line(self._robot, self._life, self._number, self._kernel, clock.wall_ns(decision.at_ns), short, repeats)

    def _work(self) -> None:
        while (batch := self._next()) is not None:
            try:
                self._file.append(batch)
            except OSError as error:
                self.trouble = f"the story of its decisions cannot be written: {error.strerror}; failover why forgets them"
                time.sleep(RETRY_S)
                if self._ending:
                    break
                continue
            self._written(batch)
        self._file.close()

    def _next(self) -> tuple[Line, ...] | None:
        with self._change:
            while not self._waiting and not self._ending:
                self._change.wait()
            return tuple(self._waiting) or None

    def _written(self, batch: tuple[Line, ...]) -> None:
        newest = batch[-1].number
        with self._change:
            while self._waiting and self._waiting[0].number <= newest:
                self._waiting.popleft()
            lost = self._given_up
        self.trouble = f"{lost} decisions are missing in the story: the disk did not take them in time" if lost else ""
