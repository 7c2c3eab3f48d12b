"""Supervisor of one component on this robot: carries out the core's acts on it in order and answers by events.

Acts of one component wait for one another; acts of two components do not. Two kinds do not wait: the renewal of a lease and the
freeze of a program, however long a capture takes. They go to the guard, which no other work keeps busy.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Final

from msgspec.structs import replace

from agent.core_config import begun_on
from agent.errors import TROUBLE, AgentError, GuardError, GuardLostError, KeeperLostError
from agent.system import clock
from agent.system.adopted_process import Guest
from agent.system.crash import end_worker_on_mistake
from agent.worker.components import launch, resume, under_way
from agent.worker.components.component import Component
from agent.worker.components.context import Surroundings, program_of
from agent.worker.components.hook_runner import Occasions
from agent.worker.components.ready_copy import ReadyCopy
from agent.worker.components.restore_limits import bound_of
from agent.worker.components.snapshots import Snapshots, newest_of
from agent.worker.components.statistics import NOT_WANTED, Commits, CopyFigures, Figures, Resumed, shortened
from agent.worker.components.warm_program import Standby
from checkpoint.engine import COOPERATIVE, LASTING_NOTES
from checkpoint.errors import (
    ChainError,
    CheckpointError,
    FormatError,
    NothingCommittedError,
    ProcessGoneError,
    StoreError,
    UnsupportedError,
)
from checkpoint.keeper.messages import close_all
from checkpoint.model import Position
from checkpoint.snapshot import format
from failover.core import acts, events
from failover.core.acts import Act
from failover.core.event_log.decisions import SAID
from failover.core.types import ComponentSpec, Resumption

KILLED: Final = 9
"""The wait status of a program whose guard was lost: as of one that was killed."""

LAST_WORD_S: Final = 1.0
"""How long the end of the worker waits for a guard that is being told of a lease."""

log = logging.getLogger("failover.component")


@dataclass(slots=True)
class Supervisor:
    """The component and the acts that are due on it.

    Attributes:
        component: None while nothing of it runs here.
        standby, copy: wait here to take it over: a program that keeps its state, or any other's memory.
        epoch: of the newest act; an older one is dropped.
        ended: set by the core's word that the component's end is a record.
        guest: the running process that a client has just named, to be taken in; the client's, while it waits.
    """

    name: str
    around: Surroundings
    component: Component | None = None
    epoch: int = 0
    figures: Figures = field(default_factory=Figures)
    started: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Future[acts.ReportExit] | None = None
    guest: Guest | None = None
    standby: Standby = field(init=False)
    copy: ReadyCopy = field(init=False)
    _snapshots: Snapshots = field(init=False)
    _occasions: Occasions = field(init=False)
    _queue: asyncio.Queue[Act | asyncio.Future[None]] = field(default_factory=asyncio.Queue)
    """A future is done once everything before it has been carried out, or was in vain."""
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)
    _at_guard: set[asyncio.Task[None]] = field(default_factory=set)
    """Those of them that tell the guard of a lease, or have it hold the program still."""
    _cleared: asyncio.Event = field(default_factory=asyncio.Event)
    """Not while a copy is being ended that is none of ours any more."""
    _coming: Component | None = None
    """One that is being restored: it has a lease already."""
    _lease_until_ns: int = 0
    """The core's last word, also where the guard does not know it yet."""
    _is_held: bool = False
    """Whether the core wants it to stand still, regardless of acts still in the queue."""
    _is_thaw_owed: bool = False
    """A thaw was refused, for its lease was over by then; the next lease brings it."""
    _to_prune: acts.Prune | None = None
    _pruning: asyncio.Task[None] | None = None
    _not_let_go: Exception | None = None
    """Why the order to let it go was in vain; None: it was not, or a caller has been told."""

    def __post_init__(self) -> None:
        self._cleared.set()
        self.standby = Standby(self.name, self.around.places)
        self.copy = ReadyCopy(self.name, self.around, self.figures)
        self._snapshots = Snapshots(self.name, self.around, self.figures)
        self._occasions = Occasions(self.name, self.around, self.figures)

    def begin(self) -> None:
        """Start to carry acts out."""
        self._task(self._work())

    def order(self, act: Act) -> None:
        """Take an act in."""
        self._note_lease(act)
        if isinstance(act, acts.Restore):
            self.around.order.begins(self.name)
        if isinstance(act, acts.SetLease | acts.Freeze):
            telling = self._task(self._at_once(act))
            self._at_guard.add(telling)
            telling.add_done_callback(self._at_guard.discard)
        elif isinstance(act, acts.Warm):
            self._warm(act)
        elif isinstance(act, acts.Cool):
            self._cool()
        else:
            self._queue.put_nowait(act)

    def _note_lease(self, act: Act) -> None:
        """Leases and freezes overtake the acts that wait in the queue: a thaw or a restore must not bring an older lease back."""
        match act:
            case acts.SetLease():
                self._lease_until_ns = act.until_ns
            case acts.Start() | acts.Restore() | acts.Thaw():
                self._lease_until_ns, self._is_held, self._is_thaw_owed = act.lease_until_ns, False, False
            case acts.Freeze():
                self._is_held, self._is_thaw_owed = True, False

    def _warm(self, act: acts.Warm) -> None:
        """Have the program wait, or its copy stand ready, unless this robot's operator does not want that."""
        here, newest = self.around.here(self.name), newest_of(self.around.store, self.name)
        keeps_state = newest is not None and newest.engine == COOPERATIVE
        self._cool()
        if not (here.warm if keeps_state else here.ready_copy):
            self.figures.copy = CopyFigures(why="" if keeps_state else NOT_WANTED, wanted=False)
            return

        def tell(ready: bool, why: str) -> None:
            self.around.tell(events.Warmed(self.name, act.epoch, ready, why))

        if keeps_state:
            self.standby.warm(resume.again(self.around, act.spec, newest), act.spec.owner, tell)
        else:
            self.copy.keep(act.spec, tell)

    def _cool(self) -> None:
        self.standby.cool()
        self.copy.drop()

    @property
    def is_prepared_first(self) -> bool:
        """Whether a hook gets this robot ready before the program goes on here."""
        return self._occasions.prepares(self.figures.spec)

    def adopt(self, component: Component, epoch: int) -> None:
        """A guard was found alive after a restart."""
        component.keeper.terms = self.around.records.terms(self.name)
        self.component, self.epoch = component, epoch
        self.started.set()
        self._watch_the_end()

    async def let_go(self) -> None:
        """Wait until the guard has been told of an order to let go: before that, the next worker would find the program again.

        Raises:
            AgentError: it was in vain; with the reason.
        """
        reached = asyncio.get_running_loop().create_future()
        self._queue.put_nowait(reached)
        await reached
        trouble, self._not_let_go = self._not_let_go, None
        if trouble is not None:
            raise AgentError(f"cannot let {self.name} go: {trouble}") from trouble

    async def close(self) -> None:
        """Let everything go; the program runs on, and its guard has been told of the last lease."""
        if self._at_guard:
            await asyncio.wait(self._at_guard, timeout=LAST_WORD_S)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.standby.close()
        await self.copy.close()
        if self.component is not None:
            self.component.close()

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(end_worker_on_mistake)
        return task

    # --- acts ---

    async def _work(self) -> None:
        while True:
            act = await self._queue.get()
            if isinstance(act, asyncio.Future):
                if not act.done():  # the task that waited for it may have hung up
                    act.set_result(None)
                continue
            if act.epoch < self.epoch and not isinstance(act, acts.Stop):  # type: ignore[union-attr]
                log.info("%s: an order of epoch %d came after epoch %d; dropped", self.name, act.epoch, self.epoch)  # type: ignore[union-attr]
                self._note_resumed(act)
                continue
            self.epoch = max(self.epoch, act.epoch)  # type: ignore[union-attr]
            try:
                await self._carry_out(act)
            except TROUBLE as trouble:
                await self._told_of(act, trouble)
            finally:
                self._note_resumed(act)

    def _note_resumed(self, act: Act) -> None:
        """Those that run after it need not wait for it any more, whatever became of it."""
        if isinstance(act, acts.Restore):
            self.around.order.ended(self.name)

    async def _carry_out(self, act: Act) -> None:
        match act:
            case acts.Start():
                await self._start(act)
            case acts.Restore():
                await self._restore(act)
            case acts.Capture():
                if act.hold:
                    self._is_thaw_owed = False  # a lease that comes meanwhile lets nothing run that is to be handed over
                component = self._present()
                await self._occasions.before_capture(act, component.pid)
                with under_way.told(self.around.tell, events.UnderWay(self.name, act.epoch)):
                    await self._snapshots.capture(component, act)
            case acts.Acknowledge():
                if self.component is not None:
                    await self.component.acknowledge(act.position, is_safe=act.is_safe)
            case acts.Thaw():
                await self._thaw(act)
            case acts.End():
                if self.component is not None:
                    self._task(self._end(self.component, act.signal))
            case acts.Stop():
                self._cool()
                await self._stop()
                self.around.tell(events.Stopped(self.name, act.epoch))
            case acts.LetGo():
                await self._let_go()
            case acts.KeepAside():
                await self._keep_aside(act)
            case acts.Prune():
                self._prune(act)
            case acts.Forget() | acts.Drop():
                if self._pruning is not None:
                    await asyncio.wait((self._pruning,))
                await self._snapshots.tidy(act)
            case acts.ReportExit():
                await self._report(act)

    def _prune(self, act: acts.Prune) -> None:
        """Put away beside the queue: a chain is folded then, for a second or more, and a takeover would wait for that."""
        is_idle = self._pruning is None or self._pruning.done()
        if is_idle and not self.around.store.is_prune_due(self.name, act.oldest):
            return  # as after most deltas
        self._to_prune = act
        if is_idle:
            self._pruning = self._task(self._prune_all())

    async def _prune_all(self) -> None:
        """The newest order, and the one that came meanwhile: the others are contained in it."""
        while (act := self._to_prune) is not None:
            self._to_prune = None
            try:
                await self._snapshots.tidy(act)
            except TROUBLE as trouble:
                await self._told_of(act, trouble)

    async def _told_of(self, act: Act, trouble: Exception) -> None:
        """Say what went wrong, to the log and to the core where it waits for it."""
        message = str(trouble) or type(trouble).__name__
        reasons = tuple(getattr(trouble, "reasons", ())) or (message,)
        if isinstance(act, acts.Capture) and self.component is not None and self.component.engine == COOPERATIVE:
            self.component.limit_output(False)  # perhaps it is its output that keeps it from its next commit
        if isinstance(trouble, NothingCommittedError) and isinstance(act, acts.Capture):
            self.figures.reasons = ()
            self.around.tell(events.NothingToCapture(self.name, act.epoch, message))
            return
        if not isinstance(act, acts.Capture) or reasons != self.figures.reasons:  # a capture is tried again every second
            log.warning("%s: %s: %s", self.name, type(act).__name__, message, extra={"epoch": getattr(act, "epoch", 0)})
        match act:
            case acts.LetGo():
                self._not_let_go = trouble
            case acts.Capture():
                unsupported = isinstance(trouble, UnsupportedError)
                self.figures.reasons = reasons
                by_keeper = isinstance(trouble, KeeperLostError)
                self.around.tell(events.CaptureFailed(self.name, act.epoch, shortened(reasons), unsupported, by_keeper))
            case acts.Start() | acts.Restore():
                guest = isinstance(act, acts.Start) and act.spec.launch.pid != 0
                with contextlib.suppress(*TROUBLE):
                    await (self._let_go() if guest else self._stop())
                damaged = None
                if isinstance(act, acts.Restore) and isinstance(trouble, FormatError | ChainError | StoreError):
                    damaged = await asyncio.to_thread(self._damaged, act.position, trouble)
                self.figures.reasons = reasons
                self.around.tell(events.ActFailed(self.name, act.epoch, message, damaged))

    def _damaged(self, position: Position, trouble: Exception) -> Position | None:
        """The checkpoint, if that is what is wrong with it; what was altered is offered no more."""
        store = self.around.store
        with contextlib.suppress(StoreError):  # it is known already
            store.check(self.name, position)
        is_read = not isinstance(trouble, FormatError | ChainError) and position in store.positions(self.name)
        return None if is_read else position

    async def _at_once(self, act: acts.SetLease | acts.Freeze) -> None:
        component = self.component or self._coming
        if component is None or act.epoch < self.epoch:
            return
        try:
            if isinstance(act, acts.Freeze):
                await component.freeze()
                self._notice(f"it stands still here, as process {component.pid}", component)
                return
            await component.lease(act.until_ns)
            if act.is_asked:
                self.around.tell(events.Leased(self.name, act.epoch, act.until_ns))
            if self._is_thaw_owed:
                await self._thaw_under_its_lease(component)
        except TROUBLE as trouble:
            log.warning("%s: %s: %s", self.name, type(act).__name__, trouble)

    async def _start(self, act: acts.Start) -> None:
        self._cool()
        adopted = self.component is not None
        self._occasions.runs_here(act.spec)
        owner = bound_of(act.spec.owner, program_of(act.spec.launch).inheritance)
        terms = replace(begun_on(act.spec.launch, self.around.here(self.name)), owner=owner)
        self.around.records.note(self.name, act.epoch, terms)
        if self.component is None:
            await self.around.settled(self.name)
            if not act.spec.launch.pid:
                await self._occasions.before_start(act)
            self.component = await self._begun(act.spec, act.epoch)
        self.component.keeper.terms = terms
        await self.component.lease(self._lease_until_ns)
        await self._protect(refuse=act.spec.launch.pid != 0)
        if act.spec.launch.pid and not adopted:
            self.component.begin_output(act.spec.owner)  # not before: one that is refused leaves a namesake's output as it is
        self.started.set()
        self.around.tell(events.Started(self.name, act.epoch))
        if not adopted:
            self._watch_the_end()

    async def _begun(self, spec: ComponentSpec, epoch: int) -> Component:
        if spec.launch.pid:
            return await launch.watch(self.name, self._named(spec.launch.pid), self.around.places)
        return await launch.start(self.name, program_of(spec.launch), self.around.places, epoch, spec.owner)

    def _named(self, pid: int) -> Guest:
        """The process that a client named: the one that was asked whose it is, where no earlier worker did that.

        Raises:
            ProcessGoneError: it has ended.
        """
        asked = self.guest if self.guest is not None and self.guest.pid == pid else None
        try:
            found = Guest(pid)
        except OSError as error:
            raise ProcessGoneError(f"cannot protect pid {pid}: {error.strerror}") from error
        if asked is not None and asked.has_ended:  # asked after it was opened: else both are of one process
            found.close()
            raise ProcessGoneError(f"cannot protect pid {pid}: it has ended, and another process may have its number")
        return found

    async def _protect(self, *, refuse: bool) -> None:
        """Give it a keeper. A program that was started here runs on unprotected where it cannot have one; a guest is refused."""
        assert self.component is not None
        try:
            self.figures.reasons = ()
            self.figures.notes = await self.component.protect()
        except NothingCommittedError as early:
            log.info("%s: %s", self.name, early)
        except (CheckpointError, KeeperLostError) as trouble:
            self.figures.reasons = trouble.reasons if isinstance(trouble, UnsupportedError) else (str(trouble),)
            if refuse:
                await self._let_go()
                raise

    async def _restore(self, act: acts.Restore) -> None:
        began_ns, laps, is_first = clock.now_ns(), clock.Laps(), self.component is None
        silent_ns = await self.around.silence_ns(self.name) if act.why is Resumption.TAKEN_OVER else 0
        await self._stop()
        await self.around.settled(self.name, act.position)
        laps.lap("asking and clearing away")
        descriptors = await asyncio.to_thread(self.around.store.open_chain, self.name, act.position)
        laps.lap(f"opening {len(descriptors)} snapshots")
        try:
            outage_ns, read_ns = clock.age_ns(descriptors[-1]), clock.now_ns()
            off_ns = silent_ns if silent_ns > 0 else self._off_ns(outage_ns) if is_first else 0
            idle_ns = off_ns + read_ns - began_ns
            occasion = await self._occasions.before_resume(act, descriptors[-1], outage_ns)
            laps.lap("preparing")
            component, age_ns = await self._resumed(act, descriptors, outage_ns, laps)
            self.component = component  # before anything is waited for: leases and freezes reach it
            acts_ns = component.let_go_ns or clock.now_ns()
            self.figures.restores += 1
            self.figures.commits = Commits()  # of another process: its numbers begin anew
            self.figures.reasons = ()
            self.figures.notes = tuple(note for note in component.notes if note.startswith(LASTING_NOTES))
            self.figures.outage_ms = (silent_ns + acts_ns - began_ns) / 1e6
            since = f"the last word of the robot that ran it: silence {silent_ns / 1e6:.1f} ms, " if silent_ns else "the order: "
            protecting = f"; protecting it again {(clock.now_ns() - acts_ns) / 1e6:.1f} ms" if component.let_go_ns else ""
            sentence = f"it acts again {self.figures.outage_ms:.1f} ms after {since}{laps}{protecting}"
            log.info("%s: %s", self.name, sentence, extra={"epoch": act.epoch})
            self.started.set()
            lost_ns = 0 if act.why is Resumption.HANDED_OVER else max(0, age_ns - idle_ns)
            self.around.tell(events.Restored(self.name, act.epoch, act.position, age_ns + clock.now_ns() - read_ns, lost_ns))
            self._notice(sentence)
            self._watch_the_end()
            if occasion is not None:
                self._task(self._occasions.after_resume(act.spec, occasion, component.pid))
            self.figures.resumed = await asyncio.to_thread(_resumed_from, descriptors[-1], act.position, acts_ns)
        finally:
            close_all(tuple(descriptors))

    def _off_ns(self, age_ns: int) -> int:
        """For how long nothing ran here since a checkpoint that is so old, because this robot was off."""
        return self.around.last_alive.off_ns(age_ns) if self.around.last_alive is not None else 0

    async def _resumed(self, act: acts.Restore, chain: list[int], outage_ns: int, laps: clock.Laps) -> tuple[Component, int]:
        """The component, running, and the age of its state: from its copy or program that waits here, else from its beginning."""
        copied = await self.copy.take(act.position)
        if copied is not None:
            laps.lap("taking the ready copy")
            try:
                await resume.finished(self.around, act, copied.component, copied.outline, outage_ns)
                laps.lap("its descriptors, timers and registers")
                return await self._let_it_run(copied.component, act, outage_ns, laps)
            except TROUBLE as trouble:
                log.warning("%s: its ready copy cannot resume; the agent restores it from its chain: %s", self.name, trouble)
        waiting = self.standby.take()
        if waiting is not None:
            try:
                component = await resume.brought_back(self.around, act, chain, outage_ns, laps, waiting)
                return await self._let_it_run(component, act, outage_ns, laps)
            except TROUBLE as trouble:
                log.warning("%s: the program that waited here cannot resume it; the agent starts it anew: %s", self.name, trouble)
        component = await resume.brought_back(self.around, act, chain, outage_ns, laps)
        return await self._let_it_run(component, act, outage_ns, laps)

    async def _let_it_run(
        self, component: Component, act: acts.Restore, outage_ns: int, laps: clock.Laps
    ) -> tuple[Component, int]:
        """Give it the newest lease, and those that come while it is resumed; then it runs, or nothing of it is left."""
        prepared = component.prepared
        self.around.records.note(self.name, act.epoch, component.keeper.terms)
        self._coming = component
        try:
            if self._lease_until_ns:
                await component.lease(self._lease_until_ns)
            await self._predecessors(laps)
            told = self._occasions.told_by(act)
            untold = await component.resume(told)
            self.around.order.ended(self.name)
            laps.lap("letting it go", clock.now_ns() - component.let_go_ns if component.let_go_ns else 0)
            if told:
                self._occasions.told(told[0], untold)
        except GuardError:
            await component.undo()
            raise
        finally:
            self._coming = None
        return component, prepared.age_ns if prepared is not None else outage_ns

    async def _predecessors(self, laps: clock.Laps) -> None:
        """Wait for those that are resumed here, too."""
        if not self.around.order.has_predecessors(self.name):
            return
        missing = await self.around.order.turn_of(self.name)
        laps.lap("waiting for its predecessors")
        if missing:
            log.warning("%s: it resumes before %s, which do not run yet", self.name, ", ".join(sorted(missing)))

    async def _thaw(self, act: acts.Thaw) -> None:
        component = self._present()
        self.around.records.note(self.name, act.epoch, component.keeper.terms)
        if self._is_held:
            return  # by a newer order
        await component.lease(self._lease_until_ns)
        await self._thaw_under_its_lease(component)

    async def _thaw_under_its_lease(self, component: Component) -> None:
        """Let it go on; the guard refuses where the lease has run out by now, and the core renews it while it acts."""
        self._is_thaw_owed = True
        await component.thaw()
        self._is_thaw_owed = False

    async def _end(self, component: Component, number: int) -> None:
        try:
            await component.stop(number)
        except TROUBLE as trouble:
            log.warning("%s: cannot end it: %s", self.name, trouble)

    async def _stop(self) -> None:
        """Kill this robot's copy and clear it away; there may be none."""
        component, self.component = self.component, None
        if component is None:
            return
        self._cleared.clear()
        try:
            with contextlib.suppress(GuardLostError):  # the program ended with it
                await component.stop(signal.SIGKILL)
            await component.forget()
        finally:
            self._cleared.set()
            self.around.records.forget(self.name)
            component.close()

    async def cleared(self, patience_s: float) -> None:
        """Wait, for so long at most, until a copy that is being ended here holds nothing any more."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._cleared.wait(), patience_s)

    async def _let_go(self) -> None:
        component, self.component = self.component, None
        if component is not None:
            await component.release()
            self.around.records.forget(self.name)

    async def _keep_aside(self, act: acts.KeepAside) -> None:
        component = self._present()
        path = await self._snapshots.keep_aside(component, act)
        self._notice(
            f"the copy that lost is kept for inspection in {path}; failover logs does not show its output since then", component
        )

    async def _report(self, act: acts.ReportExit) -> None:
        """The end is a record now: tell the waiting clients, and let the guard go."""
        self.figures.exit_status, self.figures.reasons = act.status, ()
        self.started.set()
        ended = self.end()
        if not ended.done():
            ended.set_result(act)
        component, self.component = self.component, None
        if component is not None:
            if act.failed and not component.ended.done():
                await component.stop(signal.SIGKILL)
            await component.forget()
            self.around.records.forget(self.name)

    # --- the program ---

    def end(self) -> asyncio.Future[acts.ReportExit]:
        """Done once the end of the component is a record."""
        if self.ended is None or (self.ended.done() and self.component is not None):
            self.ended = asyncio.get_running_loop().create_future()
        return self.ended

    def _notice(self, sentence: str, component: Component | None = None) -> None:
        """For ``failover why``; with how much a component has written that is in no checkpoint."""
        pending = component.output_pending() if component is not None else -1
        self.around.tell(events.Noticed(self.name, sentence, pending))

    def _present(self) -> Component:
        if self.component is None:
            raise AgentError(f"{self.name} does not run on this robot")
        return self.component

    def _watch_the_end(self) -> None:
        """From now on, and not before the core knows that it runs, tell when it has ended, and when it commits first."""
        component = self._present()
        component.committed = self._see_the_commit
        if component.keeps:  # it was quicker
            self._see_the_commit()
        self._task(self._see_the_end(component))

    def _see_the_commit(self) -> None:
        self.around.tell(events.Committed(self.name, self.epoch))

    async def _see_the_end(self, component: Component) -> None:
        try:
            status = await asyncio.shield(component.ended)
        except AgentError as trouble:
            log.error("%s: its guard is gone: %s", self.name, trouble)
            status = KILLED
        if self.component is component and self._cleared.is_set():
            self.figures.crashes += bool(status and os.WIFSIGNALED(status))
            refusal = resume.refusal(component, status or 0)
            if refusal:
                log.warning("%s", refusal)
            line = resume.last_line(component) if status else ""
            said = f"{SAID}{line}" if line else ""
            self.around.tell(events.Exited(self.name, self.epoch, status or 0, refusal, component.keeps, said))


def _resumed_from(snapshot: int, position: Position, acts_ns: int) -> Resumed | None:
    """For the status: whose checkpoint it resumed from, and when that was taken. It runs already, whatever is read here."""
    with contextlib.suppress(*TROUBLE):
        outline = format.read_outline(snapshot)
        return Resumed(acts_ns, outline.machine.robot, outline.clocks.realtime_ns, position)
    return None
