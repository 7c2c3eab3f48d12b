"""Track guard pages (MADV_GUARD_INSTALL) through the results of scans; a look at every page in each freeze would cost 1 µs a MB.

Installing a guard and removing it both change an entry of the page table, so a scan of a tracked place reports it as written (or,
where there is nothing to read, as cleared). The module does not look for a guard among a few written pages: reading it fails, and
the reader then makes the module look everywhere.

Source: guard_install_pte_entry() and guard_remove_pte_entry() in mm/madvise.c, pagemap_scan_pmd_entry() in fs/proc/task_mmu.c.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

from checkpoint.linux.memory.tracker import NONE, Scan
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words


class Guards:
    """The guard pages of one process, from freeze to freeze.

    Args:
        look: finds the guards within a set of pages.
    """

    def __init__(self, look: Callable[[Words], Words]) -> None:
        self._look = look
        self._known: Words = NONE
        self._watched: Words = NONE
        self._unwatched: Words = NONE
        self._unwatched_key: tuple[Words, Words] = (NONE, NONE)
        self._scans: list[Scan] = []

    def forget(self) -> None:
        """Forget the known guards, since writes are not known any more: the next search is one everywhere."""
        self._watched = NONE

    def rehearse(self) -> None:
        """Look where `found` is going to look, and forget what is there."""
        self._look(self._unwatched)

    def named(self, scan: Scan) -> None:
        """Take in what a scan has named."""
        self._scans.append(scan)

    def found(self, mapped: Words, watched: Words) -> Words:
        """The guards, but for those that are among the written pages, of which reading tells. The process stands still.

        Args:
            mapped: where there may be any.
            watched: where from now on scans name every change.
        """
        scans, self._scans = self._scans, []
        cleared = functools.reduce(page_set.union, (scan.cleared for scan in scans), NONE)
        if watched is not self._watched:  # a range that is not watched any more (its file was deleted) was not named
            self._watched = page_set.intersection(self._watched, watched)
        kept = page_set.intersection(self._known, self._watched)
        if len(kept):
            named = functools.reduce(page_set.union, (scan.written for scan in scans), cleared)
            kept = page_set.difference(kept, named)
        places = page_set.union(self._not_watched(mapped), page_set.intersection(cleared, mapped))
        self._known = page_set.intersection(page_set.union(kept, self._look(places)), mapped)
        self._watched = watched
        return self._known

    def found_everywhere(self, mapped: Words, watched: Words) -> Words:
        """As `found`, all of them."""
        self.forget()
        return self.found(mapped, watched)

    def _not_watched(self, mapped: Words) -> Words:
        if self._unwatched_key[0] is not mapped or self._unwatched_key[1] is not self._watched:
            self._unwatched = page_set.difference(mapped, self._watched)
            self._unwatched_key = (mapped, self._watched)
        return self._unwatched
