"""Counts how much a program under a guard has written by its commit, without waiting for the guard to empty its pipes.

Python's buffers are flushed, so that output printed before a commit counts as printed before it. Where a pipe is full, a flush
would wait: then the commit says `PENDING` instead, and a keeper passes it over.
"""

from __future__ import annotations

import fcntl
import io
import mmap
import sys
import time
from typing import Final, TextIO

from checkpoint.segment.layout import PENDING, Pending
from checkpoint.segment.output_counters import StreamCounts, Totals

PATIENCE_S: Final = 0.0003
"""How long a commit waits for a guard that is just emptying a pipe or counting its bytes; for one that stands still, once."""
LOOK_S: Final = 0.00005
BUFFERED_MAX: Final = io.DEFAULT_BUFFER_SIZE + 8192
"""Bytes that Python holds back of one stream at most: the buffer of bytes, and one piece of text before it (``_CHUNK_SIZE``)."""
FLUSH_SLOTS: Final = -(-BUFFERED_MAX // mmap.PAGESIZE) + 4
"""Slots of a pipe, each a page, that a flush takes at most: up to four writes, of which each may begin a slot."""
STREAMS: Final = (1, 2)


class OwnOutput:
    """The two output streams of this process. Called by one thread at a time.

    Args:
        counters: of the guard; the descriptor stays the caller's.
    """

    def __init__(self, counters: int) -> None:
        self._counts = StreamCounts(counters, STREAMS)
        self._slots = [fcntl.fcntl(stream, fcntl.F_GETPIPE_SZ) // mmap.PAGESIZE for stream in STREAMS]
        self._stuck = b""
        """The guard's counters when we last gave up: while they stay the same it stands still, and is not waited for again."""

    def totals(self) -> Totals | Pending:
        """Bytes written until now, those of Python's buffers too; `PENDING` where a pipe has no room for them."""
        patience_s = 0.0 if self._stuck and self._counts.words() == self._stuck else PATIENCE_S
        if not self._has_room_within(patience_s):
            return self._give_up()
        _flush(sys.stdout)
        _flush(sys.stderr)
        totals = self._counts.totals(patience_s)
        if totals is None:
            return self._give_up()
        self._stuck = b""
        return totals

    def _give_up(self) -> Pending:
        self._stuck = self._counts.words()
        return PENDING

    def _has_room_within(self, patience_s: float) -> bool:
        deadline = 0.0
        while not (self._has_room(0) and self._has_room(1)):
            deadline = deadline or time.perf_counter() + patience_s
            if time.perf_counter() >= deadline:
                return False
            time.sleep(LOOK_S)
        return True

    def _has_room(self, index: int) -> bool:
        """Whether a flush fits into the pipe, however its slots are filled.

        Two neighbours hold more than one page together, else the kernel had put them into one slot; the first may be read in
        part. Writes by other threads and children meanwhile are not foreseen. A pipe that is empty is taken as it is.
        Source: pipe(7), ``pipe_write`` in the kernel's fs/pipe.c.
        """
        unread = self._counts.unread(index)
        return not unread or 2 * -(-unread // mmap.PAGESIZE) + 2 + FLUSH_SLOTS <= self._slots[index]


def _flush(stream: TextIO | None) -> None:
    try:
        if stream is not None:
            stream.flush()
    except (AttributeError, ValueError):  # it was replaced by something else, or closed
        return
