"""A thread that waits for puts of urgent items and wakes the main loop, which sends them at once.

A futex is not in an epoll. The thread sleeps on the word that a program's put changes (BOARD.md, *Waiting*), and writes to an
eventfd. A wake-up may be lost, so it looks at the items ten times a second, too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Mapping
from typing import Final

from agent.main_loop.own_items import OwnItems
from failover.boards import futex
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.errors import BoardError

LOOK_S: Final = 0.1
IDLE_LOOK_S: Final = 1.0
"""Where there is no urgent item: the loop says when there is one."""

WAKE_AGAIN_S: Final = 0.001
"""Between two wake-ups of a thread that is to end; the main loop waits for it, and a heartbeat is due every few of these."""

WAITS_FOR_ANY: Final = b"\x01"
ANY_FIELD: Final = layout.WAITERS_FIELD + 1

log = logging.getLogger("failover.heart")


class UrgentItems:
    """Readable (`fileno`) when an urgent item was put."""

    def __init__(self, file: MappedFile, items: OwnItems) -> None:
        self._file, self._items = file, items
        self._event = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._ends = threading.Event()
        self._looked: Mapping[int, int] = {}
        self._away = threading.Lock()
        self._away.acquire()
        self._thread = threading.Thread(target=self._run, name="urgent items", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """For epoll."""
        return self._event

    def look_again(self) -> None:
        """There are other items than before."""
        futex.wake(self._file.address(layout.CHANGED_AT))

    def heed(self) -> None:
        """What was signalled is being seen to; nothing, if it has been already."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)

    def seen_to(self, numbers: Mapping[int, int]) -> None:
        """The loop has looked at the items, whose newest puts had these numbers, and what it sends is on its way."""
        self._looked = numbers
        if self._away.locked():
            self._away.release()

    def close(self) -> None:
        """End the thread. A second call does nothing."""
        if self._ends.is_set():
            return
        self._ends.set()
        while self._thread.is_alive():  # it may have been about to sleep when it was woken
            self.seen_to({})
            self.look_again()
            self._thread.join(WAKE_AGAIN_S)
        os.close(self._event)

    def _run(self) -> None:
        try:
            while not self._ends.is_set():
                self._wait()
        except (BoardError, OSError) as error:
            log.warning("urgent items go with the rounds only: %s", error)

    def _wait(self) -> None:
        urgent, descriptor = self._items.urgent, self._file.descriptor
        changed = int.from_bytes(os.pread(descriptor, 4, layout.CHANGED_AT), "little")
        for record in urgent:
            os.pwrite(descriptor, WAITS_FOR_ANY, record.at + ANY_FIELD)
        newest = self._items.numbers(urgent)
        if any(self._looked.get(number, 0) != put for number, put in newest.items()):  # put before it was told that we wait
            self._looked = newest
            self._tell()
        elif futex.wait(self._file.address(layout.CHANGED_AT), changed, LOOK_S if urgent else IDLE_LOOK_S) and urgent:
            self._tell()

    def _tell(self) -> None:
        """Wake the loop and leave the interpreter to it: what is done here takes it from what is to leave."""
        os.eventfd_write(self._event, 1)
        self._away.acquire(timeout=LOOK_S)
