"""How many bytes a guarded program has written to its output streams: the counted ones plus those still in the pipe.

The guard takes bytes out of a pipe and counts them in one step (docs/internals.md, section 5). Either end of the pipe reports
how many bytes are unread.
"""

from __future__ import annotations

import array
import fcntl
import mmap
import os
import struct
import termios
import time
from typing import Final

COUNTERS: Final = struct.Struct("<QQQQQQ")
FIRSTS: Final = 4
"""Place of the first bytes that the logs had when the guard began."""
COUNT_TIMEOUT_S: Final = 0.05
"""How long the guard may be between taking bytes and counting them: microseconds, unless it was preempted."""
YIELDING_S: Final = 0.0001
"""How long we look without sleeping."""

Totals = tuple[int, int]


class StreamCounts:
    """The guard's counters, seen from another process.

    Args:
        counters: the memfd of the guard; it stays the caller's.
        pipes: one end of each stream's pipe (or the master of its terminal); they stay the caller's.
    """

    def __init__(self, counters: int, pipes: tuple[int, int]) -> None:
        self._counters = mmap.mmap(counters, COUNTERS.size, prot=mmap.PROT_READ)
        self._words = memoryview(self._counters)[: COUNTERS.size].cast("Q")
        self._pipes = pipes
        self._found = array.array("i", [0])
        first, second = COUNTERS.unpack(self._counters[: COUNTERS.size])[FIRSTS:]
        self.firsts: Totals = (first, second)

    def totals(self, patience_s: float = COUNT_TIMEOUT_S) -> Totals | None:
        """Bytes written until now; None when the guard does not come to an end with counting in ``patience_s`` a stream.

        Raises:
            OSError: an end is no pipe and no terminal.
        """
        first = self._total(0, patience_s)
        second = self._total(1, patience_s)
        return None if first is None or second is None else (first, second)

    def unread(self, index: int) -> int:
        """Bytes that wait in a stream's pipe or terminal. Source: ioctl_tty(2), FIONREAD; pipe(7)."""
        fcntl.ioctl(self._pipes[index], termios.FIONREAD, self._found)
        return self._found[0]

    def taken(self, index: int) -> int | None:
        """Bytes of a stream (0 or 1) that the guard has taken out of its pipe; None while it does."""
        busy, count = self._words[2 * index], self._words[2 * index + 1]
        return None if busy else count

    def words(self) -> bytes:
        """The guard's counters as they are: while it does nothing, they stay the same."""
        return self._counters[: COUNTERS.size]

    def _total(self, index: int, patience_s: float) -> int | None:
        words, busy, counted, deadline = self._words, 2 * index, 2 * index + 1, 0.0
        while True:
            is_busy, count = words[busy], words[counted]
            unread = self.unread(index)
            if not is_busy and not words[busy] and words[counted] == count:
                return count + unread
            now = time.perf_counter()
            deadline = deadline or now + patience_s
            if now > deadline:
                return None
            if deadline - now > patience_s - YIELDING_S:
                os.sched_yield()
            else:  # we may have precedence over the guard, which runs where we do
                time.sleep(YIELDING_S / 2)

    def close(self) -> None:
        """Give the memory back."""
        self._words.release()
        self._counters.close()
