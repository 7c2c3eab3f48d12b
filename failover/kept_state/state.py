"""The state that a program keeps, and the segment to which its commits go."""

from __future__ import annotations

import os
import secrets
import threading
import weakref
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from checkpoint.errors import SegmentError
from checkpoint.linux.memory.own_memory import LiveMemory
from checkpoint.segment.layout import ARRAY, MAX_NAME_SIZE, MAX_PLACES, PAGE, STATE, Layout, Outputs, Region, address_of
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.writer import SegmentWriter, Source, pages_of
from failover.errors import KeepError, StateFormatError, TaskError
from failover.state import Decoded, Encoded, Schema
from failover.state import Region as EncodedRegion

STATE_NAME: Final = "(state)"
"""The region of the encoded state; the others are called by their places, which begin with the state's name."""
SIZE_SIZE: Final = 8
"""The state region begins with how many bytes follow, little-endian."""
FIRST_ROOM: Final = 4 * PAGE
"""Bytes that the state region has at least: a state that grows a little needs no new segment."""
LIVE_SIZE_MIN: Final = 64 << 10
"""Smaller arrays are compared: that takes less time than asking the kernel."""

FEW_BYTES: Final = 16 * PAGE
"""A state up to this size is given to the segment as bytes."""

Bytes = NDArray[np.uint8]
Contents = Mapping[str, Bytes | bytes]
_NOTHING: Final = np.empty(0, dtype=np.uint8)


class KeptState:
    """Commits values of one schema. May be called from any thread; one commit at a time.

    Attributes:
        live: memory for arrays, of which the kernel tells which pages were written.
    """

    def __init__(self, schema: Schema) -> None:
        self.live = LiveMemory()
        self._schema = schema
        self._lock = threading.RLock()
        self._is_committing = False
        self._lineage = secrets.token_bytes(16)
        self._writer: SegmentWriter | None = None
        self._rooms: dict[str, int] = {}
        """Bytes that each region of the segment has."""
        self._places = {STATE_NAME: 0}
        self._next_place = 1
        self._memory_of: dict[str, tuple[int, int]] = {}
        """Where the content of each region lay at the last commit, and its size."""
        self.outputs: Callable[[], Outputs] = _nobody_counts
        """Counts the output until now, where the program has an agent."""
        self.segments = 0
        """How many there were until now."""
        self._is_forked = False
        _close_in_children(self)

    @property
    def number(self) -> int:
        """Of the newest commit; 0 before the first."""
        return 0 if self._writer is None else self._writer.number

    def commit(self, value: object) -> bool:
        """Make ``value`` the newest commit.

        Returns:
            False when readers hold every bank; the next commit makes up for it.

        Raises:
            KeepError: something in it cannot be kept; names it. The last commit stands.
            TaskError: this process is a child of the one that keeps the state, or a signal came in the middle of a commit, and
                its handler commits.
        """
        with self._lock:
            if self._is_forked:
                raise TaskError(
                    f"cannot commit {self._schema.name} in pid {os.getpid()}, a child of the process that keeps this state: "
                    "commit there, or let the child keep one of its own"
                )
            if self._is_committing:
                raise TaskError(
                    f"cannot commit {self._schema.name} in a signal handler that came in the middle of a commit: "
                    "set a flag there, and commit in the loop that looks at it"
                )
            try:
                self._is_committing = True
                return self._commit(self._schema.encode(value))
            except SegmentError as error:
                self.live.distrust()
                raise KeepError(f"cannot keep {self._schema.name}: {error}", self._schema.name) from error
            except BaseException:
                self.live.distrust()
                raise
            finally:
                self._is_committing = False

    def _commit(self, encoded: Encoded) -> bool:
        contents = contents_of(encoded)
        writer = self._writer
        if writer is None or not self._has_room(contents):
            writer = self._make_room(contents)
        if encoded.regions:
            self.live.look()
        sources = [self._source(region.name, contents.get(region.name, _NOTHING)) for region in writer.layout.regions]
        return writer.commit(sources, self.outputs())

    def _source(self, name: str, content: Bytes | bytes) -> Source:
        """The content of a region now, and which of its pages were written, if the kernel can tell.

        It can where the region held just this memory at the last commit, or never held any: then zeros were written over.
        """
        if isinstance(content, bytes) or name == STATE_NAME:
            return Source(content)
        memory = (content.ctypes.data, len(content)) if len(content) else (0, 0)
        before = self._memory_of.get(name, memory)
        self._memory_of[name] = memory
        live = self.live.at(memory[0])
        if live is None:
            return Source(content)
        written = live.take(name)
        if written is None or before != memory:
            return Source(content)
        return Source(content, written[written < pages_of(len(content))])

    def _has_room(self, contents: Contents) -> bool:
        return all(len(content) <= self._rooms.get(name, 0) for name, content in contents.items())

    def _make_room(self, contents: Contents) -> SegmentWriter:
        """Go on in a larger segment; regions that are not used any more go."""
        for name in contents:
            if len(name.encode()) > MAX_NAME_SIZE:
                raise KeepError(
                    f"cannot keep {name[:60]}…: the way to it is longer than {MAX_NAME_SIZE} bytes; keep it flatter", name
                )
        if self._next_place + len(contents) > MAX_PLACES:
            self._begin_lineage()
        for name in [name for name in self._places if name not in contents]:
            del self._places[name]
            self._memory_of.pop(name, None)
        for name in contents:
            if name not in self._places:
                self._places[name] = self._next_place
                self._next_place += 1
        rooms = {name: self._room_for(name, len(contents[name])) for name in sorted(self._places, key=self._places.__getitem__)}
        regions = [
            Region(name, STATE if name == STATE_NAME else ARRAY, address_of(self._places[name]), size)
            for name, size in rooms.items()
        ]
        layout = Layout(tuple(regions), self._lineage)
        old, self._writer = self._writer, self._grown(layout)
        self.segments += 1
        self._rooms = rooms
        if old is not None:
            old.supersede()
            old.close()
        return self._writer

    def _grown(self, layout: Layout) -> SegmentWriter:
        if self._writer is None or self._writer.layout.lineage != layout.lineage:
            return SegmentWriter(layout, number=self.number)
        return self._writer.grown(layout)

    def _begin_lineage(self) -> None:
        """All addresses were given to some region: begin again, with a whole state."""
        self._lineage = secrets.token_bytes(16)
        self._places, self._next_place = {STATE_NAME: 0}, 1
        self._memory_of.clear()
        self.live.distrust()

    def _room_for(self, name: str, size: int) -> int:
        """The room of a region: as much as it needs, and twice as much when it turns out that it grows."""
        before = self._rooms.get(name, 0)
        if size <= before:
            return before
        if name == STATE_NAME:
            return max(FIRST_ROOM, 2 * size)
        return 2 * size if before else size

    def open_reader(self) -> SegmentReader:
        """A reader of the commits. The first commit must have been made."""
        with self._lock:
            assert self._writer is not None, "there is a commit"
            return SegmentReader(self._writer.descriptor)

    def decode(self, contents: Contents) -> Decoded:
        """The value of regions that were read; large arrays of it are live.

        Raises:
            FitError: it does not fit the declaration any more; names the field.
            StateFormatError: it is damaged.
        """
        return self._schema.decode(encoded_of(contents, self._schema.name), self.array)

    def array(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Memory for an array at a place of the state, in zeros."""
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        return self.live.array(shape, dtype) if size >= LIVE_SIZE_MIN and not dtype.hasobject else np.zeros(shape, dtype)

    def forked(self) -> None:
        """In a child: give up the descriptor, whose locks are the parent's."""
        self._is_forked = True
        self._lock = threading.RLock()  # the parent's may have been held by a thread that is not here
        if self._writer is not None:
            self._writer.close()


def contents_of(encoded: Encoded) -> dict[str, Bytes | bytes]:
    """The bytes of every region of an encoded state, borrowed where they are arrays."""
    state = len(encoded.data).to_bytes(SIZE_SIZE, "little") + encoded.data
    contents: dict[str, Bytes | bytes] = {STATE_NAME: state if len(state) <= FEW_BYTES else np.frombuffer(state, dtype=np.uint8)}
    for region in encoded.regions:
        contents[region.name] = np.frombuffer(region.memory, dtype=np.uint8)
    return contents


def encoded_of(contents: Contents, name: str) -> Encoded:
    """The encoded state that regions hold.

    Raises:
        StateFormatError: the state region is missing or cut off.
    """
    state = bytes(contents.get(STATE_NAME, b""))
    size = int.from_bytes(state[:SIZE_SIZE], "little")
    if not 0 < size <= len(state) - SIZE_SIZE:
        raise StateFormatError(f"{name}: the stored state is cut off: {len(state)} bytes say that {size} follow", name)
    regions = [EncodedRegion(key, _borrowed(content), "", ()) for key, content in contents.items() if key != STATE_NAME]
    return Encoded(state[SIZE_SIZE : SIZE_SIZE + size], tuple(regions))


def _nobody_counts() -> None:
    """The output of a program without a guard."""
    return


def _close_in_children(state: KeptState) -> None:
    """Locks belong to openings, which a forked child shares: a bank would stay locked while the child lives."""
    remembered = weakref.ref(state)

    def forked() -> None:
        known = remembered()
        if known is not None:
            known.forked()

    os.register_at_fork(after_in_child=forked)


def _borrowed(content: Bytes | bytes) -> memoryview:
    return memoryview(content) if isinstance(content, bytes) else content.data
