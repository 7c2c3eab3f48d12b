"""Write a base directly from a frozen program to a file, without a copy of all its pages.

The counterpart of `checkpoint.store.base_on_disk`. The sum of the pages and the digest of the position come before the pages in
the file, but are known only after the last page: so they are written last.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from io import RawIOBase

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.runtime import parallel
from checkpoint.runtime.parallel import OwnBuffers
from checkpoint.snapshot import format
from checkpoint.snapshot.frames import ROW, Body, FrameWriter, Packer, write_all
from checkpoint.snapshot.layout import FRAME_SIZE, Codec, Preamble
from checkpoint.snapshot.validity import check_snapshot
from checkpoint.store import chain


class UnreadBase(Struct, frozen=True):
    """One that is still in its program.

    Attributes:
        outline: all but the bytes of its pages, their sum, and the digest of its position.
        read: fills a buffer with the bytes of a set of pages, which are in order; several threads call it at once.
    """

    outline: Snapshot
    read: Callable[[Words, memoryview], None]

    def write(self, file: RawIOBase, threads: int) -> tuple[Snapshot, int]:
        """Write it to an empty file.

        Returns:
            The base without the bytes of its pages, and the size of the file in bytes.

        Raises:
            FormatError: it does not hold together; nothing was written.
            CaptureError, ProcessGoneError: a page cannot be read.
            OSError: the file does not take it.
        """
        contents_size = sum(run.size for run in self.outline.runs)
        check_snapshot(self.outline, contents_size)
        preamble = format.begin(self.outline, contents_size)[0]
        file.seek(preamble.frames_offset)
        writer, sums = FrameWriter(file, preamble.frames_offset), [np.zeros((1, 2), dtype=np.uint64)]
        wanted = page_set.cut(page_set.extents(self.outline.runs), ROW * FRAME_SIZE)
        with closing(parallel.in_order(_Frames(self, threads), wanted, format.worth(threads, preamble))) as rows:
            for bodies, summed in rows:
                sums.append(summed)
                for body in bodies:
                    writer.add(body)
        return self._finish(file, writer, preamble, page_set.sum_of(np.concatenate(sums)))

    def _finish(self, file: RawIOBase, writer: FrameWriter, draft: Preamble, page_sum: bytes) -> tuple[Snapshot, int]:
        """Write the parts that are known now, after the frames and before them."""
        told = replace(self.outline, page_sum=page_sum)
        position = chain.position_of(told, told.position.generation, told.position.sequence)
        told = replace(told, position=position)
        preamble, sections = format.begin(told, draft.contents_size)
        assert preamble.frames_offset == draft.frames_offset, "a sum and a digest are as long for any content"
        file_size = writer.finish(preamble)
        file.seek(0)
        write_all(file, preamble.pack() + sections)
        return told, file_size


class _Frames:
    """Reads pages and makes frames of them, in several threads: each has a buffer, which stays in its processor's cache."""

    def __init__(self, base: UnreadBase, threads: int) -> None:
        self._read = base.read
        self._page_size = base.outline.machine.page_size
        self._packer = Packer(threads)
        self._buffers = OwnBuffers(ROW * FRAME_SIZE)

    def __call__(self, row: Words) -> tuple[list[Body], Words]:
        """The frames of these pages, and the sum of their digests."""
        raw = self._buffers.own[: page_set.total_size(row)]
        self._read(row, raw)
        digests = page_set.digest_pages(raw, page_set.addresses_of(row, self._page_size), self._page_size)
        bodies = self._packer.each([raw[begin : begin + FRAME_SIZE] for begin in range(0, len(raw), FRAME_SIZE)])
        if any(body.codec is Codec.RAW for body in bodies):
            self._buffers.give_away()
        return bodies, digests.sum(axis=0, keepdims=True, dtype=np.uint64)
