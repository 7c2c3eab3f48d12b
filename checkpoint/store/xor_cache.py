"""Cache the newest content of pages that change often, in bounded memory: the reference for XOR differences in deltas.

Both sides of a stream keep such pages, each by itself: the maker of deltas (`Sender`), to send less, and the receiver
(`checkpoint.store.verify`), to prove them without reading back what it has stored. A forgotten page costs bytes or time, never
correctness: a sender sends a page whole, a store reads it from its files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct

from checkpoint.model import Position, Snapshot
from checkpoint.pages import page_set, xor_delta
from checkpoint.pages.page_set import Flags, PageMap, Words
from checkpoint.pages.xor_delta import Rows
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot.process_tree import every_mapping

CACHE_SIZE: Final = 64 << 20
"""Bytes of pages of all components, where nothing else was said."""

WHOLE_MAX: Final = 256
"""Deltas that are told whole, at most, before differences are tried again with a robot that does not take them."""


class Step(Struct, frozen=True, eq=False):
    """The changes of one snapshot to the pages of its parent.

    Attributes:
        kept: ranges that are mapped now.
        gone: pages whose earlier content counts no more: cleared ones, and all that it tells.
        addresses: of those whose content is kept here, in order; ``rows``: that content.
        count: of all that it tells.
    """

    position: Position
    parent: Position | None
    kept: Words
    gone: Words
    addresses: Words
    rows: Rows
    count: int

    @classmethod
    def of(cls, snapshot: Snapshot, limit: int) -> Step:
        """
        Args:
            snapshot: tells its pages whole.
            limit: bytes of them that are worth keeping: the first ones, where a program has its heap.
        """
        page_size = snapshot.machine.page_size
        rows = xor_delta.rows_of(snapshot.contents, page_size)
        if limit // page_size < len(rows):
            rows = rows[: limit // page_size].copy()  # a base need not stay for the sake of a part of it
        return cls.keeping(snapshot, rows)

    @classmethod
    def keeping(cls, outline: Snapshot, rows: Rows) -> Step:
        """
        Args:
            outline: without its pages.
            rows: the first ones of them, told whole.
        """
        every = xor_delta.addresses_of(outline.runs, outline.machine.page_size)
        told = page_set.extents((*outline.runs, *outline.cleared, *outline.copies))
        kept = page_set.extents(every_mapping(outline))
        return cls(outline.position, outline.parent, kept, told, every[: len(rows)], rows, len(every))


class FirstPages:
    """The first pages of a snapshot whose pages come in pieces, for its `Step`."""

    def __init__(self, outline: Snapshot, limit: int) -> None:
        """
        Args:
            limit: bytes of them.
        """
        page_size = outline.machine.page_size
        size = min(sum(run.size for run in outline.runs), limit)
        self.rows: Rows = np.empty((size // page_size, page_size), dtype=np.uint8)

    def passing(self, pieces: Iterable[memoryview]) -> Iterator[memoryview]:
        """The same pieces; ``rows`` has what it keeps of those that have passed."""
        content, filled = self.rows.reshape(-1).data, 0
        for piece in pieces:
            size = min(len(piece), len(content) - filled)
            content[filled : filled + size] = piece[:size]
            filled += size
            yield piece


class HotPages:
    """The content of the pages that were told last, in the state at one position.

    Invariant: ``_pages`` says of each page in which slot its content is, and when it was told; no two share a slot.

    Attributes:
        position: None: nothing is known.
        limit: bytes of content at most.
        wanted: bytes that it would hold with room for all; 0 before the first step.
    """

    def __init__(self, page_size: int, limit: int) -> None:
        """
        Args:
            limit: bytes of content at most.
        """
        self.limit = limit
        self.wanted = 0
        self.position: Position | None = None
        self._slot_limit = limit // page_size
        self._slots = np.empty((0, page_size), dtype=np.uint8)
        self._pages = PageMap.empty()
        self._kept: Words = self._pages.addresses
        """Ranges outside which no page is known."""
        self._round = 0

    @property
    def size(self) -> int:
        """Bytes of content that are held."""
        return len(self._pages.addresses) * self._slots.shape[1]

    def forget(self) -> None:
        """Know nothing."""
        self.position, self._pages = None, PageMap.empty()

    def resize(self, limit: int) -> None:
        """Have another limit from now on; where it is less, the pages told longest ago go."""
        page_size = self._slots.shape[1]
        self.limit, self._slot_limit = limit, limit // page_size
        if len(self._slots) <= self._slot_limit:
            return
        held = self._with_room(self._pages, 0)
        slots = self._slots[held.words[:, 0].astype(np.intp)]
        places = np.column_stack((np.arange(len(slots), dtype=np.uint64), held.words[:, 1]))
        self._slots, self._pages = slots, PageMap(held.addresses, places)

    def lookup(self, wanted: Words) -> tuple[Flags, Rows]:
        """Which of these addresses, in order, are known, and the content of those."""
        found, places = page_set.found_among(self._pages.addresses, wanted)
        return found, self._slots[self._pages.words[places, 0].astype(np.intp)]

    def advance(self, step: Step) -> None:
        """Follow to the next position. Of a delta whose parent is not ours only what it tells is known."""
        if step.parent is None or step.parent != self.position:
            self.forget()
        self._round += 1
        if not self._is_overwritten(step):
            self._overlay(step)
        self.position = step.position

    def _is_overwritten(self, step: Step) -> bool:
        """Take in a delta that tells pages anew that are known all, and nothing else, as most do: no other page is looked at."""
        page_size = self._slots.shape[1]
        if len(step.rows) != step.count or page_set.total_size(step.gone) != step.count * page_size:
            return False
        if not np.array_equal(step.kept, self._kept):
            return False
        found, places = page_set.found_among(self._pages.addresses, step.addresses)
        if not found.all():
            return False
        self._slots[self._pages.words[places, 0].astype(np.intp)] = step.rows
        self._pages.words[places, 1] = self._round
        self.wanted = len(self._pages.addresses) * page_size
        return True

    def _overlay(self, step: Step) -> None:
        self._kept = step.kept
        held, _ = self._pages.without(step.kept, step.gone)
        self.wanted = (len(held.addresses) + step.count) * self._slots.shape[1]
        addresses, rows = step.addresses[: self._slot_limit], step.rows[: self._slot_limit]
        held = self._with_room(held, len(addresses))
        self._grow(len(held.addresses) + len(addresses))
        is_free = np.ones(len(self._slots), dtype=np.bool_)
        is_free[held.words[:, 0].astype(np.intp)] = False
        slots = np.flatnonzero(is_free)[: len(addresses)]
        self._slots[slots] = rows
        words = np.column_stack((slots.astype(np.uint64), np.full(len(slots), self._round, dtype=np.uint64)))
        self._pages, _ = held.overlaid(addresses, words)

    def _grow(self, wanted: int) -> None:
        """Have at least so many slots, within the limit: a generous limit is no reason to ask for all of that memory."""
        have, page_size = self._slots.shape
        if wanted > have:
            larger = np.empty((min(max(wanted, 2 * have), self._slot_limit), page_size), dtype=np.uint8)
            larger[:have] = self._slots
            self._slots = larger

    def _with_room(self, held: PageMap, wanted: int) -> PageMap:
        """Without as many of those that were told longest ago as there must be room for."""
        excess = len(held.addresses) + wanted - self._slot_limit
        if excess <= 0:
            return held
        stays = np.ones(len(held.addresses), dtype=np.bool_)
        stays[np.argsort(held.words[:, 1], kind="stable")[:excess]] = False
        return PageMap(held.addresses[stays], held.words[stays])


class Sender:
    """Tells deltas as differences from what was acknowledged last.

    A robot of an older release refuses them: after two in a row that were not acknowledged deltas are told whole for a while,
    longer each time, so that checkpoints go on there, too.
    """

    def __init__(self) -> None:
        self._hot: HotPages | None = None
        self._pending: Step | None = None
        self._is_differing = False
        """Whether the delta that was told last has differences, and was not acknowledged."""
        self._whole = 0
        """The number of deltas to tell whole from here on; ``_pause``: that number after the next one without acknowledgement."""
        self._pause = 0

    @property
    def held(self) -> int:
        """Bytes of pages that it remembers."""
        return self._hot.size if self._hot else 0

    @property
    def wanted(self) -> int:
        """Bytes that it would remember with room for all; 0: not known yet."""
        return self._hot.wanted if self._hot else 0

    def limit(self, size: int) -> None:
        """From now on remember so many bytes of pages at most; 0: tell no differences at all."""
        if self._hot is not None:
            self._hot.resize(size)

    def told(self, snapshot: Snapshot, limit: int) -> tuple[Snapshot, int]:
        """The same snapshot, with differences where that is worth it, and how many bytes of its pages were known.

        Args:
            snapshot: tells its pages whole.
            limit: as `limit` takes it.
        """
        self.limit(limit)
        page_size = snapshot.machine.page_size
        if self._hot is None:
            self._hot = HotPages(page_size, limit)
        self._pending = Step.of(snapshot, limit)
        self._count_untaken()
        if limit < page_size:
            return snapshot, 0
        if snapshot.parent is None or snapshot.parent != self._hot.position:
            return snapshot, 0
        if self._whole:
            self._whole -= 1
            return snapshot, 0
        usable = xor_delta.tellable(snapshot)
        found, contents = self._hot.lookup(usable)
        told = xor_delta.told(snapshot, usable[found], contents)
        self._is_differing = bool(told.differences)
        return told, len(contents) * page_size

    def _count_untaken(self) -> None:
        """Count the last delta as not taken, if it is not acknowledged when the next one is told."""
        if self._is_differing:
            self._is_differing = False
            self._whole, self._pause = self._pause, min(max(2 * self._pause, 1), WHOLE_MAX)

    def acknowledge(self, position: Position) -> None:
        """From now on deltas begin there."""
        if self._hot is None or position == self._hot.position:
            return
        if self._pending is not None and self._pending.position == position:
            self._hot.advance(self._pending)
            self._pause = 0 if self._is_differing else self._pause
            self._is_differing = False
        else:
            self._hot.forget()
        self._pending = None
