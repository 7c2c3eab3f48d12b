"""A base that lies in a file, its pages taken out piece by piece: of a large program no copy is made besides the program itself.

The outline is verified when the file is opened, each frame before anything is made of it, and what the pages add up to after the
last one: whoever takes pieces undoes everything where that fails.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import local
from typing import Final

import numpy as np
from msgspec.structs import replace

from checkpoint import carried, chain, format, frames, pages, side_by_side
from checkpoint.byte_sources import Reader, Source, opened
from checkpoint.frames import Frame
from checkpoint.layout import FRAME_SIZE
from checkpoint.model import Snapshot
from checkpoint.pages import Buffer, Words

NOTHING: Final = np.zeros((1, 2), dtype=np.uint64)

Taker = Callable[[Words, Buffer], None]
"""Does something with a set of pages and their bytes; several threads call it at once."""

ROW: Final = 4
"""Frames that a thread takes at once: to be woken, and to wait for the interpreter, take it as long as one of them."""
KEPT: Final = 4
"""Frames of which single bytes were asked, that stay decompressed: threads keep things of the same kind beside each other."""


class StoredBase:
    """A base and the file that it lies in, which stays open.

    Attributes:
        outline: the base without its bytes.

    Raises:
        FormatError: as ``checkpoint.format.read_outline``.
        ChainError: it is no base, or not the state that its position names.
    """

    def __init__(self, source: Source, reader: Reader) -> None:
        self._source = source
        self._reader = reader
        self._preamble, outline = format.outlined(reader)
        self.outline = chain.by_itself(outline)
        self._set = pages.extents(outline.runs)
        self._frames: list[Frame] = []
        self._decoded: dict[int, bytes] = {}

    def relocate(self, places: Mapping[str, str]) -> None:
        """See `checkpoint.carried.relocated`."""
        self.outline = carried.relocated(self.outline, places)

    def whole(self, threads: int) -> Snapshot:
        """With all of its bytes in memory.

        Raises:
            FormatError, ChainError: they are not what they were.
        """
        proved = chain.fold([format.decode(self._source, threads=threads)])
        return replace(self.outline, contents=proved.contents)

    def each(self, take: Taker, threads: int) -> None:
        """Have all pages taken, a few frames at a time.

        Raises:
            FormatError, ChainError: they are not what they were; some were taken.
        """
        page_size, own = self.outline.machine.page_size, local()

        def taken(numbered: tuple[Words, tuple[Frame, ...]]) -> Words:
            row, told = numbered
            if not hasattr(own, "buffer"):
                own.buffer = memoryview(bytearray(ROW * FRAME_SIZE))
            content = own.buffer[: pages.total_size(row)]
            for index, frame in enumerate(told):
                frames.read_frame(self._reader, frame, content[index * FRAME_SIZE :][: frame.head.raw_size])
            digests = pages.digest_pages(content, pages.addresses_of(row, page_size), page_size)
            take(row, content)
            return digests.sum(axis=0, keepdims=True, dtype=np.uint64)  # type: ignore[no-any-return]

        every = side_by_side.in_rows(frames.frames_of(self._reader, self._preamble), ROW)
        rows = zip(pages.cut(self._set, ROW * FRAME_SIZE), every, strict=True)
        sums = side_by_side.in_order(taken, rows, format.worth(threads, self._preamble))
        chain.check_sum(self.outline, pages.sum_of(np.concatenate([NOTHING, *sums])))

    def content_at(self, address: int, size: int) -> bytes | None:
        """Bytes of the program's memory, as far as the base carries the pages in one run; None where it does not.

        Raises:
            FormatError: they are not what they were.
        """
        place = pages.place_in(self._set, address, size)
        if place is None:
            return None
        first, last = place // FRAME_SIZE, (place + max(size, 1) - 1) // FRAME_SIZE
        content = b"".join(map(self._frame, range(first, last + 1)))
        return content[place - first * FRAME_SIZE :][:size]

    def _frame(self, index: int) -> bytes:
        if index not in self._decoded:
            self._frames = self._frames or list(frames.frames_of(self._reader, self._preamble))
            while len(self._decoded) >= KEPT:
                del self._decoded[next(iter(self._decoded))]
            self._decoded[index] = bytes(frames.content_of(self._reader, self._frames[index]))
        return self._decoded[index]


@contextmanager
def stored_base(source: Source) -> Iterator[StoredBase]:
    """Open one; a descriptor is borrowed for as long as it is used."""
    with opened(source) as reader:
        yield StoredBase(source, reader)
