"""Ready copy of one component at its standby: built from the chain, updated with each checkpoint, handed over when needed.

A copy that fails or is inconsistent is ended and built again, at growing intervals. A program that can have no copy resumes from
its chain, and status says why.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable, Coroutine
from typing import Any, Final

from msgspec import Struct

from agent.core_config import terms_here
from agent.errors import TROUBLE
from agent.system import clock
from agent.system.crash import end_worker_on_mistake
from agent.worker.components import launch
from agent.worker.components.component import Component
from agent.worker.components.context import Surroundings, program_of
from agent.worker.components.statistics import CopyFigures, Figures
from checkpoint.errors import FormatError, StoreError, UnsupportedError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import close_all
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot import format
from failover.core.types import ComponentSpec

PAUSES_S: Final = (0.1, 1.0, 5.0, 30.0)
"""Before a copy that failed is laid again: the last one for ever."""

STEADY_S: Final = 10.0
"""How long a copy must have stood for its failure to count as the first: one whose processes come and go is laid in vain."""

UNSUPPORTED_S: Final = 60.0
"""Before it is looked again whether a program that could have none can."""

log = logging.getLogger("failover.component")


class Ready(Struct, frozen=True):
    """A copy, and the snapshot whose state it has."""

    component: Component
    outline: Snapshot


class ReadyCopy:
    """The ready copy of one component on this robot, if there should be one. Lives in one loop."""

    def __init__(self, name: str, around: Surroundings, figures: Figures) -> None:
        self._name = name
        self._around = around
        self._figures = figures
        self._ready: Ready | None = None
        self._accepted: Position | None = None
        self._outline: Snapshot | None = None
        self._news = asyncio.Event()
        self._turn = asyncio.Lock()
        self._work: asyncio.Task[None] | None = None
        self._ending: set[asyncio.Task[None]] = set()

    def keep(self, spec: ComponentSpec, tell: Callable[[bool, str], None]) -> None:
        """From now on have a copy of its newest checkpoint ready; one that there was ends.

        Args:
            tell: called with whether there is one, each time that this changes.
        """
        self.drop()
        self._work = self._task(self._follow(spec, tell))

    def accepted(self, snapshot: Snapshot) -> None:
        """The core counts another checkpoint as held here. The copy goes no further: the rest of the store may be forgotten.

        Args:
            snapshot: without its pages.
        """
        self._accepted, self._outline = snapshot.position, snapshot if self._work is not None else None
        self._news.set()

    def drop(self) -> None:
        """No copy is wanted any more; the one that exists ends; its end is not awaited."""
        work, self._work = self._work, None
        ready, self._ready = self._ready, None
        self._outline = None
        self._figures.copy = CopyFigures()
        self._around.places.process_pool.relieve(self._name, False)
        if work is not None:
            work.cancel()
        if ready is not None:
            self._undone(ready)

    async def take(self, position: Position) -> Ready | None:
        """The copy at a position, the caller's from now on; None where there is none, and then nothing is kept any more."""
        if self._work is None:
            return None
        try:
            async with self._turn:  # work under way ends first: laying takes no longer than a restore
                if self._ready is not None and self._ready.outline.position != position:
                    await self._bring_on(position)
                ready, self._ready = self._ready, None
        except TROUBLE as trouble:
            log.info("%s: its ready copy did not come to the position that is wanted: %s", self._name, trouble)
            return None
        finally:
            self.drop()
        if ready is not None and (ready.component.ended.done() or ready.outline.position != position):
            await asyncio.shield(self._undone(ready))
            return None
        return ready

    async def close(self) -> None:
        """End the copy that is kept, and see it ended."""
        self.drop()
        await asyncio.gather(*self._ending, return_exceptions=True)

    def _undone(self, ready: Ready) -> asyncio.Task[None]:
        """End it, also where the waiting task is cancelled: a guard that is left in the middle would be found as a component."""
        return self._task(ready.component.undo())

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)
        task.add_done_callback(end_worker_on_mistake)
        return task

    # --- Following the checkpoints ---

    async def _follow(self, spec: ComponentSpec, tell: Callable[[bool, str], None]) -> None:
        failures, told, laid_s = 0, False, math.inf
        while True:
            self._news.clear()
            try:
                async with self._turn:
                    if self._ready is not None:
                        await self._bring_on(self._newest())
                    else:
                        await self._lay(spec)
                        laid_s = time.monotonic()
                pause_s = None
            except UnsupportedError as refusal:
                pause_s = UNSUPPORTED_S
                await self._end("; ".join(refusal.reasons) or str(refusal))
            except TROUBLE as trouble:
                failures = 0 if time.monotonic() - laid_s >= STEADY_S else failures
                pause_s, failures, laid_s = PAUSES_S[min(failures, len(PAUSES_S) - 1)], failures + 1, math.inf
                log.info("%s: its ready copy must be built again: %s", self._name, trouble)
                if isinstance(trouble, FormatError):
                    with contextlib.suppress(StoreError):  # it is known already
                        await asyncio.to_thread(self._around.store.check, self._name, self._newest())
                await self._end(str(trouble))
            if told != (self._ready is not None):
                told = not told
                tell(told, "")
            if pause_s is not None:
                await asyncio.sleep(pause_s)
            else:
                await self._until_news()

    async def _until_news(self) -> None:
        """Until a checkpoint has come, or the copy has ended."""
        assert self._ready is not None, "it has just been brought on"
        news = asyncio.create_task(self._news.wait())
        either: set[asyncio.Future[Any]] = {news, self._ready.component.ended}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        finally:
            news.cancel()

    async def _lay(self, spec: ComponentSpec) -> None:
        terms = terms_here(spec.launch, self._around.here(self._name))
        chain = await asyncio.to_thread(self._around.store.open_chain, self._name, self._newest())
        try:
            age_ns, outline = clock.age_ns(chain[-1]), await asyncio.to_thread(format.read_outline, chain[-1])
            started = program_of(spec.launch).inheritance
            laying = asyncio.create_task(
                launch.lay(self._name, chain, self._around.places, age_ns=age_ns, owner=spec.owner, started=started, terms=terms)
            )
            try:
                component, laid = await asyncio.shield(laying)
            except asyncio.CancelledError:
                with contextlib.suppress(*TROUBLE):
                    await (await laying)[0].undo()
                raise
        finally:
            close_all(tuple(chain))
        self._stands(Ready(component, outline), laid)

    def _newest(self) -> Position | None:
        """How far the copy may go; None: as far as the store does, which an earlier life of the agent filled."""
        wanted = self._accepted
        return wanted if wanted is not None and wanted in self._around.store.positions(self._name) else None

    async def _bring_on(self, position: Position | None = None) -> None:
        """Apply the snapshots that the store holds beyond it, up to a position; lay it again where that does not continue it."""
        ready = self._ready
        assert ready is not None, "laid before"
        newest = self._around.store.chain_of(self._name, position)
        if all(entry.position != ready.outline.position for entry in newest):
            raise launch.stale(self._name)
        if newest[-1].position == ready.outline.position:
            return
        last, held = newest[-1].position, ready.outline.position
        is_known = self._outline is not None and self._outline.position == last  # nothing is read then
        deltas, outline = self._opened(last, held) if is_known else await asyncio.to_thread(self._opened, last, held)
        try:
            if outline is None:
                return
            laid, _ = await ready.component.keeper.ask(messages.Advance(clock.age_ns(deltas[-1])), tuple(deltas))
        finally:
            close_all(tuple(deltas))
        self._stands(Ready(ready.component, outline), laid)

    def _opened(self, position: Position, beyond: Position) -> tuple[list[int], Snapshot | None]:
        """The deltas from one position to another, and the outline of the last, None: the chain has just been folded."""
        deltas, known = self._around.store.open_chain(self._name, position, beyond=beyond), self._outline
        try:
            if not deltas or (known is not None and known.position == position):
                return deltas, known if deltas else None
            return deltas, format.read_outline(deltas[-1])
        except BaseException:
            close_all(tuple(deltas))
            raise

    def _stands(self, ready: Ready, laid: messages.Laid) -> None:
        self._ready = ready
        self._figures.copy = CopyFigures(True, laid.size, laid.position)
        self._around.places.process_pool.relieve(self._name, True)

    async def _end(self, why: str) -> None:
        ready, self._ready = self._ready, None
        self._figures.copy = CopyFigures(why=why)
        self._around.places.process_pool.relieve(self._name, False)
        if ready is not None:
            await asyncio.shield(self._undone(ready))
