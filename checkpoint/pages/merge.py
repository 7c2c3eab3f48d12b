"""Merge several copies of pages into one buffer: each page once, from its newest copy. Pure, no system call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeAlias

from msgspec import Struct

from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, Flags, PageMap, Words
from checkpoint.runtime.lazy_numpy import NDArray, np

Places: TypeAlias = "NDArray[np.intp]"

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
            content = memoryview(copy.content)[: page_set.total_size(copy.pages)]  # not the room behind it, which may be large
            zero[from_here] = page_set.zero_pages(content, page_size)[sources.words[from_here, 1]]
    return zero


def gathered(contents: Sequence[Buffer], sources: PageMap, page_size: int) -> memoryview:
    """The content of every page, in address order."""
    return gathered_bytes(contents, sources, page_size).data.toreadonly()


def gathered_within(host: int, contents: Sequence[Buffer], sources: PageMap, page_size: int) -> memoryview | None:
    """As `gathered`, in the memory of the copy ``host``, which is overwritten: half of the memory for a large program.

    Returns:
        None where it has no room for all of them, and nothing was changed.
    """
    count, target = len(sources.addresses), memoryview(contents[host]).cast("B")
    if count * page_size > len(target):
        return None
    is_own = sources.words[:, 0] == np.uint64(host)
    places, own = np.flatnonzero(is_own), sources.words[is_own, 1].astype(np.intp)
    if (own < places).any():  # others come between them: all move down, and from there the last ones up first
        order = np.arange(len(own))
        _move(target, own, order, page_size)
        _move(target, order, places, page_size, is_up=True)
    else:
        _move(target, own, places, page_size)
    for first, (index, page), size in _stretches(sources.words):
        if index != host:
            part = np.frombuffer(contents[index], dtype=np.uint8, count=size * page_size, offset=page * page_size)
            np.frombuffer(target, dtype=np.uint8)[first * page_size :][: len(part)] = part
    return target[: count * page_size].toreadonly()


def _move(target: memoryview, sources: Places, places: Places, page_size: int, *, is_up: bool = False) -> None:
    """Pages of a buffer from their places, which are in order, to other ones in the same order: all of them down, or all up."""
    if not len(sources):
        return
    firsts = np.concatenate(([0], np.flatnonzero((np.diff(sources) != 1) | (np.diff(places) != 1)) + 1))
    sizes = np.diff(np.append(firsts, len(sources))) * page_size
    starts, begins = (sources[firsts] * page_size).tolist(), (places[firsts] * page_size).tolist()
    stretches = list(zip(starts, begins, sizes.tolist(), strict=True))
    for start, begin, size in reversed(stretches) if is_up else stretches:
        if start != begin:
            target[begin : begin + size] = target[start : start + size]  # which may overlap: numpy would copy it for that


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
