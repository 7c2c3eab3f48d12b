"""Context that the modules of every component on this robot share, and the errors that can occur with a component."""

from __future__ import annotations

import os
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from msgspec import Struct, field

from agent.config import ComponentConfig
from agent.system.last_alive import LastAlive
from agent.worker.components.hooks import Hooks
from agent.worker.components.launch import Program
from agent.worker.components.paths import Places
from agent.worker.components.resume_order import ResumeOrder
from agent.worker.components.run_records import Records
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.store.contract import SnapshotStore
from failover.core.events import Event
from failover.core.types import COMMITTED, Launch


class Surroundings(Struct):
    """The objects that every supervisor works with.

    Attributes:
        tell: passes an event to the core.
        silence_ns: how long the robot that the component is taken over from has been silent, as far as known; for the outage.
        settled: returns once no snapshot of a component is being stored any more; given a position that it goes on from, with its
            output in the logs.
        here: the settings that this robot's operator gives a component.
        hooks: runs his commands.
        order: in which programs that are taken over resume.
        last_alive: tells for how long this robot was off; None: that is not known.
    """

    places: Places
    store: SnapshotStore
    records: Records
    tell: Callable[[Event], None]
    silence_ns: Callable[[str], Coroutine[Any, Any, int]]
    settled: Callable[..., Coroutine[Any, Any, None]]
    here: Callable[[str], ComponentConfig]
    hooks: Hooks = field(default_factory=Hooks)
    last_alive: LastAlive | None = None
    order: ResumeOrder = field(default_factory=ResumeOrder)


def program_of(launch: Launch) -> Program:
    """The program to start."""
    return Program(
        tuple(os.fsencode(argument) for argument in launch.argv),
        tuple(os.fsencode(f"{name}={value}") for name, value in launch.environment),
        os.fsencode(launch.directory),
        launch.umask,
        launch.isolate,
        msgspec.msgpack.decode(launch.inheritance, type=Inheritance) if launch.inheritance else None,
        launch.engine,
        launch.output == COMMITTED,
    )
