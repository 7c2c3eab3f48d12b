"""Waits for a put of any of several items, of this robot or others: one sleep for all of them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from failover.boards import futex
from failover.core.board import layout
from failover.core.board.banks import Reading
from failover.errors import BoardError, NeverWrittenError

if TYPE_CHECKING:
    from failover.boards.item import Item

SLICE_S: Final = 0.1
"""The longest sleep without a look: a wake-up may be lost (BOARD.md), and a board may be made anew."""
WATCHED_MAX: Final = 128
"""Items of one watch: the kernel sleeps on at most so many words at once (futex_waitv)."""


class Watch:
    """Items that one reader watches; made by `Board.watch`. It remembers of each what it has given."""

    def __init__(self, items: tuple[tuple[Item, str | None], ...]) -> None:
        if not 1 <= len(items) <= WATCHED_MAX:
            raise BoardError(f"cannot watch {len(items)} items; give 1 to {WATCHED_MAX}")
        self._items = items
        self._given = [0] * len(items)

    def wait(self, timeout: float | None = None) -> list[tuple[Item, Reading]]:
        """Sleep until an item has a value that this watch has not given yet: those items with their readings, in their order.

        Args:
            timeout: seconds; None: for ever.

        Raises:
            TimeoutError: there was none.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            places = self._places()
            found = self._new()
            if found:
                return found
            left = SLICE_S if end is None else end - time.monotonic()
            if left <= 0:
                raise TimeoutError(f"none of the {len(self._items)} items was put within {timeout} s")
            futex.wait_any(places, min(left, SLICE_S))

    def _new(self) -> list[tuple[Item, Reading]]:
        found = []
        for index, (item, robot) in enumerate(self._items):
            try:
                reading = item.get(robot)
            except NeverWrittenError:
                continue
            if reading.number != self._given[index]:
                self._given[index] = reading.number
                found.append((item, reading))
        return found

    def _places(self) -> list[tuple[int, int]]:
        """The words that change with a put, and their values before the items are looked at: one of each file.

        Of a file of another user that of each item: its writer does not learn that this program waits.
        """
        places = {}
        for item, robot in self._items:
            source = item.source(robot)
            file, newest = source.file, source.record.at + layout.NEWEST_FIELD
            if file.always_wakes and not file.is_writable:
                places[id(file), newest] = (file.address(newest), file.word32(newest))
                continue
            if file.is_writable and not file.header.flags & layout.PEER:
                file.area[source.record.at + layout.WAITERS_FIELD + 1] = 1
            places[id(file), layout.CHANGED_AT] = (file.address(layout.CHANGED_AT), file.word32(layout.CHANGED_AT))
        return list(places.values())
