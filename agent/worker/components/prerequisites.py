"""Finds what this robot lacks to run a component: before a move here, and while this robot is the standby.

At the robot where it runs, the agent checks which of its files other components hold open for writing: each of them can be
captured, but the restore of the second one is refused. The component's newest checkpoint at this robot lists what it needs. A
keeper compares, because it knows how a restore would; no program is started.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Final

from agent.core_config import terms_here
from agent.errors import TROUBLE, RefusedError
from agent.system.permissions import ROOT
from agent.worker.components.context import Surroundings, program_of
from agent.worker.components.process_pool import KeeperLink
from agent.worker.components.restore_limits import check_rights
from agent.worker.components.supervisor import Supervisor
from agent.worker.network.remote_orders import Errands
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import CheckpointError, MismatchError, StoreError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Compared, Failed, close_all
from checkpoint.snapshot import format

PATIENCE_S: Final = 15.0
"""How long another robot may take to look what it lacks: it reads files."""

CLEARING_S: Final = 5.0
"""How long to wait for a copy that is being ended here: once it has gone, its names and ports are free for the next one."""

log = logging.getLogger("failover.lacks")


async def asked_of(errands: Errands, robot: str, name: str) -> tuple[str, ...] | None:
    """Needs of a component that another robot does not meet, so it could not go on there; None where it cannot be asked."""
    try:
        found = await errands.send(robot, "lacks", {"name": name}, patience_s=PATIENCE_S)
    except RefusedError as untold:
        log.warning("%s: cannot tell whether it could resume at %s: %s", name, robot, untold)
        return None
    reasons = found.get("lacks")
    return tuple(map(str, reasons)) if isinstance(reasons, list) else None


async def look(around: Surroundings, supervisors: Iterable[Supervisor]) -> Mapping[str, tuple[str, ...]]:
    """The unmet needs of each of these here, as sentences, by name; without those that cannot be looked at, or are not stored."""
    return await _told_by_one_keeper(around, supervisors, _compared)


async def contested(around: Surroundings, supervisors: Collection[Supervisor]) -> Mapping[str, tuple[str, ...]]:
    """Which files of those that run here, and have a checkpoint, others hold open for writing; as `look`.

    Args:
        supervisors: all of this robot's, so that others are known by name.
    """
    components = {supervisor.name: supervisor.component.pid for supervisor in supervisors if supervisor.component is not None}
    running = [supervisor for supervisor in supervisors if supervisor.name in components and supervisor.figures.snapshots]

    async def compared(around: Surroundings, supervisor: Supervisor, keeper: KeeperLink) -> tuple[str, ...]:
        component = supervisor.component
        if component is None or not component.pid:
            return ()  # it has just ended
        terms, pid = component.keeper.terms, component.pid
        order = messages.Compare(terms=terms, running=pid, components=components)
        async with _newest(around, supervisor.name) as snapshot:
            return (await _answer(keeper, order, snapshot)).lacks

    return await _told_by_one_keeper(around, running, compared)


@asynccontextmanager
async def _newest(around: Surroundings, name: str) -> AsyncIterator[int]:
    """Its newest checkpoint here, open for reading in the body. Raises StoreError: there is none, or no more."""
    chain = await asyncio.to_thread(around.store.open_chain, name)
    try:
        yield chain[-1]
    finally:
        close_all(tuple(chain))


async def _answer(keeper: KeeperLink, order: messages.Compare, snapshot: int) -> Compared:
    reply, _ = await keeper.dialogue.ask(order, (snapshot,))
    if isinstance(reply, Failed):
        raise CheckpointError(reply.message)
    assert isinstance(reply, Compared)
    return reply


async def _told_by_one_keeper(
    around: Surroundings,
    supervisors: Iterable[Supervisor],
    compared: Callable[[Surroundings, Supervisor, KeeperLink], Awaitable[tuple[str, ...]]],
) -> Mapping[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    keeper: KeeperLink | None = None
    try:
        for supervisor in supervisors:
            await supervisor.cleared(CLEARING_S)
            keeper = keeper or await around.places.process_pool.keeper()
            try:
                found[supervisor.name] = await compared(around, supervisor, keeper)
            except StoreError:
                continue  # there is no checkpoint of it here yet, or no more
            except (CheckpointError, OSError) as trouble:
                log.warning("%s: cannot check whether it could resume here: %s", supervisor.name, trouble)
    except TROUBLE as trouble:
        log.warning("cannot check which components could resume here: %s", trouble)
    finally:
        if keeper is not None:
            keeper.end()
    return found


async def _compared(around: Surroundings, supervisor: Supervisor, keeper: KeeperLink) -> tuple[str, ...]:
    name, spec = supervisor.name, supervisor.figures.spec
    async with _newest(around, name) as snapshot:
        outline = await asyncio.to_thread(format.read_outline, snapshot)
        if outline.engine == COOPERATIVE and around.here(name).command:
            return ()  # it is started by that
        terms = terms_here(spec.launch if spec is not None else None, around.here(name))
        is_ordinary = spec is not None and spec.owner != ROOT
        order = messages.Compare(around.places.contents, terms, supervisor.figures.digests, own_eyes=is_ordinary)
        reply = await _answer(keeper, order, snapshot)
    supervisor.figures.digests = reply.known
    try:
        if spec is not None:
            check_rights(name, outline, spec.owner, program_of(spec.launch).inheritance)
    except MismatchError as mismatch:
        return (*mismatch.reasons, *reply.lacks)
    return reply.lacks
