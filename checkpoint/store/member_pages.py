"""Assemble the pages of each process, piece by piece, from a snapshot that stores each content once for several processes.

Processes that have forked have most of their memory in common. A separate copy for each, only to write it into a vessel, would
take as much additional memory as all of them will have.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from msgspec.structs import replace

from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.pages.source import Taker
from checkpoint.runtime import parallel
from checkpoint.runtime.lazy_numpy import NDArray
from checkpoint.runtime.parallel import OwnBuffers
from checkpoint.snapshot import process_tree

PIECE_SIZE: Final = 4 << 20
"""Bytes that are put together at a time: they stay in a processor's cache until they are written."""


class MemberPages:
    """The pages of one process, a `checkpoint.pages.source.PageSource`.

    Args:
        carried: its pages, extents at its own addresses.
        rows: pages of all processes, shape (count, page size), each content once.
        places: of each of its pages among those.
    """

    tells_zeros = False

    def __init__(self, carried: Words, rows: NDArray[np.uint8], places: NDArray[np.intp]) -> None:
        self._carried = carried
        self._rows = rows
        self._places = places

    def within(self, wanted: Words) -> MemberPages:
        """Its pages that are in a set."""
        addresses = page_set.addresses_of(self._carried, self._page_size)
        kept = page_set.covered(wanted, addresses)
        if kept.all():
            return self
        return MemberPages(page_set.extents_of_addresses(addresses[kept], self._page_size), self._rows, self._places[kept])

    def each(self, take: Taker, threads: int) -> None:
        """Have all pages taken, a piece at a time."""
        buffers = OwnBuffers(PIECE_SIZE)

        def taken(piece: tuple[Words, NDArray[np.intp]]) -> None:
            extents, places = piece
            content = buffers.own[: page_set.total_size(extents)]
            into = np.frombuffer(content, np.uint8).reshape(len(places), self._page_size)
            np.take(self._rows, places, axis=0, out=into, mode="clip")  # it would fill a copy first to be able to raise
            take(extents, content)

        is_little = len(self._places) * self._page_size <= PIECE_SIZE
        for _ in parallel.in_order(taken, self._pieces(), 1 if is_little else threads):
            pass

    def _pieces(self) -> Iterator[tuple[Words, NDArray[np.intp]]]:
        position = 0
        for extents in page_set.cut(self._carried, PIECE_SIZE):
            count = page_set.total_size(extents) // self._page_size
            yield extents, self._places[position : position + count]
            position += count

    def rows_at(self, some: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The bytes of some of its pages, by their number among these."""
        return self._rows[self._places[some]]

    def content_at(self, address: int, size: int) -> bytes | None:
        """Bytes of its memory, as far as its pages are carried in one run; None where they are not."""
        place = page_set.place_in(self._carried, address, size)
        if place is None:
            return None
        first, skipped = divmod(place, self._page_size)
        last = (place + size - 1) // self._page_size
        return self._rows[self._places[first : last + 1]].tobytes()[skipped : skipped + size]

    @property
    def _page_size(self) -> int:
        return int(self._rows.shape[1])


def apart(snapshot: Snapshot) -> tuple[tuple[Snapshot, ...], tuple[MemberPages | None, ...]]:
    """As `tree.views`; where pages are in common without their bytes, and where these are.

    Args:
        snapshot: a base, of one process or several.
    """
    if not snapshot.copies or not len(snapshot.contents):
        views = process_tree.views(snapshot)
        return views, (None,) * len(views)
    page_size = snapshot.machine.page_size
    addresses, places = page_set.with_copied(snapshot.runs, snapshot.copies, page_size)
    runs = page_set.page_runs(page_set.extents_of_addresses(addresses, page_size))
    views = process_tree.views(replace(snapshot, runs=runs, contents=b"", copies=()))
    rows = np.frombuffer(snapshot.contents, np.uint8).reshape(-1, page_size)
    slots = (0, *(member.slot for member in snapshot.members))
    bounds = np.array([(process_tree.base_of(slot), process_tree.base_of(slot + 1)) for slot in slots], np.uint64)
    parts = [slice(first, last) for first, last in np.searchsorted(addresses, bounds).tolist()]
    held = (MemberPages(page_set.extents(view.runs), rows, places[part]) for view, part in zip(views, parts, strict=True))
    return views, tuple(held)
