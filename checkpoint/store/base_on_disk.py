"""Read a base from its file piece by piece, so that restoring a large program needs no second copy of it in memory.

The deltas that continue it are much smaller and are held in memory; the module reads the state that base and deltas amount to.
The pages of a base of several processes are put together only as a whole, and so are those of its chain.

The outline is verified when the files are opened, each frame before it is used, and the sum of all pages after the last one: a
user that takes pieces must undo everything if that last check fails.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, PageMap, Words
from checkpoint.pages.source import Taker
from checkpoint.pages.xor_delta import rows_of
from checkpoint.runtime import parallel
from checkpoint.runtime.lazy_numpy import np
from checkpoint.runtime.parallel import OwnBuffers
from checkpoint.snapshot import carried_files, format, frames
from checkpoint.snapshot.byte_sources import Reader, Source, opened
from checkpoint.snapshot.frames import ROW, DecodedFrames, Frame
from checkpoint.snapshot.layout import FRAME_SIZE
from checkpoint.store import chain
from checkpoint.store.page_origins import Origins

KEPT: Final = 4
"""Frames of which single bytes were asked, that stay decompressed: threads keep things of the same kind beside each other."""


class StoredBase:
    """The state that a chain's files amount to; the base's file stays open. A `checkpoint.pages.source.PageSource`.

    Attributes:
        outline: that state, without its bytes.
        reader: of the base's file; ``preamble``: its own; ``base_pages``: those that it tells.
        chain: the files as read: the base without its bytes, and the deltas.
        origins: where its pages come from; None where there are no deltas.

    Raises:
        FormatError: as ``checkpoint.format.decode``, but for what the base's pages would tell.
        ChainError: it is no chain, or not the state that its position names.
    """

    tells_zeros = True
    """A base that went straight to its file has them (`checkpoint.store.base_in_process`)."""

    def __init__(self, source: Source, reader: Reader, deltas: Sequence[Snapshot] = ()) -> None:
        self._source = source
        self.reader = reader
        self.preamble, base = format.outlined(reader)
        self.chain = (base, *deltas)
        self.base_pages = page_set.extents(base.runs)
        format.check_contents_size(self.preamble.contents_size)
        self._decoded = DecodedFrames(reader, self.preamble, KEPT)
        self.origins: Origins | None = None
        if deltas:
            self.outline, self.origins = chain.outlined(self.chain)
        else:
            self.outline = chain.by_itself(base)

    def relocate(self, places: Mapping[str, str]) -> None:
        """See `checkpoint.snapshot.carried_files.relocated`."""
        self.outline = carried_files.relocated(self.outline, places)

    def whole(self, threads: int) -> Snapshot:
        """With all of its bytes in memory.

        Raises:
            FormatError, ChainError: they are not what they were.
        """
        proved = chain.fold([format.decode(self._source, threads=threads), *self.chain[1:]])
        return replace(self.outline, contents=proved.contents)

    # All pages

    def within(self, wanted: Words) -> StoredBase:
        """Itself: pages that are left out could not be proved."""
        return self

    def each(self, take: Taker, threads: int) -> None:
        """Have all pages taken, a few frames at a time.

        Raises:
            FormatError, ChainError: they are not what they were; some were taken.
        """
        sums = [_nothing(), *self._of_base(take, threads), *self._of_deltas(take)]
        chain.check_sum(self.outline, page_set.sum_of(np.concatenate(sums)))

    def _of_base(self, take: Taker, threads: int) -> Iterator[Words]:
        """Have those taken that the base tells; the sums of their digests."""
        buffers = OwnBuffers(ROW * FRAME_SIZE)

        def taken(numbered: tuple[Words, tuple[Frame, ...]]) -> Words:
            row, told = numbered
            content = buffers.own[: page_set.total_size(row)]
            for index, frame in enumerate(told):
                frames.read_frame(self.reader, frame, content[index * FRAME_SIZE :][: frame.head.raw_size])
            return self._passed_on(take, *self._current(row, content))

        every = parallel.in_rows(frames.frames_of(self.reader, self.preamble), ROW)
        rows = zip(page_set.cut(self.base_pages, ROW * FRAME_SIZE), every, strict=True)
        yield from parallel.in_order(taken, rows, format.worth(threads, self.preamble))

    def _current(self, row: Words, content: memoryview) -> tuple[Words, Buffer]:
        """The pages of the base that the deltas have left, with the deltas' changes in them."""
        if self.origins is None:
            return row, content
        sources, addresses = self.origins.sources, page_set.addresses_of(row, self._page_size)
        found, places = page_set.found_among(sources.addresses, addresses)
        found[found] = sources.words[places, 0] == 0
        rows = rows_of(content, self._page_size)
        rows = rows if found.all() else rows[found]
        self.origins.lay_on(rows, addresses[found])
        return page_set.extents_of_addresses(addresses[found], self._page_size), rows.reshape(-1).data

    def _of_deltas(self, take: Taker) -> Iterator[Words]:
        """Have those taken that deltas have told whole; the sums of their digests."""
        if self.origins is None:
            return
        sources = self.origins.sources
        later = sources.words[:, 0] > 0
        theirs = PageMap(sources.addresses[later], sources.words[later])
        contents, position = self.origins.gathered(self.chain, theirs).data, 0
        for row in page_set.cut(page_set.extents_of_addresses(theirs.addresses, self._page_size), ROW * FRAME_SIZE):
            size = page_set.total_size(row)
            yield self._passed_on(take, row, contents[position : position + size])
            position += size

    def _passed_on(self, take: Taker, row: Words, content: Buffer) -> Words:
        if not len(row):
            return _nothing()
        digests = page_set.digest_pages(content, page_set.addresses_of(row, self._page_size), self._page_size)
        take(row, content)
        summed: Words = digests.sum(axis=0, keepdims=True, dtype=np.uint64)
        return summed

    @property
    def _page_size(self) -> int:
        return self.outline.machine.page_size

    # Single bytes

    def content_at(self, address: int, size: int) -> bytes | None:
        """Bytes of the program's memory, as far as the base carries the pages in one run; None where it does not.

        Raises:
            FormatError: they are not what they were.
        """
        if page_set.place_in(self._carried, address, size) is None:
            return None
        first = address // self._page_size * self._page_size
        content = b"".join(map(self._page, range(first, address + size, self._page_size)))
        return content[address - first :][:size]

    @property
    def _carried(self) -> Words:
        return self.base_pages if self.origins is None else page_set.extents(self.outline.runs)

    def _page(self, address: int) -> bytes:
        if self.origins is not None:
            sources = self.origins.sources
            index = int(np.searchsorted(sources.addresses, np.uint64(address)))
            one = PageMap(sources.addresses[index : index + 1], sources.words[index : index + 1])
            if one.words[0, 0] > 0:
                return self.origins.gathered(self.chain, one).tobytes()
        place = page_set.place_in(self.base_pages, address, self._page_size)
        assert place is not None, "it is carried"
        content = self._decoded[place // FRAME_SIZE][place % FRAME_SIZE :][: self._page_size]
        page = np.array([[address, address + self._page_size]], dtype=np.uint64)
        return bytes(self._current(page, memoryview(bytearray(content)))[1])


def _nothing() -> Words:
    """The sum of no digests."""
    return np.zeros((1, 2), dtype=np.uint64)


@contextmanager
def stored_base(*sources: Source) -> Iterator[StoredBase]:
    """Open what a chain's files amount to; a descriptor is borrowed for as long as it is used.

    Raises:
        FormatError, ChainError: see `StoredBase`.
    """
    base, *deltas = sources
    with opened(base) as reader:
        yield StoredBase(base, reader, [format.decode(delta) for delta in deltas])


@contextmanager
def stored_chain(base: Path, deltas: Sequence[Snapshot]) -> Iterator[StoredBase]:
    """The same of deltas that have been read. Errors of the body are not about the file, and do not name it."""
    try:
        file = open(base, "rb", buffering=0)  # noqa: SIM115
    except OSError as error:
        raise FormatError(f"cannot open snapshot {base}: {error.strerror}") from error
    with file, opened(file.fileno()) as reader:
        yield StoredBase(base, reader, deltas)
