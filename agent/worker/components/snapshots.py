"""Snapshots of one component on this robot: taken, stored, kept aside, pruned or dropped."""

from __future__ import annotations

import asyncio
import logging
import os
from pathlib import Path

from msgspec import Struct

from agent.system import clock
from agent.system.threads import to_its_end
from agent.worker.components.component import Captured, Component
from agent.worker.components.context import Surroundings
from agent.worker.components.statistics import Figures
from checkpoint.errors import CheckpointError
from checkpoint.keeper.messages import Unchanged, close_all, content_of
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot import format
from checkpoint.store import lost_copies
from checkpoint.store.contract import SnapshotStore
from failover.core import acts, events

log = logging.getLogger("failover.component")


class Snapshots(Struct, frozen=True):
    """The snapshots of one component. Its figures describe the last one."""

    name: str
    around: Surroundings
    figures: Figures

    async def capture(self, component: Component, act: acts.Capture) -> None:
        """Take one, store it, and tell the core.

        Raises:
            CheckpointError, AgentError, OSError: there is none, or it could not be stored; the program runs on.
        """
        await component.keeper.lend(self.around.store.unnamed)
        captured = await component.capture(
            base=act.base, generation=act.generation, sequence=act.sequence, epoch=act.epoch, hold=act.hold, lag_ns=act.lag_ns
        )
        self.figures.reasons = ()
        if captured.commit:
            self.figures.commits.note(captured.commit, clock.now_ns() - captured.age_ns)
        if isinstance(captured, Unchanged):
            self.around.tell(events.Unchanged(self.name, act.epoch, act.sequence, captured.position, captured.is_current))
            return
        try:
            await to_its_end(self.around.store.put, captured.snapshot, prove=False)
        finally:
            os.close(captured.snapshot)
        self.figures.captured(captured, self.around.here(self.name).freeze_budget_ms)
        self.around.tell(
            events.Captured(
                self.name,
                act.epoch,
                captured.position,
                captured.parent,
                captured.size,
                captured.freeze_us,
                captured.age_ns,
                captured.cpu_us,
            )
        )

    async def keep_aside(self, component: Component, act: acts.KeepAside) -> Path:
        """One last snapshot of a copy that lost, where no robot resumes from it by itself; returns where it is.

        Raises:
            CheckpointError, AgentError, OSError: there is none.
        """
        try:
            captured = await self._captured_last(component, act)
        except CheckpointError:  # nothing else has this state: it is tried once more
            captured = await self._captured_last(component, act)
        assert isinstance(captured, Captured), "a base is always made"
        try:
            content = content_of(captured.snapshot)
        finally:
            os.close(captured.snapshot)
        directory = self.around.places.logs.parent / lost_copies.FOLDER
        path = await asyncio.to_thread(lost_copies.keep, directory, self.name, act.epoch, content)
        log.warning("%s: the copy that lost is kept for inspection in %s: %s", self.name, path, act.reason)
        return path

    async def _captured_last(self, component: Component, act: acts.KeepAside) -> Captured | Unchanged:
        await component.freeze(exposed=True)  # perhaps its lease has frozen it already
        newest = self.figures.newest or Position(1, 0, b"")
        return await component.capture(
            base=True, generation=newest.generation, sequence=newest.sequence + 1, epoch=act.epoch, hold=True
        )

    async def tidy(self, act: acts.Forget | acts.Prune | acts.Drop) -> None:
        """Remove snapshots that are not needed any more.

        Raises:
            CheckpointError, OSError: from the store.
        """
        store = self.around.store
        match act:
            case acts.Forget():
                await asyncio.to_thread(store.set_aside, self.name, act.generations)
            case acts.Prune():
                await asyncio.to_thread(store.prune, self.name, act.oldest)
            case acts.Drop():
                await asyncio.to_thread(store.drop, self.name)


def newest_of(store: SnapshotStore, name: str) -> Snapshot | None:
    """The newest snapshot of a component here, without its pages; None where there is none that can be read."""
    chain: list[int] = []
    if not store.positions(name):
        return None
    try:
        chain = store.open_chain(name)
        return format.read_outline(chain[-1])
    except (CheckpointError, OSError) as error:
        log.warning("%s: its newest checkpoint cannot be read: %s", name, error)
        return None
    finally:
        close_all(tuple(chain))
