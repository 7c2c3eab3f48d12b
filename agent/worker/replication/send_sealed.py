"""Brings requests and sealed copies to the witness that keeps them, over the replication link, under its credit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from agent.errors import LaneError
from agent.worker.network.remote_orders import SEALED, Errands
from agent.worker.replication.transfer import Shipper
from failover.core.wire.messages import Content


class Courier:
    """The way to one witness. Lives in the worker's loop."""

    def __init__(self, errands: Errands, shipper: Shipper, witness: str, hindrance: Callable[[], str] = lambda: "") -> None:
        """
        Args:
            hindrance: why no sealed copy can leave this robot now; "" if one can.
        """
        self._errands, self._shipper, self._witness, self._hindrance = errands, shipper, witness, hindrance

    async def ask(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Have it answer a request. Raises RefusedError: it cannot be reached, does not answer, or refuses."""
        return await self._errands.send(self._witness, SEALED, arguments)

    def check_way(self) -> None:
        """Raises LaneError: no copy can leave this robot now. Asked before one is made."""
        if hindrance := self._hindrance():
            raise LaneError(f"sealed copies wait: {hindrance}")

    async def ship(self, content: Content, descriptor: int) -> None:
        """Have it take the bytes of a file; snapshots go first. Raises LaneError: they do not arrive whole, or are refused."""
        self.check_way()
        await self._shipper.ship(self._witness, content, descriptor)
