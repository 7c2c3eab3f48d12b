"""Fold a chain's files into the file of one base, frame by frame, without holding one of them whole.

A frame in which no page changed, came or went is copied as it is stored. So the work is proportional to the pages that changed or
moved: a page that comes or goes moves all that follow it.

The result is proved without reading the frames that were only copied. A page sum is a sum: the newest one is the base's, minus
the digests of pages that went or were replaced, plus the digests of the pages that are there now. The base's own was proved when
it came.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Flags, PageMap, Words
from checkpoint.pages.xor_delta import Rows, rows_of
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot import format, frames
from checkpoint.snapshot.frames import Body, DecodedFrames, FrameWriter, Packer, Sink
from checkpoint.snapshot.layout import FRAME_SIZE
from checkpoint.snapshot.validity import check_snapshot
from checkpoint.store import chain
from checkpoint.store.base_on_disk import StoredBase

KEPT: Final = 2
"""Frames of the base that stay decompressed: those of a new one lie in one of them or two, unless very many pages went."""


class Folding:
    """One chain of a base and deltas, about to be written as one base.

    Args:
        stored: the chain.
        outline: the base's, as it is to be written.

    Raises:
        FormatError: it would not hold together; the chain's own files are as they were.
    """

    def __init__(self, stored: StoredBase, outline: Snapshot) -> None:
        origins = stored.origins
        assert origins is not None, "a base by itself is folded"
        self._stored = stored
        self._outline = outline
        self._origins = origins
        self._page_size = outline.machine.page_size
        self._count = FRAME_SIZE // self._page_size
        contents_size = len(origins.sources.addresses) * self._page_size
        check_snapshot(outline, contents_size)
        self._preamble, self._sections = format.begin(outline, contents_size)
        self._base_addresses = page_set.addresses_of(stored.base_pages, self._page_size)
        self._told_anew = self._pages_told_anew()
        self._gone = self._pages_gone()
        self._decoded = DecodedFrames(stored.reader, stored.preamble, KEPT)
        self._seen: set[int] = set()
        self._packer = Packer(1)
        self._added: list[Words] = [np.empty((0, 2), dtype=np.uint64)]
        self._removed: list[Words] = [np.empty((0, 2), dtype=np.uint64)]

    def write(self, file: Sink) -> int:
        """Write it to an empty file; its size in bytes.

        Raises:
            FormatError: the base's file is not as it was written.
            ChainError: the pages do not add up to the newest position.
            OSError: the file does not take it.
        """
        frames.write_all(file, self._preamble.pack() + self._sections)
        writer = FrameWriter(file, self._preamble.frames_offset)
        for body in self._bodies():
            writer.add(body)
        self._require_sum()
        return writer.finish(self._preamble)

    def _pages_told_anew(self) -> Flags:
        """The pages of the state that a delta has told, whole or as a difference."""
        anew: Flags = self._origins.sources.words[:, 0] > 0
        anew[np.searchsorted(self._origins.sources.addresses, self._origins.changed)] = True
        return anew

    def _pages_gone(self) -> Flags:
        """The pages of the base whose content is not the state's any more."""
        kept = self._origins.sources.addresses[~self._told_anew]
        gone: Flags = np.ones(len(self._base_addresses), dtype=np.bool_)
        gone[np.searchsorted(self._base_addresses, kept)] = False
        return gone

    def _require_sum(self) -> None:
        for index in page_set.distinct(np.flatnonzero(self._gone).astype(np.uint64) // np.uint64(self._count)).tolist():
            self._rows_of_base(index)  # notes the pages that went, if they were not noted before
        before = chain.by_itself(self._stored.chain[0])
        after = page_set.add_to_sum(before.page_sum, np.concatenate(self._added), np.concatenate(self._removed))
        chain.check_sum(self._outline, after)

    def _bodies(self) -> Iterator[Body]:
        """Every frame of the result."""
        sources = self._origins.sources
        if not len(sources.addresses):
            return
        moved = sources.words[:, 1] != np.arange(len(sources.addresses), dtype=np.uint64)
        other = np.logical_or.reduceat(self._told_anew | moved, np.arange(0, len(moved), self._count))
        for index in range(self._preamble.frame_count):
            first = index * self._count
            last = min(first + self._count, len(sources.addresses))
            is_as_it_was = not other[index] and self._decoded.frames[index].head.raw_size == (last - first) * self._page_size
            yield self._copied(index) if is_as_it_was else self._made(first, last)

    def _copied(self, index: int) -> Body:
        """A frame of the base, as it is stored."""
        frame = self._decoded.frames[index]
        body = frames.verified(self._stored.reader, frame)
        return Body(frame.head.codec, body, frame.head.raw_size, frame.head.digest)

    def _made(self, first: int, last: int) -> Body:
        """A frame of some of the state's pages."""
        sources, anew = self._origins.sources, self._told_anew[first:last]
        state = PageMap(sources.addresses[first:last], sources.words[first:last])
        rows = self._rows(state)
        self._origins.lay_on(rows, state.addresses)
        if anew.any():
            self._added.append(page_set.digest_pages(rows[anew].data, state.addresses[anew], self._page_size))
        return self._packer(rows.reshape(-1).data)

    def _rows(self, state: PageMap) -> Rows:
        """The pages as they were last told whole."""
        rows = np.empty((len(state.addresses), self._page_size), dtype=np.uint8)
        is_base = state.words[:, 0] == 0
        places = state.words[is_base, 1]
        chosen = np.flatnonzero(is_base)
        for index in page_set.distinct(places // np.uint64(self._count)).tolist():
            here = places // np.uint64(self._count) == index
            told, within = self._rows_of_base(index), (places[here] % np.uint64(self._count)).astype(np.intp)
            first, shift = within[0], chosen[here][0] - within[0]
            if (chosen[here] == within + shift).all():  # as if no page came or went; those in between are overwritten below
                rows[first + shift : within[-1] + shift + 1] = told[first : within[-1] + 1]
            else:
                rows[chosen[here]] = told[within]
        if not is_base.all():
            later = PageMap(state.addresses[~is_base], state.words[~is_base])
            rows[~is_base] = rows_of(self._origins.whole(self._stored.chain, later).data, self._page_size)
        return rows

    def _rows_of_base(self, index: int) -> Rows:
        """The pages of one of the base's frames; those that went are counted when they are seen for the first time."""
        rows = rows_of(self._decoded[index], self._page_size)
        if index not in self._seen:
            self._seen.add(index)
            here = slice(index * self._count, index * self._count + len(rows))
            gone = self._gone[here]
            if gone.any():
                self._removed.append(page_set.digest_pages(rows[gone].data, self._base_addresses[here][gone], self._page_size))
        return rows
