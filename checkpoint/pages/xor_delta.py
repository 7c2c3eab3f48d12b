"""Store a changed page in a delta as the XOR of its content with the parent's content. Pure.

A page that a program writes again is mostly unchanged, so the difference is mostly zeros and compresses several times better than
the page. The maker of a delta must have the parent's content at hand, and so must a reader that takes the delta alone. A whole
chain (`checkpoint.store.chain.fold`) needs nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeAlias

from msgspec.structs import replace

from checkpoint.model import PageRun, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, Flags, Words
from checkpoint.runtime.lazy_numpy import NDArray, np

Rows: TypeAlias = "NDArray[np.uint8]"
"""Bytes of pages, one row a page."""

Reference = Callable[[Words], Rows]
"""The content of a state at these addresses, which are in order; raises ChainError where there is no page."""

CHANGED_LIMIT: Final = 1 / 2
"""A page of which more than this part has changed is told whole: it compresses better by itself."""

SMALL_SIZE: Final = 8 << 20
"""Bytes of a delta that is copied for any difference in it."""

FEW_SHARE: Final = 8
"""A larger delta is told whole, and not copied, where less than one part in so many of its pages would be told as differences."""

HELD_SIZE: Final = 32 << 20
"""Bytes of earlier content that are asked for at once: of gigabytes never all, and seldom. Each time may read what all files of
the chain say of their pages: by 4 MB that took three times the processor time, of 128 MB in single pages."""


def rows_of(contents: Buffer, page_size: int) -> Rows:
    """A buffer of pages, one row each, not copied."""
    return np.frombuffer(contents, dtype=np.uint8).reshape(-1, page_size)


def addresses_of(runs: Iterable[PageRun], page_size: int) -> Words:
    """The address of every page, in order."""
    return page_set.addresses_of(page_set.extents(runs), page_size)


def are_worth_it(differences: Rows) -> Flags:
    """Which pages are better told by these differences."""
    words = differences.view(np.uint64)
    changed: Flags = np.count_nonzero(words, axis=1) <= words.shape[1] * CHANGED_LIMIT
    return changed


def tellable(delta: Snapshot) -> Words:
    """The pages of a delta that may be told as differences: their earlier content is there still, and no copy is of them.

    Returns:
        Their addresses, in order.
    """
    sources = [PageRun(copy.source, copy.source + copy.size) for copy in delta.copies]
    carried = addresses_of(delta.runs, delta.machine.page_size)
    return carried[~page_set.covered(page_set.extents((*delta.cleared, *sources)), carried)]


def told(delta: Snapshot, known: Words, contents: Rows) -> Snapshot:
    """The same delta, with those pages told as differences for which that is worth it.

    Args:
        delta: tells all of its pages whole.
        known: some of its `tellable` pages.
        contents: what the parent's state holds there.
    """
    page_size = delta.machine.page_size
    if not len(known):
        return delta
    whole = rows_of(delta.contents, page_size)
    places = np.searchsorted(addresses_of(delta.runs, page_size), known)
    differences = whole[places] ^ contents
    worth = are_worth_it(differences)
    if not worth.any() or (whole.nbytes > SMALL_SIZE and FEW_SHARE * np.count_nonzero(worth) < len(whole)):
        return delta
    changed = whole.copy()
    changed[places[worth]] = differences[worth]
    runs = page_set.page_runs(page_set.extents_of_addresses(known[worth], page_size))
    return replace(delta, contents=changed.reshape(-1).data.toreadonly(), differences=runs)


def resolved(delta: Snapshot, reference: Reference) -> Snapshot:
    """The same delta with all of its pages told whole.

    Args:
        reference: of its parent's state.

    Raises:
        ChainError: from ``reference``.
    """
    if not delta.differences:
        return delta
    page_size = delta.machine.page_size
    wanted = addresses_of(delta.differences, page_size)
    whole = rows_of(delta.contents, page_size).copy()
    whole[np.searchsorted(addresses_of(delta.runs, page_size), wanted)] ^= reference(wanted)
    return replace(delta, contents=whole.reshape(-1).data.toreadonly(), differences=())


def resolved_each(outline: Snapshot, pieces: Iterable[memoryview], reference: Reference) -> Iterator[memoryview]:
    """As `resolved`, of a delta whose pages come in pieces, each of whole pages: the pieces themselves are changed.

    Args:
        outline: the delta without its pages.
        pieces: in memory that may be changed.

    Raises:
        ChainError: from ``reference``.
    """
    if not outline.differences:
        yield from pieces
        return
    page_size = outline.machine.page_size
    wanted = addresses_of(outline.differences, page_size)
    places = np.searchsorted(addresses_of(outline.runs, page_size), wanted)
    first = asked = done = 0
    held = np.empty((0, page_size), dtype=np.uint8)
    for piece in pieces:
        rows = rows_of(piece, page_size)
        end = int(np.searchsorted(places, first + len(rows)))
        if end > done:
            if end > asked + len(held):
                asked, last = done, max(end, done + HELD_SIZE // page_size)
                held = reference(wanted[asked:last])
            rows[places[done:end] - first] ^= held[done - asked : end - asked]
        yield piece
        first, done = first + len(rows), end
