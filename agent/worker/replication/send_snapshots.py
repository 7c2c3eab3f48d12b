"""Sends snapshots from this robot's store to another's: the acts Ship and CancelShip."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from typing import Final

from agent.errors import AgentError, LaneError
from agent.system.crash import end_worker_on_mistake
from agent.worker.components import under_way
from agent.worker.replication.send_files import Bringing
from agent.worker.replication.transfer import Shipper, digest_of
from checkpoint.errors import CheckpointError
from checkpoint.model import Position
from checkpoint.snapshot.required_files import Need, needs
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.index import Entry
from failover.core.acts import CancelShip, Ship
from failover.core.events import Event, ShipEnded, UnderWay
from failover.core.wire.messages import CHUNK_SIZE_MAX, Offer

log = logging.getLogger("failover.dispatch")

AT_ONCE_SIZE: Final = 64 << 10
"""Bytes of a file that was made here last and is examined at once: to hand it to a thread, and to wait for that, takes longer."""


class Dispatch:
    """The transfers that the core ordered, each a task of its own."""

    def __init__(
        self,
        store: SnapshotStore,
        shipper: Shipper,
        tell: Callable[[Event], None],
        hindrance: Callable[[], str] = lambda: "",
        bringing: Bringing | None = None,
        brings_data: Callable[[str], bool] = lambda component: False,
    ) -> None:
        """
        Args:
            hindrance: why no snapshot may leave this robot now; "" if they may.
            bringing: sees that a peer has the files that a snapshot needs, before it is offered; None: they are there already.
            brings_data: whether a component's files that are only read belong to them.
        """
        self._bringing = bringing
        self._brings_data = brings_data
        self._hindrance = hindrance
        self._store = store
        self._shipper = shipper
        self._tell = tell
        self._said = ""
        self._tasks: dict[tuple[str, Position, str], asyncio.Task[None]] = {}

    def ship(self, act: Ship) -> None:
        """Begin a transfer. Its end is told, whichever it is."""
        key = (act.component, act.position, act.to)
        self.cancel(CancelShip(act.component, act.epoch, act.position, act.to))
        task = self._tasks[key] = asyncio.create_task(self._ship(act))
        task.add_done_callback(lambda done: self._tasks.pop(key, None) if self._tasks.get(key) is done else None)
        task.add_done_callback(end_worker_on_mistake)

    def cancel(self, act: CancelShip) -> None:
        """Give a transfer up; nothing is told."""
        task = self._tasks.pop((act.component, act.position, act.to), None)
        if task is not None:
            task.cancel()

    async def close(self) -> None:
        """Give all of them up."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _ship(self, act: Ship) -> None:
        reason = ""
        try:
            with under_way.told(self._tell, UnderWay(act.component, act.epoch, act.position, act.to)):
                await self._send(act)
        except (AgentError, CheckpointError) as error:
            reason = str(error)
        except OSError as error:
            reason = f"snapshot {act.position.sequence} of {act.component} cannot be read here: {error.strerror}"
        if reason and reason != self._said:  # it may be tried again every second for days
            log.info("%s", reason)
        self._said = reason
        self._tell(ShipEnded(act.component, act.epoch, act.position, act.to, not reason, reason))

    async def _send(self, act: Ship) -> None:
        if hindrance := self._hindrance():
            raise LaneError(f"snapshots wait: {hindrance}")
        entry = self._store.chain_of(act.component, act.position)[-1]
        if (act.whole or act.parent is None) and entry.parent is not None:  # a base is wanted
            entry = await asyncio.to_thread(self._folded, act)
        descriptor = os.open(entry.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            told = act.component, entry, descriptor
            is_little = entry.size <= AT_ONCE_SIZE and self._store.is_made_last(act.component, entry)
            needed, digest = self._examined(*told) if is_little else await asyncio.to_thread(self._examined, *told)
            if self._bringing is not None:
                await self._bringing.bring(act.to, act.component, needed)
            digest = digest or await asyncio.to_thread(digest_of, descriptor, entry.size)
            offer = Offer(
                0, act.component, entry.epoch, entry.position, entry.parent, entry.size, digest, act.spec, act.acknowledged
            )
            await self._shipper.ship(act.to, offer, descriptor)
        finally:
            os.close(descriptor)

    def _folded(self, act: Ship) -> Entry:
        self._store.fold(act.component, act.position)
        return self._store.chain_of(act.component, act.position)[-1]

    def _examined(self, component: str, entry: Entry, descriptor: int) -> tuple[tuple[Need, ...], bytes]:
        """The files that a snapshot needs; and its digest, b"" of a large one: its files may be on their way for long."""
        digest = digest_of(descriptor, entry.size) if entry.size <= CHUNK_SIZE_MAX else b""
        if self._bringing is None:
            return (), digest
        return needs(self._store.outline(component, entry, descriptor), opened=self._brings_data(component)), digest
