"""How much a guarded component has written to its standard streams, and the bytes themselves, without asking anybody.

The guard counts a byte when it takes it out of the pipe, and writes it to the log a little later (ARCHITECTURE §4).
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

from checkpoint.engine import Streams
from checkpoint.errors import CaptureError
from checkpoint.model import OutputPiece
from checkpoint.resources import Surroundings, pipes_of

COUNTERS: Final = struct.Struct("<QQQQQQ")
FIRSTS: Final = 4
"""Place of the first bytes that the logs had when the guard began."""
STREAM_NUMBERS: Final = (1, 2)
COUNT_TIMEOUT_S: Final = 0.05
"""How long the guard may be between taking bytes and counting them: microseconds, unless it was preempted."""
LOG_TIMEOUT_S: Final = 2.0
"""How long the guard may take to write to its log what it has read; not during a freeze."""
BACKLOG_LIMIT: Final = 16 << 20
"""Bytes of output that one snapshot carries at most: earlier ones are in the log alone."""

Totals = tuple[int, int]


class Outputs:
    """The two output streams of one guarded component. Owns the descriptors of its `Streams`."""

    def __init__(self, streams: Streams) -> None:
        self._streams = streams
        self._counters = mmap.mmap(streams.counters, COUNTERS.size, prot=mmap.PROT_READ)
        self._firsts = COUNTERS.unpack(self._counters[: COUNTERS.size])[FIRSTS:]
        self.surroundings = Surroundings(pipes_of(streams.outputs))

    def totals(self) -> Totals:
        """Bytes written until now, taken or still in the pipe. The component stands still.

        Raises:
            CaptureError: the guard does not come to an end with counting.
        """
        first, second = (self._total(index) for index in range(len(STREAM_NUMBERS)))
        return first, second

    def _total(self, index: int) -> int:
        deadline = time.perf_counter() + COUNT_TIMEOUT_S
        while True:
            before = COUNTERS.unpack(self._counters[: COUNTERS.size])[2 * index : 2 * index + 2]
            unread = _unread(self._streams.outputs[index])
            after = COUNTERS.unpack(self._counters[: COUNTERS.size])[2 * index : 2 * index + 2]
            if before == after and not before[0]:
                return int(before[1]) + unread
            if time.perf_counter() > deadline:
                raise CaptureError("the guard stands in the middle of reading the component's output; capture it again")
            os.sched_yield()

    def pieces(self, since: Totals, until: Totals) -> tuple[OutputPiece, ...]:
        """The bytes between two totals, as far as they are here; one piece for each stream, empty where nothing was written.

        Raises:
            CaptureError: the guard's log does not get as far.
        """
        return tuple(
            self._piece(index, min(max(begin, end - BACKLOG_LIMIT, self._firsts[index]), end), end)
            for index, (begin, end) in enumerate(zip(since, until, strict=True))
        )

    def _piece(self, index: int, begin: int, end: int) -> OutputPiece:
        log = self._streams.logs[index]
        deadline = time.perf_counter() + LOG_TIMEOUT_S
        while os.fstat(log).st_size < end:
            if time.perf_counter() > deadline:
                raise CaptureError(
                    f"the guard has not written stream {index + 1} to its log within {LOG_TIMEOUT_S:g} s: "
                    "its disk is slow or full; make room, then capture again"
                )
            time.sleep(0.0005)
        content = os.pread(log, end - begin, begin) if end > begin else b""
        if len(content) != end - begin:
            raise CaptureError(f"the log of stream {index + 1} is shorter than its size says; capture it again")
        return OutputPiece(index + 1, begin, content)

    def close(self) -> None:
        """Give the descriptors back."""
        self._counters.close()
        for descriptor in (self._streams.counters, *self._streams.outputs, *self._streams.logs):
            os.close(descriptor)


def _unread(descriptor: int) -> int:
    """Bytes that wait in a pipe or terminal. Source: ioctl_tty(2), FIONREAD; pipe(7)."""
    found = array.array("i", [0])
    fcntl.ioctl(descriptor, termios.FIONREAD, found)
    return found[0]
