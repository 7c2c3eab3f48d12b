"""Moves a program's output from its pipes into its logs, counts every byte, and never lets the program die of it.

The pump shares the counters with the keeper, so that a snapshot's output is exact without a question during a freeze
(docs/internals.md, section 5). The pump counts a byte when it leaves the pipe and writes it afterwards, outside ``busy``: a slow
disk never prolongs a freeze, and the keeper finds the bytes in the log after the thaw.

Held output (``--output=committed``) that may not be shown yet has a bound. When more than `HOLD_LIMIT` waits, the pump leaves the
pipe as it is, and the program waits in its next write until another robot holds a checkpoint. A snapshot reads the pipe without
emptying it (`checkpoint.engines.stream_output`), so checkpoints are made all the same.

When the disk is full, the pump first gives the oldest half of the log back to it. If that does not help, it drops nothing: it
tries again until there is room, the pipe fills, and the program waits inside its next write. The program is not killed, and its
output continues later without a gap.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
import threading
import time
from collections.abc import Mapping
from typing import Final

from agent.guard.output_logs import KEEP_LIMIT, STREAMS, TRIM_STEP, OutputLogs

READ_SIZE: Final = 256 << 10
"""Bytes taken at once; the only output ever held in this process's memory."""

PIPE_SIZE: Final = 256 << 10
"""Asked of the kernel for each pipe; bounds the unread bytes that a snapshot carries. A smaller pipe works too."""

COUNTERS_SIZE: Final = mmap.PAGESIZE
LINE_LIMIT: Final = 200
"""Characters of a program's last words that are told."""

RETRY_S: Final = 0.1
"""Between two attempts to write to a disk that is full."""

HOLD_LIMIT: Final = 8 << 20
"""Bytes of a stream that wait unseen at most: half of what a snapshot carries (``BACKLOG_LIMIT``), so that a standby gets all."""

HOLD_POLL_S: Final = 0.02
"""How soon the program goes on once the output that waited has become safe."""

CUT_FLOOR: Final = TRIM_STEP
"""Bytes of a log that are never given back for want of space: newer than any snapshot still being taken."""


class Counters:
    """Six u64 in a memfd that the keeper maps too: busy 1, count 1, busy 2, count 2, first 1, first 2. One writer: the pump.

    The last two never change: the first byte of each stream that this robot's log had when its pump began.
    """

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("failover-streams", os.MFD_CLOEXEC)
        os.fchmod(self.descriptor, 0o600)  # a program that keeps its state reads it, and must not open it for writing
        os.ftruncate(self.descriptor, COUNTERS_SIZE)
        self._mapping = mmap.mmap(self.descriptor, COUNTERS_SIZE)
        self._words = memoryview(self._mapping).cast("Q")  # an item is stored by one eight-byte move, never in parts

    def begin_at(self, totals: tuple[int, int], firsts: tuple[int, int]) -> None:
        """Set, before a byte is taken, how much was written before this program, and where the logs begin."""
        self._words[1], self._words[3] = totals
        self._words[4], self._words[5] = firsts

    def count(self, stream: int) -> int:
        """Bytes of the stream that have left the pipe, since the component's first."""
        return self._words[stream * 2 - 1]

    def totals(self) -> tuple[int, int]:
        """Both counts."""
        return self._words[1], self._words[3]

    def take(self, stream: int, pipe: int) -> bytes:
        """Read from the pipe and count, as one act in the keeper's eyes.

        Raises:
            BlockingIOError: the pipe is empty.
        """
        busy = stream * 2 - 2
        self._words[busy] = 1
        try:
            content = os.read(pipe, READ_SIZE)
            self._words[busy + 1] += len(content)
        finally:
            self._words[busy] = 0
        return content


class Pump:
    """Two pipes, two logs, one thread of its own: a disk that hangs must not keep the guard from its lease.

    Until `begin` the program's output stays in its pipes, and when they are full, it waits.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._hold_limit = 0
        self.blocked = ""
        """Why output is not being written now; "" while it is."""
        self.read_ends: dict[int, int] = {}
        self.write_ends: dict[int, int] = {}
        for stream in STREAMS:
            self.read_ends[stream], self.write_ends[stream] = _pipe()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._drained = threading.Event()
        self._draining = False
        self._logs: OutputLogs | None = None

    @property
    def logs(self) -> OutputLogs:
        """Where the output goes."""
        assert self._logs is not None, "open comes first"
        return self._logs

    @property
    def is_open(self) -> bool:
        """Whether it is known where the output goes."""
        return self._logs is not None

    def open(self, logs: OutputLogs, totals: tuple[int, int]) -> None:
        """Say where the output goes, and how much was written there before."""
        self._logs = logs
        self.counters.begin_at(totals, (logs.bounds(1).start, logs.bounds(2).start))

    def born(self) -> None:
        """The program has the write ends; ours go."""
        for descriptor in self.write_ends.values():
            os.close(descriptor)
        self.write_ends.clear()

    def begin(self) -> None:
        """Begin to pump. Fork before this: afterwards the process has two threads."""
        threading.Thread(target=self._run, name="pump", daemon=True).start()

    def last_line(self) -> str:
        """Of a program that ended before it was begun: the last line that it wrote to its standard error; "" if it wrote none."""
        try:
            said = os.read(self.read_ends[2], PIPE_SIZE).decode(errors="replace").split("\n")
        except BlockingIOError:
            return ""
        return next((line.strip()[:LINE_LIMIT] for line in reversed(said) if line.strip()), "")

    def drain(self, patience_s: float) -> bool:
        """The program has ended: wait until its last output is in the logs; False if the disk took longer."""
        self._draining = True
        os.eventfd_write(self._wake, 1)
        return self._drained.wait(patience_s)

    def _run(self) -> None:
        streams = {pipe: stream for stream, pipe in self.read_ends.items()}
        while True:
            ready = self._ready(streams)
            if not ready and self._draining:
                self._draining = False
                self._drained.set()
            for descriptor in ready:
                if descriptor == self._wake:
                    os.eventfd_read(self._wake)
                elif not self._move(streams[descriptor], descriptor):
                    del streams[descriptor]  # every writer closed it: nothing will ever come again

    def _ready(self, streams: Mapping[int, int]) -> list[int]:
        """Wait until there is something to do: descriptors. A stream of which too much waits to be safe is left alone."""
        left_alone = {pipe for pipe, stream in streams.items() if not self._draining and self._waits_too_much(stream)}
        poll = select.poll()
        for descriptor in (self._wake, *(streams.keys() - left_alone)):
            poll.register(descriptor, select.POLLIN)
        patience_ms = 0 if self._draining else HOLD_POLL_S * 1_000 if left_alone else None
        return [descriptor for descriptor, _ in poll.poll(patience_ms)]

    def _waits_too_much(self, stream: int) -> bool:
        limit = self._hold_limit
        if not limit:
            return False
        bounds = self.logs.bounds(stream)
        return bounds.size - bounds.safe > limit

    def _move(self, stream: int, pipe: int) -> bool:
        """Move one pipeful; False at the end of the stream."""
        offset = self.counters.count(stream)
        try:
            content = self.counters.take(stream, pipe)
        except BlockingIOError:
            return True
        self._store(stream, offset, memoryview(content))
        return bool(content)

    def _store(self, stream: int, offset: int, rest: memoryview) -> None:
        if rest:
            self.logs.mark()
        while rest:
            try:
                written = self.logs.write(stream, offset, rest)
            except OSError as error:
                self.blocked = (
                    f"the guard holds the program's output back: it cannot write {self.logs.directory}: {error.strerror}"
                )
                self._make_room(error)
                continue
            offset, rest = offset + written, rest[written:]
        if self.blocked:
            self.blocked = ""
        if offset % TRIM_STEP < READ_SIZE:
            self.logs.trim(stream, offset - KEEP_LIMIT)

    def limit(self, hold_limit: int) -> None:
        """From now on so much of a stream may wait to be safe."""
        self._hold_limit = hold_limit
        os.eventfd_write(self._wake, 1)

    def _make_room(self, error: OSError) -> None:
        """Give the older half of both logs back, if the disk is full and they are long enough; else wait a moment."""
        gave = False
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            for each in STREAMS:
                bounds = self.logs.bounds(each)
                kept = bounds.size - bounds.start
                gave |= kept > 2 * CUT_FLOOR and self.logs.trim(each, bounds.size - max(kept // 2, CUT_FLOOR))
        if not gave:
            time.sleep(RETRY_S)


def _pipe() -> tuple[int, int]:
    """A pipe whose read end never blocks; the write end does, so that a program waits and does not fail."""
    read_end, write_end = os.pipe2(os.O_CLOEXEC)
    os.set_blocking(read_end, False)
    try:
        fcntl.fcntl(read_end, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
    except OSError:  # the user's share of pipe memory is used up: the kernel's own size does as well
        pass
    return read_end, write_end
