"""Merge several copies of pages into one buffer: each page once, from its newest copy. Pure, no system call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, Flags, PageMap, Words
from checkpoint.runtime.lazy_numpy import NDArray, np

LONG_COPY: Final = 1 << 18
"""Bytes that are copied by numpy, which lets other threads run meanwhile: this is also done inside programs."""


class Copy(Struct, frozen=True, eq=False):
    """A set of pages and their bytes, as they were at one moment.

    Attributes:
        content: of ``pages``, in address order; there may be room behind it.
    """

    pages: Words
    content: Buffer


def newest(copies: Sequence[Copy], page_size: int) -> PageMap:
    """For every page of any copy where its newest content lies: (index of the copy, index of the page there)."""
    found = PageMap.empty()
    for index, copy in enumerate(copies):
        addresses = page_set.addresses_of(copy.pages, page_size)
        places = np.empty((len(addresses), 2), dtype=np.uint64)
        places[:, 0] = index
        places[:, 1] = np.arange(len(addresses))
        found, _ = found.overlaid(addresses, places)
    return found


def are_zero(copies: Sequence[Copy], sources: PageMap, page_size: int) -> Flags:
    """For each page of ``sources`` whether all its bytes are zero."""
    zero: Flags = np.zeros(len(sources.addresses), dtype=np.bool_)
    for index, copy in enumerate(copies):
        if len(copy.pages):
            from_here = sources.words[:, 0] == np.uint64(index)
            zero[from_here] = page_set.zero_pages(copy.content, page_size)[sources.words[from_here, 1]]
    return zero


def gathered(contents: Sequence[Buffer], sources: PageMap, page_size: int) -> memoryview:
    """The content of every page, in address order."""
    return gathered_bytes(contents, sources, page_size).data.toreadonly()


def gathered_within(host: int, contents: Sequence[Buffer], sources: PageMap, page_size: int) -> memoryview | None:
    """As `gathered`, in the memory of the copy ``host``, which is overwritten: half of the memory for a large program.

    Returns:
        None where it cannot be, and nothing was changed: pages that are not there would have to come between those that are.
    """
    count = len(sources.addresses)
    if count * page_size > memoryview(contents[host]).nbytes:
        return None
    from_here = sources.words[:, 0] == np.uint64(host)
    if (sources.words[from_here, 1] < np.flatnonzero(from_here)).any():
        return None
    target = np.frombuffer(contents[host], dtype=np.uint8)  # as no page moves up, none is overwritten before it was moved
    _copy_stretches(contents, sources.words, target, page_size)
    return target[: count * page_size].data.toreadonly()


def gathered_bytes(contents: Sequence[Buffer], sources: PageMap, page_size: int) -> NDArray[np.uint8]:
    """The same, for a caller that has to change them yet. Neighbours from one copy are copied at once."""
    buffer = np.empty(len(sources.addresses) * page_size, dtype=np.uint8)
    _copy_stretches(contents, sources.words, buffer, page_size)
    return buffer


def _copy_stretches(contents: Sequence[Buffer], places: Words, buffer: NDArray[np.uint8], page_size: int) -> None:
    """Pages from their places to their order, from the first one on."""
    carried = [memoryview(content).cast("B") for content in contents]
    arrays = [np.frombuffer(content, dtype=np.uint8) for content in contents]
    target = buffer.data
    for first, (index, page), count in _stretches(places):
        begin, start, size = first * page_size, page * page_size, count * page_size
        if begin == start and arrays[index].ctypes.data == buffer.ctypes.data:
            continue
        if size < LONG_COPY:
            target[begin : begin + size] = carried[index][start : start + size]
        else:
            buffer[begin : begin + size] = arrays[index][start : start + size]


def _stretches(places: Words) -> list[tuple[int, tuple[int, int], int]]:
    """Where places follow one another: (index of the first, its place, how many)."""
    if not len(places):
        return []
    follows: NDArray[np.bool_] = (places[1:, 0] == places[:-1, 0]) & (places[1:, 1] == places[:-1, 1] + np.uint64(1))
    firsts = np.flatnonzero(np.concatenate(([True], ~follows)))
    counts = np.diff(np.append(firsts, len(places)))
    sources = map(tuple, places[firsts].tolist())
    return list(zip(firsts.tolist(), sources, counts.tolist(), strict=True))
