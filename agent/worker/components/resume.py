"""Resumes a component from a checkpoint: by the engine that made it, and by the process that waits for it where one does."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from typing import Final

from msgspec.structs import replace

from agent.core_config import started_here, terms_here
from agent.guard.messages import Task
from agent.system.clock import Laps
from agent.worker.components import launch
from agent.worker.components.component import Component
from agent.worker.components.context import Surroundings, program_of
from checkpoint.engine import AUTO, COOPERATIVE
from checkpoint.errors import RestoreError
from checkpoint.model import Snapshot
from checkpoint.snapshot import format, required_files
from checkpoint.store.content_store import DIGEST_SIZE, path_in
from failover.core import acts
from failover.core.event_log.decisions import SAID
from failover.core.types import ComponentSpec, Resumption

LINE_LIMIT: Final = 300
"""Characters of a program's last line that are told."""


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
        CheckpointError, AgentError: as `launch.restore` and `launch.begin_again`; nothing of it is left.
    """
    name, places, spec = act.component, around.places, act.spec
    options = _options(around, act, outage_ns)
    newest = await asyncio.to_thread(format.read_outline, chain[-1])
    if newest.engine != COOPERATIVE:
        if waiting is not None:
            await waiting.undo()
        return await launch.restore(name, chain, places, options, laps)
    if spec is None:
        raise RestoreError(f"cannot start {name} again: this robot does not know its command; start it by failover run")
    program = again(around, spec, newest)
    return await launch.begin_again(name, program, chain, places, options, act.why, waiting)


async def finished(around: Surroundings, act: acts.Restore, component: Component, outline: Snapshot, outage_ns: int) -> None:
    """Make the program of its ready copy; `Component.resume` lets it run.

    Args:
        outline: of the snapshot that it stands at.

    Raises:
        CheckpointError, AgentError: as `launch.finish`; nothing of it is left.
    """
    await launch.finish(component, outline, around.places, _options(around, act, outage_ns))


def _options(around: Surroundings, act: acts.Restore, outage_ns: int) -> launch.RestoreOptions:
    """How the component comes back, as its specification says where this robot has it."""
    spec = act.spec
    return launch.RestoreOptions(
        outage_ns,
        owner=spec.owner if spec is not None else None,
        started=program_of(spec.launch).inheritance if spec is not None else None,
        task=Task(act.epoch, engine=AUTO) if spec is not None and spec.launch.engine == AUTO else None,
        epoch=act.epoch,
        terms=terms_here(spec.launch if spec is not None else None, around.here(act.component)),
        stood_still=act.why is Resumption.HANDED_OVER,
    )


def again(around: Surroundings, spec: ComponentSpec, newest: Snapshot | None) -> launch.Program:
    """The program to start again, with the files that were brought of it; a command of this robot's own needs none of them."""
    here = around.here(spec.name)
    program = program_of(started_here(spec.launch, here))
    if newest is None or here.command or not around.places.contents:
        return program
    known = [file for file in required_files.program_of(newest) if len(file.digest) == DIGEST_SIZE]
    kept = [(file.path, str(path_in(around.places.contents, file.digest)), file.mode) for file in known]
    return replace(program, brought=tuple(file for file in kept if os.path.exists(file[1])))


def refusal(component: Component, status: int) -> str:
    """Why a program that was started again has not gone on from its state; "" if it has, or crashed, or ended well.

    A program that takes a state commits it at once (`Component.keeps`).

    Args:
        status: its wait status.
    """
    if not component.goes_on or component.keeps or not os.WIFEXITED(status) or not os.WEXITSTATUS(status):
        return ""
    said = last_line(component) or "nothing"
    return f"{component.name} did not take its state: exit code {os.WEXITSTATUS(status)} before its first commit{SAID}{said}"


def last_line(component: Component) -> str:
    """The last line that it wrote to its standard error since it was started; "" if none."""
    bounds = component.logs.bounds(2)
    piece = component.logs.read(2, max(bounds.committed, bounds.size - LINE_LIMIT), committed=False)
    lines = piece.content.decode(errors="replace").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
