"""Thread that writes the event log: the main loop hands over a decision in a microsecond, however slow the disk is."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from msgspec.structs import replace

from agent.event_log import EventLogFile
from agent.system import clock
from agent.system.log_setup import DECISIONS
from failover.core.event_log.decisions import Decision, Line, without_output

WAITING_MAX: Final = 512
"""Lines that wait for the disk; beyond it they are given up, and counted."""

RETRY_S: Final = 1.0
"""Pause after the disk has refused."""

REPEAT_NS: Final = 60 * 10**9
"""The same sentence about the same component is written again after this time only, or after another one about it."""

log = logging.getLogger(DECISIONS)

COMPONENTS_MAX: Final = 2_048
"""Components whose last sentence is remembered."""

SENTENCE_MAX: Final = 2_000
"""Characters of one sentence; a program's own error message may be in it."""


class EventLogWriter:
    """One life's lines. `note` and `unwritten` belong to the main loop, and no lock of the thread's can make them wait.

    Attributes:
        trouble: why the event log cannot be written now, or what is missing in it; "" if all is well.
    """

    def __init__(self, state_directory: Path, robot: str, life: int) -> None:
        self.trouble = ""
        self._file = EventLogFile(state_directory)
        self._robot, self._life, self._kernel = robot, life, clock.kernel_boot()
        self._number = 0
        self._last: dict[str, tuple[str, int, int]] = {}
        self._recent: deque[Line] = deque(maxlen=WAITING_MAX)
        self._written = 0
        self._given_up = 0
        self._queue: SimpleQueue[Line | None] = SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="event log writer", daemon=True)
        self._thread.start()

    def note(self, decisions: Iterable[Decision]) -> None:
        """Pass decisions on to be written; returns at once."""
        for decision in decisions:
            line = self._line(decision)
            if line is None:
                continue
            self._recent.append(line)
            if self._queue.qsize() < WAITING_MAX:
                self._queue.put(line)
            else:
                self._given_up += 1

    def unwritten(self) -> tuple[Line, ...]:
        """Lines that are not on the disk yet, oldest first."""
        return tuple(line for line in self._recent if line.number > self._written)

    def close(self, patience_s: float) -> None:
        """End once nothing waits; a disk that takes longer, or refuses, is not waited for."""
        self._ending.set()
        self._queue.put(None)
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
        is_last = False
        while not is_last:
            batch, is_last = self._batch()
            while batch and not self._is_kept(batch):
                if self._ending.wait(RETRY_S):
                    break
        self._file.close()

    def _batch(self) -> tuple[list[Line], bool]:
        """Wait for lines; returns all that have come, and whether they are the last ones."""
        batch: list[Line] = []
        item = self._queue.get()
        while item is not None:
            batch.append(item)
            try:
                item = self._queue.get_nowait()
            except Empty:
                return batch, False
        return batch, True

    def _is_kept(self, batch: list[Line]) -> bool:
        try:
            self._file.append(batch)
        except OSError as error:
            self.trouble = f"this robot cannot write its event log: {error.strerror}; failover why will not show its decisions"
            return False
        self._written = batch[-1].number
        for line in batch:
            decision = line.decision
            about = {"component": decision.component, "epoch": decision.facts.epoch}
            log.info("%s: %s", decision.component or self._robot, without_output(decision.sentence), extra=about)
        lost = self._given_up
        self.trouble = f"{lost} decisions are missing in the event log: the disk did not take them in time" if lost else ""
        return True
