"""Programs that this robot takes over resume in the order of their tasks: one waits until its predecessors run."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Final

from failover.core.schedule.precedence import awaited

PATIENCE_S: Final = 2.0
"""How long a program waits for its predecessors: one of them may be much larger, or fail."""


class ResumeOrder:
    """Those that are being restored here now.

    Args:
        after: of each task that agent.toml declares, its predecessors.
    """

    def __init__(self, after: Mapping[str, tuple[str, ...]] | None = None) -> None:
        self._after = after or {}
        self._resuming: set[str] = set()
        self._changed = asyncio.Event()

    def begins(self, name: str) -> None:
        """A program is to be restored; known before the first of those that were ordered together resumes."""
        self._resuming.add(name)

    def has_predecessors(self, name: str) -> bool:
        """Whether its table in agent.toml names any."""
        return bool(self._after.get(name))

    def ended(self, name: str) -> None:
        """It runs, or came to nothing. Once more says nothing new."""
        self._resuming.discard(name)
        self._changed.set()

    async def turn_of(self, name: str, patience_s: float = PATIENCE_S) -> frozenset[str]:
        """Wait until its predecessors run; returns those that do not, after so long."""
        end = asyncio.get_running_loop().time() + patience_s
        while missing := awaited(name, self._after, self._resuming):
            self._changed.clear()
            try:
                async with asyncio.timeout_at(end):
                    await self._changed.wait()
            except TimeoutError:
                return missing
        return frozenset()
