"""Segments for tests: a state in which a torn one shows, and a child that commits it until it is killed."""

from __future__ import annotations

import os
import signal
import socket
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from checkpoint.segment.layout import ARRAY, PAGE, STATE, Committed, Layout, Region, address_of
from checkpoint.segment.writer import SegmentWriter, Source

LINEAGE = bytes(range(16))
PAGES = 24
"""Of the array that goes with the state."""


def numbered(parts: Sequence[tuple[str, int, int]]) -> tuple[Region, ...]:
    """Regions with addresses by their place: (name, kind, size) each."""
    return tuple(Region(name, kind, address_of(index), size) for index, (name, kind, size) in enumerate(parts))


def layout(*sizes: int) -> Layout:
    """A state and an array, unless other sizes are named."""
    sizes = sizes or (PAGE, PAGES * PAGE)
    parts = [(f"region {index}", ARRAY if index else STATE, size) for index, size in enumerate(sizes)]
    return Layout(numbered(parts), LINEAGE)


def source(content: bytes | bytearray | np.ndarray, written: list[int] | None = None) -> Source:
    """A source that says which pages were written, or does not."""
    numbers = None if written is None else np.array(written, dtype=np.uint64)
    return Source(np.frombuffer(content, dtype=np.uint8), numbers)


class Telling:
    """A state that changes with every commit and says of itself whether it is whole."""

    def __init__(self) -> None:
        self.array = np.zeros(PAGES * PAGE // 8, dtype=np.uint64)

    def sources(self, number: int) -> list[Source]:
        """The state of commit ``number``: a few pages of the array change, the rest is as it was."""
        step = PAGE // 8
        for page in {number % PAGES, number * 7 % PAGES, number * 13 % PAGES}:
            self.array[page * step : (page + 1) * step] = number
        head = number.to_bytes(8, "little") + zlib.crc32(self.array.tobytes(), number & 0xFFFFFFFF).to_bytes(4, "little")
        return [source(head), Source(self.array.view(np.uint8))]


def number_of(head: bytes | bytearray, array: bytes | bytearray) -> int:
    """Which commit a state is of; fails unless it is just that one."""
    number = int.from_bytes(head[:8], "little")
    assert int.from_bytes(head[8:12], "little") == zlib.crc32(array, number & 0xFFFFFFFF), f"commit {number} is torn"
    return number


def number_read(found: Committed) -> int:
    """Which commit was read; it must be the one that the segment says it is."""
    number = number_of(found.region(0), found.region(1))
    assert number == found.number
    return number


@contextmanager
def committing_child() -> Iterator[tuple[int, int]]:
    """A process that commits as fast as it can, until it is killed: (its PID, the segment's descriptor)."""
    ours, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        try:
            for first, end in ((3, theirs.fileno()), (theirs.fileno() + 1, os.sysconf("SC_OPEN_MAX"))):
                os.closerange(first, end)  # segments of tests before this one among them
            _commit_for_ever(theirs)
        finally:
            os._exit(1)
    theirs.close()
    descriptors: list[int] = []
    try:
        _, descriptors, _, _ = socket.recv_fds(ours, 1, 1)
        yield pid, descriptors[0]
    finally:
        ours.close()
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        for descriptor in descriptors:
            os.close(descriptor)


def _commit_for_ever(theirs: socket.socket) -> None:
    state, writer = Telling(), SegmentWriter(layout())
    assert writer.commit(state.sources(1))
    socket.send_fds(theirs, [b"x"], [writer.descriptor])
    while True:
        writer.commit(state.sources(writer.number + 1))
