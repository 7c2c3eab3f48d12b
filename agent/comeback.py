"""How a component comes back from a checkpoint: by the engine that made it, and by what waits for it where something does."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from typing import Any, Final

from agent import births
from agent.clock import Laps
from agent.component import Component
from agent.guard_messages import Task
from agent.rules import started_here
from agent.surroundings import Surroundings, program_of
from checkpoint import format
from checkpoint.engine import AUTO, COOPERATIVE
from checkpoint.errors import RestoreError
from failover.core import acts

ACCEPT_S: Final = 15.0
"""How long a program may take until its first commit says that it has taken its state; after that it counts as running."""

LINE_LIMIT: Final = 300
"""Characters of what a program said last that are told."""


async def brought_back(
    around: Surroundings,
    act: acts.Restore,
    chain: Sequence[int],
    outage_ns: int,
    laps: Laps,
    waiting: Component | None = None,
) -> Component:
    """The component by the engine that took the newest snapshot; `Component.resume` lets it run.

    Args:
        chain: descriptors of encoded snapshots, oldest first.
        outage_ns: how long ago the newest was taken.
        waiting: the program, where it was started to wait.

    Raises:
        CheckpointError, AgentError: as `births.restore` and `births.begin_again`; nothing of it is left.
    """
    name, places, spec = act.component, around.places, act.spec
    newest = await asyncio.to_thread(format.read_outline, chain[-1])
    if newest.engine != COOPERATIVE:
        if waiting is not None:
            await waiting.undo()
        owner = spec.owner if spec is not None else None
        task = Task(act.epoch, engine=AUTO) if spec is not None and spec.launch.engine == AUTO else None
        return await births.restore(name, chain, places, outage_ns=outage_ns, owner=owner, laps=laps, task=task, epoch=act.epoch)
    if spec is None:
        raise RestoreError(f"cannot start {name} again: this robot was never told its command; start it by failover run")
    program = program_of(started_here(spec.launch, around.here(name)))
    return await births.begin_again(
        name,
        program,
        chain,
        places,
        outage_ns=outage_ns,
        owner=spec.owner,
        epoch=act.epoch,
        why=act.why,
        waiting=waiting,
    )


async def accepted(component: Component, called_off: asyncio.Event) -> None:
    """Wait until a program that was started again has taken its state, or it is clear that it will not be heard of just now.

    Whoever takes a state commits it at once. A crash is none of our business: it is told as the crash of any running program.

    Args:
        called_off: set when the component is to be stopped.

    Raises:
        RestoreError: it ended by itself before that, and says that it failed: it refused the state.
    """
    taken = asyncio.Event()
    component.committed = taken.set
    if component.keeps:
        return
    said = component.logs.bounds(2).committed
    waiting = [asyncio.create_task(event.wait()) for event in (taken, called_off)]
    awaited: list[asyncio.Future[Any]] = [component.ended, *waiting]
    try:
        await asyncio.wait(awaited, timeout=ACCEPT_S, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waiting:
            task.cancel()
    ended = component.ended
    status = ended.result() if ended.done() and ended.exception() is None else None
    if status and os.WIFEXITED(status) and not component.keeps:
        words = last_line(component, said)
        raise RestoreError(
            f"{component.name} did not take its state: exit status {os.WEXITSTATUS(status)} before its first commit"
            + (f"; it said: {words}" if words else "; it said nothing")
        )


def last_line(component: Component, since: int) -> str:
    """What it wrote last to its standard error, from that byte on; "" if nothing."""
    end = component.logs.bounds(2).size
    piece = component.logs.read(2, max(since, end - LINE_LIMIT), committed=False)
    lines = piece.content.decode(errors="replace").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
