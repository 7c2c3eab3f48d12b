"""Verify, from a snapshot's own pages alone, that the newest snapshot of a component leads to the state its position names.

The check remembers what it needs of the earlier state: the digest of each page, and the content of pages that may come as
differences. Pages that it does not remember (any more) are counted and read again from the files.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from msgspec import Struct

from checkpoint.errors import ChainError, FormatError
from checkpoint.model import Position, Snapshot
from checkpoint.pages.page_set import PageTable, Words
from checkpoint.pages.xor_delta import Rows, resolved_each
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot.format import Streamed
from checkpoint.snapshot.validity import place
from checkpoint.store import chain
from checkpoint.store.index import Entry, Shelf
from checkpoint.store.page_lookup import pages_at
from checkpoint.store.xor_cache import FirstPages, HotPages, Step
from checkpoint.store.xor_cache_budget import PageBudget


class Proved(Struct, frozen=True):
    """The pages of a position that was proved.

    Attributes:
        hot: contents; at an earlier position until `Proofs.keep`.
        step: from there to here.
    """

    position: Position
    table: PageTable
    hot: HotPages
    step: Step | None = None


class Proofs:
    """The newest proved position of each component. Calls of one component follow one another."""

    def __init__(self, budget: PageBudget, streamed: Callable[[str, Entry], AbstractContextManager[Streamed]]) -> None:
        """
        Args:
            budget: for content to remember, of all components.
            streamed: reads a component's file; raises ChainError where it is damaged.
        """
        self._budget = budget
        self._streamed = streamed
        self._proved: dict[str, Proved] = {}

    def prove(self, shelf: Shelf, told: Streamed) -> Proved:
        """Apply a snapshot to the pages of its parent, which the shelf holds, and compare. Its pages are read, a few at a time.

        Raises:
            ChainError: it leads elsewhere.
            FormatError: its pages are not what they were.
        """
        outline = told.outline
        parent = self._unproved(outline) if outline.parent is None else self._at(shelf, outline.parent)
        proved = self._applied(shelf, parent, told)
        chain.check_state(outline, proved.table.page_sum, told.digest)
        return proved

    def keep(self, component: str, proved: Proved) -> None:
        """The snapshot is stored: the next one begins here."""
        if proved.step is not None:
            proved.hot.advance(proved.step)
        self._limit(component, proved.hot)
        self._proved[component] = Proved(proved.position, proved.table, proved.hot)

    def forget(self, component: str) -> None:
        """Its files have changed."""
        self._proved.pop(component, None)
        self._budget.leave(_user(component))

    def _limit(self, component: str, hot: HotPages) -> None:
        """Have it hold its share; the next call tells the budget how much it then holds."""
        hot.resize(self._budget.share(_user(component), hot.wanted, min(hot.size, hot.limit)))

    def _unproved(self, base: Snapshot) -> Proved:
        """Begin before a chain's base. The known pages may go: their memory is used again."""
        known = self._proved.pop(base.component, None)
        page_size = base.machine.page_size
        fits = known is not None and known.table.page_size == page_size
        hot = known.hot if known is not None and fits else HotPages(page_size, 0)
        self._limit(base.component, hot)
        return Proved(base.position, PageTable.empty(page_size), hot)

    def _at(self, shelf: Shelf, position: Position) -> Proved:
        """The pages of a position: remembered, or counted again from the files."""
        known = self._proved.get(shelf.component)
        if known is not None and known.position == position:
            return known
        proved: Proved | None = None
        for entry in shelf.chain_to(position):
            with self._streamed(shelf.component, entry) as told:
                proved = self._applied(shelf, proved or self._unproved(told.outline), told)
            assert proved.step is not None, "it was made this instant"
            proved.hot.advance(proved.step)
        assert proved is not None, "a chain has a base"
        return proved

    def _applied(self, shelf: Shelf, before: Proved, told: Streamed) -> Proved:
        outline = told.outline
        if (size := outline.machine.page_size) != before.table.page_size:
            raise ChainError(
                f"snapshot {place(outline.position)} of {shelf.component} has pages of {size} bytes, "
                f"the chain of {before.table.page_size}; ask for a base"
            )
        whole = resolved_each(outline, told.pieces, lambda wanted: _held(shelf, before, wanted))
        kept = FirstPages(outline, before.hot.limit)
        table = chain.applied(before.table, outline, kept.passing(whole))
        return Proved(outline.position, table, before.hot, Step.keeping(outline, kept.rows))


def _user(component: str) -> str:
    """In the budget, which has those too that send snapshots."""
    return f"proofs of {component}"


def _held(shelf: Shelf, proved: Proved, wanted: Words) -> Rows:
    """The content of a state at some pages: remembered, or read from the files."""
    assert proved.hot.position == proved.position, "the one follows the other"
    rows = np.empty((len(wanted), proved.table.page_size), dtype=np.uint8)
    found, remembered = proved.hot.lookup(wanted)
    rows[found] = remembered
    if not found.all():
        files = [entry.path for entry in shelf.chain_to(proved.position)]
        try:
            rows[~found] = pages_at(files, wanted[~found], proved.table.page_size)
        except FormatError as error:
            raise ChainError(f"a snapshot that a delta of {shelf.component} needs is damaged here: {error}") from error
    return rows
