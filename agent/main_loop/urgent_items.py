"""A thread that waits for puts of urgent items and wakes the main loop, which sends them at once.

A futex is not in an epoll. The thread sleeps on the word that a program's put changes (BOARD.md, *Waiting*), and writes to an
eventfd. A wake-up may be lost, so it looks at the items ten times a second, too.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import Final

from agent.main_loop.own_items import OwnItems, number_in
from failover.boards import futex
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.errors import BoardError

LOOK_S: Final = 0.1
WAITS_FOR_ANY: Final = b"\x01"
ANY_FIELD: Final = layout.WAITERS_FIELD + 1

log = logging.getLogger("failover.heart")


class UrgentItems:
    """Readable (`fileno`) when an urgent item was put."""

    def __init__(self, file: MappedFile, items: OwnItems) -> None:
        self._file, self._items = file, items
        self._event = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="urgent items", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """For epoll."""
        return self._event

    def heed(self) -> None:
        """What was signalled is being seen to."""
        os.eventfd_read(self._event)

    def close(self) -> None:
        """End the thread. A second call does nothing."""
        if self._ends.is_set():
            return
        self._ends.set()
        futex.wake(self._file.address(layout.CHANGED_AT))
        self._thread.join()
        os.close(self._event)

    def _run(self) -> None:
        seen: dict[int, int] = {}
        try:
            while not self._ends.is_set():
                self._wait(seen)
        except (BoardError, OSError) as error:
            log.warning("urgent items go with the rounds only: %s", error)

    def _wait(self, seen: dict[int, int]) -> None:
        urgent, descriptor = self._items.urgent, self._file.descriptor
        changed = self._changed()
        for record in urgent:
            os.pwrite(descriptor, WAITS_FOR_ANY, record.at + ANY_FIELD)
        table = self._items.newest() if urgent else b""
        newest = {record.id: number_in(table, record) for record in urgent}
        if any(seen.get(number, 0) != put for number, put in newest.items()):  # put before it was told that we wait
            seen.update(newest)
            os.eventfd_write(self._event, 1)
        futex.wait(self._file.address(layout.CHANGED_AT), changed, LOOK_S)
        if self._changed() != changed:  # the loop is to know first, and this thread what it was afterwards
            os.eventfd_write(self._event, 1)

    def _changed(self) -> int:
        return int.from_bytes(os.pread(self._file.descriptor, 4, layout.CHANGED_AT), "little")
