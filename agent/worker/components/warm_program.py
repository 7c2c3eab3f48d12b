"""Warm program at its standby: started in advance, tried again when it fails, handed over when it is needed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable
from typing import Any, Final

from agent.errors import TROUBLE, GuardError, GuardLostError
from agent.system import clock
from agent.system.crash import end_worker_on_mistake
from agent.worker.components import launch
from agent.worker.components.component import Component
from agent.worker.components.launch import Program
from agent.worker.components.paths import Places
from failover.core.event_log.decisions import SAID

READY_S: Final = 60.0
"""How long a program may take until it says that it keeps a state; it imports what it needs meanwhile."""

PAUSES_S: Final = (1.0, 5.0, 30.0, 120.0)
"""Before a program that did not get so far, or ended while it waited, is started again: the last one for ever."""

STEADY_NS: Final = 60 * 10**9
"""One that waited so long before it ended is none that fails again and again."""

CURE: Final = "install it here, or give this robot a command of its own for it in agent.toml"

log = logging.getLogger("failover.component")


class Standby:
    """The program of one component that waits on this robot, if one should. Lives in one loop."""

    def __init__(self, name: str, places: Places) -> None:
        self._name = name
        self._places = places
        self._work: asyncio.Task[None] | None = None
        self._ending: set[asyncio.Task[None]] = set()
        self._ready: Component | None = None
        self._given: Component | None = None
        """The component that was taken last: it is not ours to end."""

    def warm(self, program: Program, owner: int, tell: Callable[[bool, str], None]) -> None:
        """From now on have this program wait; one that waited before ends.

        Args:
            tell: called with whether it is ready, and why not, each time that this changes.
        """
        self.cool()
        self._work = asyncio.create_task(self._keep_warm(program, owner, tell))
        self._work.add_done_callback(end_worker_on_mistake)

    def cool(self) -> None:
        """No program is to wait any more; one that does is ended; its end is not awaited."""
        work, self._work, self._ready = self._work, None, None
        if work is not None:
            work.cancel()
            self._ending.add(work)
            work.add_done_callback(self._ending.discard)

    def take(self) -> Component | None:
        """The program that waits, the caller's from now on; None where none is ready, and then none waits any more."""
        ready = self._ready
        if ready is not None and (ready.ended.done() or not ready.task_pid):
            ready = None
        self._given = ready
        self.cool()
        return ready

    async def close(self) -> None:
        """End the program that waits, and see it ended."""
        self.cool()
        await asyncio.gather(*self._ending, return_exceptions=True)

    async def _keep_warm(self, program: Program, owner: int, tell: Callable[[bool, str], None]) -> None:
        failures = 0
        while True:
            began_ns = clock.now_ns()
            try:
                why = await self._wait_here(program, owner, tell)
            except GuardLostError as error:
                why = str(error)
            except GuardError as error:
                why = f"{error}; {CURE}"
            except TROUBLE as error:
                why = str(error)
            failures = 0 if clock.now_ns() - began_ns > STEADY_NS else failures
            log.info("%s: its program does not wait: %s", self._name, why)
            tell(False, why)
            await asyncio.sleep(PAUSES_S[min(failures, len(PAUSES_S) - 1)])
            failures += 1

    async def _wait_here(self, program: Program, owner: int, tell: Callable[[bool, str], None]) -> str:
        """Start it once; returns why it waits no longer."""
        component = await self._born(program, owner)
        try:
            if why := await _hindrance(component):
                return why
            self._ready = component
            log.info("%s: its program waits, pid %d", self._name, component.pid)
            tell(True, "")
            await asyncio.shield(component.ended)
            return f"it {_how(component)} while it waited" + _said(component)
        finally:
            if self._ready is component:
                self._ready = None
            if component is not self._given:
                undone = asyncio.create_task(component.undo())  # whole, also if we are cancelled: the rest would be found again
                self._ending.add(undone)
                undone.add_done_callback(self._ending.discard)
                await asyncio.shield(undone)

    async def _born(self, program: Program, owner: int) -> Component:
        """Start it; one that is not wanted any more by then is not left behind."""
        birth = asyncio.create_task(launch.start_to_wait(self._name, program, self._places, owner))
        try:
            return await asyncio.shield(birth)
        except asyncio.CancelledError:
            with contextlib.suppress(*TROUBLE):
                await (await birth).undo()
            raise


async def _hindrance(component: Component) -> str:
    """Wait until it is ready; why it will not be, "" if it is."""
    connected = asyncio.create_task(component.connected.wait())
    either: set[asyncio.Future[Any]] = {connected, component.ended}
    try:
        await asyncio.wait(either, timeout=READY_S, return_when=asyncio.FIRST_COMPLETED)
    finally:
        connected.cancel()
    if component.ended.done():
        return f"it {_how(component)} before it asked for its state" + _said(component)
    if not component.connected.is_set():
        return f"it has not asked for its state within {READY_S:.0f} s; put such long work after failover.resume()"
    return ""


def _how(component: Component) -> str:
    """How it ended, by its wait status.

    Raises:
        GuardLostError: with its guard.
    """
    status = component.ended.result() or 0
    return f"was ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"ended with exit code {status >> 8}"


def _said(component: Component) -> str:
    """Its last words."""
    return f"{SAID}{component.last_words[-1]}" if component.last_words else ""
