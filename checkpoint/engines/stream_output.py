"""Read how much a guarded component has written to its standard streams, and the bytes, without asking another process.

The guard counts a byte when it takes it out of the pipe, and writes it to the log a little later (docs/internals.md, section 5).
While output
is held, the guard may leave bytes in the pipe: this module reads them there, and they stay in the pipe.
"""

from __future__ import annotations

import os
import time
from typing import Final

from checkpoint.engine import Streams
from checkpoint.errors import CaptureError
from checkpoint.model import OutputPiece
from checkpoint.resources.ipc.pipes import peek
from checkpoint.segment.output_counters import StreamCounts, Totals

LOG_TIMEOUT_S: Final = 2.0
"""How long the guard may take to write the output that it has read to its log; not during a freeze."""
BACKLOG_LIMIT: Final = 16 << 20
"""Bytes of output that one snapshot carries at most: earlier ones are in the log alone."""


class Outputs:
    """The two output streams of one guarded component. Owns the descriptors of its `Streams`."""

    def __init__(self, streams: Streams) -> None:
        self._streams = streams
        self._counts = StreamCounts(streams.counters, streams.outputs)
        self._firsts = self._counts.firsts

    def totals(self) -> Totals:
        """Bytes written until now, taken or still in the pipe. The component stands still.

        Raises:
            CaptureError: the guard does not come to an end with counting.
        """
        totals = self._counts.totals()
        if totals is None:
            raise CaptureError("the guard is just reading the component's output; capture it again")
        return totals

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
        deadline = time.perf_counter() + LOG_TIMEOUT_S
        while (content := self._written(index, begin, end)) is None:
            if time.perf_counter() > deadline:
                raise CaptureError(
                    f"the guard has not written stream {index + 1} to its log within {LOG_TIMEOUT_S:g} s: "
                    "its disk is slow or full; make room, then capture again"
                )
            time.sleep(0.0005)
        if len(content) != end - begin:
            raise CaptureError(f"the log of stream {index + 1} is shorter than its size says; capture it again")
        return OutputPiece(index + 1, begin, content)

    def _written(self, index: int, begin: int, end: int) -> bytes | None:
        """The bytes from the log, the last of them from the pipe where the guard leaves them; None: not to be had now."""
        log = self._streams.logs[index]
        if os.fstat(log).st_size >= end:
            return os.pread(log, end - begin, begin) if end > begin else b""
        taken = self._counts.taken(index)
        if taken is None or os.fstat(log).st_size < taken:
            return None
        unread = peek(self._streams.outputs[index])
        if taken + len(unread) < end or self._counts.taken(index) != taken:
            return None
        logged = os.pread(log, taken - begin, begin) if taken > begin else b""
        return logged + unread[max(begin - taken, 0) : end - taken]

    def close(self) -> None:
        """Give the descriptors back."""
        self._counts.close()
        for descriptor in (self._streams.counters, *self._streams.outputs, *self._streams.logs):
            os.close(descriptor)
