"""Combine the results of scans after the program resumes: the pages that a snapshot carries, and their bytes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Final

from msgspec import Struct, field

from checkpoint.linux import abi
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.model import Position
from checkpoint.pages import merge, page_set
from checkpoint.pages.merge import Copy
from checkpoint.pages.page_set import PageMap, Words

WITHIN_SIZE: Final = 8 << 20
"""Bytes of a copy from which on its memory is used again for what is sent. Smaller ones stay as they are, for
`checkpoint.engines.ptrace.capture.at_rest` compares with them."""


class Unacknowledged(Struct, frozen=True):
    """The findings of one scan, kept until a position that holds them is acknowledged."""

    position: Position | None
    written: Words
    cleared: Words


class Taken(Struct, frozen=True, dict=True, eq=False):
    """The memory of one capture, when the program stood still.

    Attributes:
        lines: the mappings.
        mapped: all that may be carried; ``of_files``: what is mapped of files.
        is_base: whether it is for a base.
        guards: see ``checkpoint.model.Vma.guards``.
        scans: everything that was named and is not acknowledged, the last scan's at the end.
        valid: pages of ``copies`` that only the last scan may have named since.
        copies: oldest first; the last one was made while the program stood still, in a buffer that the next one uses again,
            the others are this capture's alone.
        untouched: see `checkpoint.resources.files.clean_private_pages`.
        copy_ns: how long that last copy took.
        unread: pages that are still to be read where they stand, in place of all copies; None where they are read.
    """

    lines: tuple[MapsLine, ...]
    mapped: Words
    is_base: bool
    guards: Words
    scans: tuple[Unacknowledged, ...]
    valid: Words
    copies: tuple[Copy, ...]
    untouched: Words = field(default_factory=lambda: NONE)
    of_files: Words = field(default_factory=lambda: NONE)
    copy_ns: int = 0
    unread: Words | None = None

    @functools.cached_property
    def _named(self) -> tuple[Words, Words]:
        """The pages that were written and cleared since the acknowledged position."""
        return since(with_one_tail(self.scans, self.mapped, self.guards), self.mapped, is_base=self.is_base)

    @functools.cached_property
    def carried(self) -> Words:
        """Pages that the snapshot must tell of; each is in one of ``copies`` at least."""
        missing, last = self.copies[-1].pages, self.scans[-1]
        if not len(self.valid):
            return missing
        valid = page_set.difference(page_set.difference(self.valid, last.written), last.cleared)
        return page_set.union(missing, page_set.intersection(valid, self.mapped if self.is_base else self._named[0]))

    @property
    def cleared(self) -> Words:
        """Pages whose earlier content is forgotten, relative to the acknowledged position; ``carried`` comes on top."""
        return self._named[1]

    @property
    def frozen_size(self) -> int:
        """Bytes that were copied while the program stood still."""
        return page_set.total_size(self.copies[-1].pages)

    def contents(self) -> tuple[Words, memoryview, Words]:
        """The carried pages that are to be sent, in order, their bytes, and those of anonymous memory that are all zero.

        Once: it may use up copies of `WITHIN_SIZE` and more.
        """
        sources, _ = merge.newest(self.copies, abi.PAGE_SIZE).without(self.carried, NONE)
        zero = merge.are_zero(self.copies, sources, abi.PAGE_SIZE) & ~page_set.covered(self.of_files, sources.addresses)
        dropped = page_set.extents_of_addresses(sources.addresses[zero], abi.PAGE_SIZE)
        sent, _ = sources.without(self.carried, dropped)
        return sent.addresses, self._gathered(sent), dropped

    def _gathered(self, sent: PageMap) -> memoryview:
        """Their bytes, in the largest copy that is not needed any more, if that can be."""
        contents = [copy.content for copy in self.copies]
        if len(contents) > 1:
            sizes = [page_set.total_size(copy.pages) for copy in self.copies[:-1]]
            largest = max(range(len(sizes)), key=sizes.__getitem__)
            within = merge.gathered_within(largest, contents, sent, abi.PAGE_SIZE) if sizes[largest] >= WITHIN_SIZE else None
            if within is not None:
                return within
        return merge.gathered(contents, sent, abi.PAGE_SIZE)


def since(scans: Sequence[Unacknowledged], mapped: Words, *, is_base: bool) -> tuple[Words, Words]:
    """The pages that these scans have named, written and cleared. They are in order; only the last may be without position."""
    if is_base:
        scans = [one for one in scans[-1:] if one.position is None]
    if not scans:
        return NONE, NONE
    if len(scans) == 1:
        return scans[0].written, scans[0].cleared
    union = functools.reduce(joined, scans)
    return page_set.intersection(union.written, mapped), union.cleared


def with_one_tail(scans: Sequence[Unacknowledged], mapped: Words, guards: Words) -> list[Unacknowledged]:
    """The same, with those at the end that have no position as one.

    Args:
        guards: they count as written, and there is nothing to read.
    """
    named = [one for one in scans if one.position is not None]
    tail = scans[len(named) :]
    if not tail:
        return named
    last = tail[0]
    for one in tail[1:]:
        still = page_set.intersection(page_set.difference(last.written, one.cleared), mapped)
        last = Unacknowledged(None, page_set.union(still, one.written), page_set.union(last.cleared, one.cleared))
    installed = page_set.intersection(last.written, guards)
    if len(installed):
        last = Unacknowledged(None, page_set.difference(last.written, installed), page_set.union(last.cleared, installed))
    return [*named, last]


def joined(earlier: Unacknowledged, later: Unacknowledged) -> Unacknowledged:
    """Two scans as one, known by the later one's position."""
    written = page_set.union(page_set.difference(earlier.written, later.cleared), later.written)
    return Unacknowledged(later.position, written, page_set.union(earlier.cleared, later.cleared))
