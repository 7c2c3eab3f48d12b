"""Sets of pages, zero pages and page sums: arithmetic over arrays, no system call.

A *set of pages* here is a numpy array of shape ``(count, 2)`` and type uint64: extents ``[start, end)`` in address order that
neither touch nor overlap. Every function below returns such arrays; ``extents`` makes one from any input.

The *page sum* is the sum, in two words modulo 2⁶⁴, of the digests of all pages that a state holds. It does not depend on the
order of the pages, so writing, adding or dropping a page changes it by that page's digest alone. It finds accidents and diverged
histories; it does not protect against an attacker (the file's blake3 digests do).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import xxhash
from msgspec import Struct

from checkpoint.model import PageCopy, PageRun, Vma
from checkpoint.runtime.lazy_numpy import NDArray, np

Words: TypeAlias = "NDArray[np.uint64]"
"""Unsigned 64-bit words: addresses (count,), extents (count, 2) or lanes of digests (count, 2)."""

Flags: TypeAlias = "NDArray[np.bool_]"
Buffer = bytes | bytearray | memoryview
"""Bytes of pages, in address order."""

DIGEST_SIZE = 16
"""Bytes of one page digest, and of a page sum."""

EMPTY_SUM = bytes(DIGEST_SIZE)
"""The page sum of a state that holds no page."""

_LANE = "<u8"

MANY_ADDRESSES = 1024
"""So many are looked up one by one faster than the work on whole arrays is begun."""

DIGESTED = 1024
"""Pages digested at a time: less than a millisecond, after which another thread of a program may run."""


# Sets of pages


class Mappings(tuple[Vma, ...]):
    """The mappings of a process, of which every step of a snapshot asks what they cover: worked out once for this very object.

    Attributes:
        sound_for: the page size for which `checkpoint.snapshot.validity` found them well-formed; 0: not looked yet.
    """

    sound_for = 0

    @functools.cached_property
    def extents(self) -> Words:
        """The set that they cover; read-only."""
        return _read_only(_extents(self))

    def know(self, bounds: Words) -> None:
        """Take what they cover from their starts and ends, which have been worked out."""
        self.extents = _read_only(joined(bounds))

    @functools.cached_property
    def guarded(self) -> tuple[Vma, ...]:
        """Those of them that have guards."""
        return tuple(vma for vma in self if vma.guards)


def extents(runs: Iterable[PageRun | PageCopy | Vma]) -> Words:
    """The set that runs or mappings cover, in any order and overlap."""
    return runs.extents if isinstance(runs, Mappings) else _extents(runs)


def _extents(runs: Iterable[PageRun | PageCopy | Vma]) -> Words:
    edges = [edge for run in runs if run.start < run.end for edge in (run.start, run.end)]
    return joined(np.array(edges, dtype=np.uint64).reshape(-1, 2))


def _read_only(found: Words) -> Words:
    found.setflags(write=False)
    return found


def joined(told: Words) -> Words:
    """The set that such pairs cover; none of them is empty."""
    if len(told) < 2 or (told[1:, 0] > told[:-1, 1]).all():
        return told  # as most come: in order, and none touches the next
    ordered = told[told[:, 0].argsort(kind="stable")]
    reach = np.maximum.accumulate(ordered[:, 1])
    first = np.concatenate(([True], ordered[1:, 0] > reach[:-1]))
    last = np.concatenate((first[1:], [True]))
    return np.stack((ordered[first, 0], reach[last]), axis=1)


def distinct(values: Words) -> Words:
    """Each value once, in order (numpy's own loads its masked arrays to say so, which takes 8 ms)."""
    ordered = np.sort(values)
    found: Words = ordered[np.concatenate((np.ones(min(len(ordered), 1), dtype=np.bool_), ordered[1:] != ordered[:-1]))]
    return found


def page_runs(pages: Words) -> tuple[PageRun, ...]:
    """The same set as the model's values."""
    return tuple(PageRun(start, end) for start, end in pages.tolist())


def union(left: Words, right: Words) -> Words:
    """Pages of either set."""
    if not len(right):
        return left
    if not len(left):
        return right
    return _combined(left, right, np.logical_or)


def intersection(left: Words, right: Words) -> Words:
    """Pages of both sets."""
    if not len(left) or not len(right):
        return left[:0]
    return _combined(left, right, np.logical_and)


def difference(left: Words, right: Words) -> Words:
    """Pages of ``left`` that are not in ``right``."""
    if not len(left) or not len(right):
        return left
    return _combined(left, right, np.greater)


def _combined(left: Words, right: Words, rule: Callable[[Flags, Flags], Flags]) -> Words:
    """Walk over every boundary of both sets; an extent opens and closes where the rule's answer changes."""
    points = np.concatenate((left.reshape(-1), right.reshape(-1)))
    points.sort()  # a boundary of both stands twice: the second one changes nothing
    inside = rule(covered(left, points), covered(right, points))
    return points[_changes(inside)].reshape(-1, 2)


def _changes(flags: Flags) -> Flags:
    """Which differ from the one before; before the first all are false."""
    changes: Flags = flags.copy()
    np.not_equal(flags[1:], flags[:-1], out=changes[1:])
    return changes


def covered(pages: Words, addresses: Words) -> Flags:
    """For each address whether it lies in the set: behind an odd number of boundaries."""
    inside: Flags = pages.reshape(-1).searchsorted(addresses, side="right") & 1 == 1
    return inside


def covers(pages: Words, others: Words) -> bool:
    """Whether every page of the second set is in the first."""
    if not len(others):
        return True
    place = pages[:, 1].searchsorted(others[:, 0], side="right")
    if place[-1] >= len(pages):
        return False
    around = pages[place]
    return bool((around[:, 0] <= others[:, 0]).all() and (others[:, 1] <= around[:, 1]).all())


def total_size(pages: Words) -> int:
    """Bytes that the set covers."""
    return int((pages[:, 1] - pages[:, 0]).sum()) if len(pages) else 0


def place_in(pages: Words, address: int, size: int) -> int | None:
    """How many bytes of the set lie before an address; None where not all of so many bytes from there on are in one extent."""
    index = int(np.searchsorted(pages[:, 1], np.uint64(address), side="right"))
    if index == len(pages) or int(pages[index, 0]) > address or address + size > int(pages[index, 1]):
        return None
    return total_size(pages[:index]) + address - int(pages[index, 0])


def cut(pages: Words, size: int) -> list[Words]:
    """The same set in pieces of so many bytes, the last one perhaps shorter; also of stretches that are in no order."""
    lengths = pages[:, 1] - pages[:, 0]
    ends = np.cumsum(lengths, dtype=np.uint64)
    begins = ends - lengths
    total = int(lengths.sum())
    heads = np.array(range(0, total, size), np.uint64)
    if not len(heads):
        return []
    cuts = distinct(np.concatenate([begins, heads]))
    within = np.searchsorted(ends, cuts, side="right")
    starts = pages[within, 0] + (cuts - begins[within])
    parts = np.column_stack([starts, starts + np.append(cuts[1:], np.uint64(total)) - cuts])
    return np.split(parts, np.searchsorted(cuts, heads)[1:])


def addresses_of(pages: Words, page_size: int) -> Words:
    """The address of every page of the set, in order."""
    sizes = pages[:, 1] - pages[:, 0]
    if (sizes == page_size).all():  # as those of most deltas
        return pages[:, 0].copy()
    counts = (sizes // np.uint64(page_size)).astype(np.int64)
    firsts = np.repeat(pages[:, 0], counts)
    index_in_run = np.arange(len(firsts)) - np.repeat(np.cumsum(counts) - counts, counts)
    return firsts + index_in_run.astype(np.uint64) * np.uint64(page_size)


def found_among(addresses: Words, wanted: Words) -> tuple[Flags, NDArray[np.intp]]:
    """Which of the wanted addresses are among these, and the places of those; both in order and all different."""
    places = np.searchsorted(addresses, wanted)
    found: Flags = places < len(addresses)
    found[found] = addresses[places[found]] == wanted[found]
    return found, places[found]


def copied_pages(copies: Sequence[PageCopy], carried: Words, page_size: int) -> tuple[Words, NDArray[np.intp]]:
    """The addresses of copied pages, and the place of each one's source among the carried ones.

    Args:
        carried: addresses of the carried pages, in order.
    """
    targets = addresses_of(np.array([(copy.start, copy.end) for copy in copies], dtype=np.uint64).reshape(-1, 2), page_size)
    pairs = np.array([(copy.source, copy.source + copy.size) for copy in copies], dtype=np.uint64).reshape(-1, 2)
    return targets, np.searchsorted(carried, addresses_of(pairs, page_size))


def with_copied(runs: Iterable[PageRun], copies: Sequence[PageCopy], page_size: int) -> tuple[Words, NDArray[np.intp]]:
    """The addresses of all pages that are told, in order, and the place of each one's bytes among those that are carried."""
    carried = addresses_of(extents(runs), page_size)
    if not copies:
        return carried, np.arange(len(carried))
    copied, places = copied_pages(copies, carried, page_size)
    addresses = np.concatenate((carried, copied))
    order = np.argsort(addresses)
    return addresses[order], np.concatenate((np.arange(len(carried)), places))[order]


def copies_of(targets: Words, sources: Words, page_size: int) -> tuple[PageCopy, ...]:
    """Pages and those whose content they have, as few copies as there can be.

    Args:
        targets, sources: addresses, pair by pair; the former in order.
    """
    if not len(targets):
        return ()
    step = np.uint64(page_size)
    breaks = np.flatnonzero((targets[1:] != targets[:-1] + step) | (sources[1:] != sources[:-1] + step)) + 1
    firsts = np.concatenate(([0], breaks))
    lasts = np.concatenate((breaks, [len(targets)])) - 1
    rows = zip(targets[firsts].tolist(), targets[lasts].tolist(), sources[firsts].tolist(), strict=True)
    return tuple(PageCopy(start, last + page_size, source) for start, last, source in rows)


def extents_of_addresses(addresses: Words, page_size: int) -> Words:
    """The set of the pages at these addresses, which are in order and all different."""
    if not len(addresses):
        return np.empty((0, 2), dtype=np.uint64)
    step = np.uint64(page_size)
    breaks = (addresses[1:] - addresses[:-1] != step).nonzero()[0]
    found = np.empty((len(breaks) + 1, 2), dtype=np.uint64)
    found[0, 0], found[1:, 0] = addresses[0], addresses[breaks + 1]
    found[:-1, 1], found[-1, 1] = addresses[breaks] + step, addresses[-1] + step
    return found


# Contents of pages


def zero_pages(contents: Buffer, page_size: int) -> Flags:
    """For each page of the buffer whether all its bytes are zero."""
    words = _rows(contents, page_size).view(np.uint64)
    samples = words[:, :: max(1, words.shape[1] // 4)]
    zero: Flags = np.logical_not(samples.any(axis=1))  # most pages are known not to be zero by four of their words
    candidates = np.flatnonzero(zero)
    zero[candidates] = np.logical_not(words[candidates].any(axis=1))
    return zero


def digest_pages(contents: Buffer, addresses: Words, page_size: int, places: NDArray[np.intp] | None = None) -> Words:
    """The digest of each page: two little-endian lanes of xxh3_128 with the page's address as the seed.

    Args:
        contents: ``len(addresses) × page_size`` bytes, unless there are ``places``.
        places: of each page among those of ``contents``, of which several may have one.

    Returns:
        Lanes of shape ``(count, 2)``.
    """
    rows = _rows(contents, page_size)
    assert len(addresses) == len(rows if places is None else places), "one address for every page"
    seeds = addresses.tolist()
    some = (slice(first, first + DIGESTED) for first in range(0, len(seeds), DIGESTED))
    packed = b"".join(
        b"".join(map(xxhash.xxh3_128_digest, rows[part if places is None else places[part]], seeds[part])) for part in some
    )
    return np.frombuffer(packed, dtype=_LANE).astype(np.uint64, copy=False).reshape(-1, 2)


def _digest_each(
    pieces: Iterable[Buffer], addresses: Words, page_size: int, copied: Words, places: NDArray[np.intp] | None
) -> Words:
    """The digests of pages that come in pieces, and behind them those of copied pages, with the places of their bytes."""
    digests = np.empty((len(addresses) + len(copied), 2), dtype=np.uint64)
    last = 0
    for piece in pieces:
        first, last = last, last + memoryview(piece).nbytes // page_size
        digests[first:last] = digest_pages(piece, addresses[first:last], page_size)
        if places is not None:
            here = np.flatnonzero((places >= first) & (places < last))
            digests[len(addresses) + here] = digest_pages(piece, copied[here], page_size, places[here] - first)
    assert last == len(addresses), "each page has its bytes: a decoded outline's runs are as long as its frames"
    return digests


def sum_of(lanes: Words) -> bytes:
    """The page sum of the pages with these digests, 16 bytes."""
    return _packed(lanes.sum(axis=0, dtype=np.uint64))


def add_to_sum(page_sum: bytes, added: Words, removed: Words) -> bytes:
    """The page sum after pages with the digests ``added`` came and those with ``removed`` went."""
    lanes = np.frombuffer(page_sum, dtype=_LANE).astype(np.uint64)
    return _packed(lanes + added.sum(axis=0, dtype=np.uint64) - removed.sum(axis=0, dtype=np.uint64))


def _packed(lanes: Words) -> bytes:
    return lanes.astype(_LANE).tobytes()


def _rows(contents: Buffer, page_size: int) -> NDArray[np.uint8]:
    """The buffer as one row a page, without copying."""
    return np.frombuffer(contents, dtype=np.uint8).reshape(-1, page_size)


# The content of a state at each page


class PageMap(Struct, frozen=True, eq=False):
    """Which pages a state holds, and two words about each (a digest, or where its content lies).

    Attributes:
        addresses: in order, all different.
        words: shape ``(len(addresses), 2)``.
    """

    addresses: Words
    words: Words

    @classmethod
    def empty(cls) -> PageMap:
        """A state without pages."""
        return cls(np.empty(0, dtype=np.uint64), np.empty((0, 2), dtype=np.uint64))

    def without(self, kept: Words, forgotten: Words) -> tuple[PageMap, Words]:
        """Drop the pages outside the set ``kept`` and those in ``forgotten``.

        Returns:
            The rest, and the words of the pages that went.
        """
        dropped = ~_covered_in_order(kept, self.addresses)
        if len(forgotten):
            dropped |= _covered_in_order(forgotten, self.addresses)
        if not dropped.any():
            return self, self.words[:0]
        return PageMap(self.addresses[~dropped], self.words[~dropped]), self.words[dropped]

    def overlaid(self, addresses: Words, words: Words) -> tuple[PageMap, Words]:
        """Set pages, replacing or adding; ``addresses`` are in order and all different.

        Returns:
            The new map, and the words of the pages that were replaced.
        """
        if not len(self.addresses):
            return PageMap(addresses, words), self.words[:0]
        places = self.addresses.searchsorted(addresses)
        known = self.addresses[np.minimum(places, len(self.addresses) - 1)] == addresses
        replaced = self.words[places[known]]
        changed = self.words.copy()
        changed[places[known]] = words[known]
        if known.all():
            return PageMap(self.addresses, changed), replaced
        fresh = ~known
        return (
            PageMap(
                np.insert(self.addresses, places[fresh], addresses[fresh]),
                np.insert(changed, places[fresh], words[fresh], axis=0),
            ),
            replaced,
        )


def _covered_in_order(pages: Words, addresses: Words) -> Flags:
    """Like ``covered``, for addresses in order: the work grows with the extents, not with the addresses, where those are many."""
    if len(addresses) <= MANY_ADDRESSES:
        return covered(pages, addresses)
    edges = np.zeros(len(addresses) + 1, dtype=np.int32)
    np.add.at(edges, np.searchsorted(addresses, pages[:, 0]), 1)
    np.subtract.at(edges, np.searchsorted(addresses, pages[:, 1]), 1)
    inside: Flags = np.cumsum(edges[:-1]) > 0
    return inside


class PageTable(Struct, frozen=True, eq=False):
    """The digest of every page of a state, and their sum. Immutable: ``apply`` answers with the next one.

    Kept by the side that captures, to know the sum without hashing the whole, and by the side that checks a chain.

    Attributes:
        page_sum: as in ``Snapshot.page_sum``.
        within: mappings in which all of its pages are known to lie; None: not known.
    """

    page_size: int
    pages: PageMap
    page_sum: bytes
    within: Words | None = None

    @classmethod
    def empty(cls, page_size: int) -> PageTable:
        """The table of a state without pages."""
        return cls(page_size, PageMap.empty(), EMPTY_SUM)

    def apply(
        self,
        cleared: Iterable[PageRun],
        runs: Iterable[PageRun],
        contents: Buffer,
        vmas: Iterable[Vma | PageRun],
        copies: Sequence[PageCopy] = (),
    ) -> PageTable:
        """The table after a snapshot: drop what lies outside ``vmas`` or in ``cleared``, then set the pages of ``runs``.

        Args:
            contents: bytes of ``runs``, in address order.
            copies: pages with the bytes of others of ``runs``.
        """
        return self.apply_each(cleared, runs, (contents,), vmas, copies)

    def apply_each(
        self,
        cleared: Iterable[PageRun],
        runs: Iterable[PageRun],
        pieces: Iterable[Buffer],
        vmas: Iterable[Vma | PageRun],
        copies: Sequence[PageCopy] = (),
    ) -> PageTable:
        """The same, where the bytes of ``runs`` come in pieces of whole pages. Each is done with when the next is asked for."""
        mapped, carried, gone = extents(vmas), extents(runs), extents(cleared)
        addresses = addresses_of(carried, self.page_size)
        copied, places = copied_pages(copies, addresses, self.page_size) if copies else (addresses[:0], None)
        digests = _digest_each(pieces, addresses, self.page_size, copied, places)
        if copies:
            addresses = np.concatenate((addresses, copied))
            order = np.argsort(addresses)
            addresses, digests = addresses[order], digests[order]
        if not len(gone) and self.within is not None and np.array_equal(mapped, self.within):
            kept, dropped = self.pages, self.pages.words[:0]  # as at most deltas: it would look at every page to find that out
        else:
            kept, dropped = self.pages.without(mapped, gone)
        pages, replaced = kept.overlaid(addresses, digests)
        page_sum = add_to_sum(self.page_sum, digests, np.concatenate((dropped, replaced)))
        within = mapped if not copies and covers(mapped, carried) else None
        return PageTable(self.page_size, pages, page_sum, within)
