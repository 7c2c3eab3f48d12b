"""A fence that orders loads and stores for other processors, on machines that reorder them; None on the others.

CPython has no fence. To release a lock is a store that no earlier load or store passes, to take it again a load that no later one
passes; and the two are ordered, because they are of one lock. So nothing passes both.
"""

from __future__ import annotations

import os
import threading
from typing import Final

from failover.core.board.banks import Fence

IN_ORDER: Final = ("x86_64", "i386", "i686")
"""Machines on which other processors see stores in their order, and loads are made in theirs. Source: Intel SDM 3, 9.2.2."""


class _Lock(threading.local):
    """One for each thread: no thread ever waits for it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.lock.acquire()


_locks = _Lock()


def _fence() -> None:
    lock = _locks.lock
    lock.release()
    lock.acquire()


FENCE: Final[Fence | None] = None if os.uname().machine in IN_ORDER else _fence
