"""Programs that put an urgent item wake the main loop, which sends it at once.

The main loop sets a byte beside each urgent item. The writer that finds it set clears it and sets the times of the board's file:
that wakes the main loop (BOARD.md, *Waiting*). So a program costs the loop one turn for each time that the loop asks, and it
asks again when it has sent. A wake-up may be lost, so the loop compares the numbers of puts once a round, too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from agent.system.inotify import Touches
from failover.boards.unmapped_file import UnmappedFile

log = logging.getLogger("failover.heart")


class UrgentItems:
    """Readable (`fileno`) when an urgent item was put."""

    def __init__(self, files: Sequence[UnmappedFile]) -> None:
        self._touches: Touches | None = None
        try:
            self._touches = Touches(*[file.descriptor for file in files])
        except OSError as error:
            log.warning("urgent items go with the rounds only: %s", error)

    def fileno(self) -> int:
        """For epoll; -1 where the kernel gave none."""
        return self._touches.fileno() if self._touches is not None else -1

    def heed(self) -> None:
        """What was told is being seen to; nothing, if it has been already."""
        if self._touches is not None:
            self._touches.heed()

    def close(self) -> None:
        """Give the descriptor back. A second call does nothing."""
        touches, self._touches = self._touches, None
        if touches is not None:
            touches.close()
