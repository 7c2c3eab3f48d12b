"""Thread that makes vote records durable, so that the main loop never waits for a disk."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from agent.errors import BallotError
from failover.core.types import VoteRecord

RETRY_S: Final = 0.5
"""Pause before another try after the disk refused."""


class VoteRecordWriter:
    """Newest first: a vote record that waits is replaced by a later one, which holds all that it held.

    Attributes:
        trouble: why the last try failed, "" once one succeeded.
    """

    def __init__(self, keep: Callable[[VoteRecord], None]) -> None:
        """
        Args:
            keep: writes one vote record durably, or raises BallotError.
        """
        self._keep = keep
        self._wanted: tuple[int, VoteRecord] | None = None
        self._change = threading.Condition()
        self._finished: deque[tuple[int, VoteRecord]] = deque()
        self._signal = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._ending = False
        self.trouble = ""
        self._thread = threading.Thread(target=self._work, name="persister", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """Readable when `finished` has something to say."""
        return self._signal

    def submit(self, number: int, vote_record: VoteRecord) -> None:
        """Make it durable as soon as the disk is free."""
        with self._change:
            self._wanted = (number, vote_record)
            self._change.notify()

    def finished(self) -> list[tuple[int, VoteRecord]]:
        """The records that have become durable since the last call."""
        try:
            os.eventfd_read(self._signal)
        except BlockingIOError:
            return []
        return [self._finished.popleft() for _ in range(len(self._finished))]

    def close(self, patience_s: float) -> None:
        """End the thread once nothing waits; a disk that takes longer is not waited for."""
        with self._change:
            self._ending = True
            self._change.notify()
        self._thread.join(patience_s)

    def _work(self) -> None:
        while (wanted := self._next()) is not None:
            number, vote_record = wanted
            try:
                self._keep(vote_record)
            except BallotError as error:
                self.trouble = str(error)
                self._again(wanted)
                continue
            self.trouble = ""
            self._finished.append((number, vote_record))
            os.eventfd_write(self._signal, 1)

    def _next(self) -> tuple[int, VoteRecord] | None:
        with self._change:
            while self._wanted is None and not self._ending:
                self._change.wait()
            wanted, self._wanted = self._wanted, None
            return wanted

    def _again(self, wanted: tuple[int, VoteRecord]) -> None:
        time.sleep(RETRY_S)
        with self._change:
            if self._wanted is None and not self._ending:
                self._wanted = wanted
