"""A base of a program that stands still, its pages read as they are written to a file: no copy of them all is made.

The counterpart of `checkpoint.stored_base`. What tells of the pages, their sum and the position's digest, stands before them in
the file, and is known after the last one: so it is written last.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from io import RawIOBase
from threading import local
from typing import Final

import numpy as np
from blake3 import blake3
from msgspec import Struct
from msgspec.structs import replace

from checkpoint import chain, format, frames, layout, pages, side_by_side
from checkpoint.frames import Body, Packer
from checkpoint.layout import FRAME_SIZE, Codec, Preamble
from checkpoint.model import Snapshot
from checkpoint.pages import Words
from checkpoint.validity import check_snapshot

ROW: Final = 4
"""Frames that a thread makes at once: to be woken, and to wait for the interpreter, take it as long as one of them."""


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
        heads: list[bytes] = []
        sums, offset = [np.zeros((1, 2), dtype=np.uint64)], preamble.frames_offset
        wanted = pages.cut(pages.extents(self.outline.runs), ROW * FRAME_SIZE)
        with closing(side_by_side.in_order(_Frames(self, threads), wanted, format.worth(threads, preamble))) as rows:
            for bodies, summed in rows:
                sums.append(summed)
                for body in bodies:
                    head, size = frames.write_frame(file, body, offset)
                    heads.append(head)
                    offset += size
        return self._finish(file, pages.sum_of(np.concatenate(sums)), preamble, heads, offset)

    def _finish(self, file: RawIOBase, page_sum: bytes, draft: Preamble, heads: list[bytes], end: int) -> tuple[Snapshot, int]:
        """Write what is known now, after the frames and before them."""
        told = replace(self.outline, page_sum=page_sum)
        position = chain.position_of(told, told.position.generation, told.position.sequence)
        told = replace(told, position=position)
        preamble, sections = format.begin(told, draft.contents_size)
        assert preamble.frames_offset == draft.frames_offset, "a sum and a digest are as long whatever they are"
        seal = blake3(preamble.pack() + b"".join(heads))
        file_size = end + layout.TRAILER_SIZE
        frames.write_all(file, layout.pack_trailer(file_size, seal))
        file.seek(0)
        frames.write_all(file, preamble.pack() + sections)
        return told, file_size


class _Frames:
    """Reads pages and makes frames of them, in several threads: each has a buffer, which stays in its processor's cache."""

    def __init__(self, base: UnreadBase, threads: int) -> None:
        self._read = base.read
        self._page_size = base.outline.machine.page_size
        self._packer = Packer(threads)
        self._own = local()

    def __call__(self, row: Words) -> tuple[list[Body], Words]:
        """The frames of these pages, and the sum of their digests."""
        raw = self._buffer()[: pages.total_size(row)]
        self._read(row, raw)
        digests = pages.digest_pages(raw, pages.addresses_of(row, self._page_size), self._page_size)
        bodies = self._packer.each([raw[begin : begin + FRAME_SIZE] for begin in range(0, len(raw), FRAME_SIZE)])
        if any(body.codec is Codec.RAW for body in bodies):
            del self._own.buffer  # it is theirs now
        return bodies, digests.sum(axis=0, keepdims=True, dtype=np.uint64)

    def _buffer(self) -> memoryview:
        if not hasattr(self._own, "buffer"):
            self._own.buffer = memoryview(bytearray(ROW * FRAME_SIZE))
        return self._own.buffer  # type: ignore[no-any-return]
