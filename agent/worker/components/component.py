"""One component on this robot: its guard, keeper and streams as one object to capture, freeze and end.

All of it belongs to one asyncio loop (the worker process). Everything here survives the agent: a restarted agent finds the guards
by their sockets (`agent.worker.components.launch.reconnect`) and gives each component a new keeper, whose first capture is a
base.

    component = await launch.start("/lab/robot1/mapper", program, places)
    await component.protect()
    captured = await component.capture(base=False, generation=1, sequence=7, epoch=3)   # send captured.snapshot to the standby …
    await component.acknowledge(captured.position)                                      # … and when it is stored there
    status = await component.ended                                                      # a wait status, then:
    await component.forget()

On the standby, when it takes over:

    component = await launch.restore(name, chain_descriptors, places, options)         # stopped, whole, uncommitted
    await component.resume()                                                            # it runs, protected already
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, Final

from msgspec import Struct

from agent.errors import GuardError, GuardLostError, KeeperLostError
from agent.guard import messages
from agent.guard.messages import Described, Exited, Refused, Started, TaskConnected, TaskKeeps, VesselReady
from agent.guard.output_logs import STREAMS, OutputLogs, discard, logs_of
from agent.guard.output_pump import HOLD_LIMIT
from agent.system.adopted_process import Guest
from agent.worker.components.connection import Dialogue
from agent.worker.components.keeper_client import Following
from agent.worker.components.paths import Places, log_directory
from checkpoint.engine import AUTO, COOPERATIVE, PTRACE
from checkpoint.errors import CheckpointError, NothingCommittedError, ProcessGoneError, UnsupportedError
from checkpoint.keeper import messages as keeper_messages
from checkpoint.keeper.messages import close_all
from checkpoint.model import Position

HELLO_PATIENCE_S: Final = 10.0
"""How long a program may take to say that it keeps its state, before it is an alarm that it cannot be captured from outside."""

TOTALS_LIMIT: Final = 64
"""Captures whose acknowledgement may still come; the core has one under way."""


class Captured(Struct, frozen=True):
    """One snapshot, fresh from the keeper.

    Attributes:
        parent: None for a base: also when a delta was asked of a keeper that has nothing to start from.
        snapshot: a sealed memfd with the encoded snapshot, or what was the keeper's spare file; the receiver closes it.
        size: bytes of it.
        commit, age_ns: of a program that keeps its state: number of the commit that it holds, and how old that was.
        slack: how it met the activations of the program's tasks; None: it has none, or the capture was not to wait.
        known_bytes: of its pages, those whose last content was remembered.
        frozen_bytes: of its pages, those that were copied while the program stood still.
        cpu_us: processor time that it took of the keeper.
    """

    position: Position
    parent: Position | None
    snapshot: int
    size: int
    freeze_us: int
    dirty_bytes: int
    notes: tuple[str, ...]
    commit: int = 0
    age_ns: int = 0
    known_bytes: int = 0
    frozen_bytes: int = 0
    slack: keeper_messages.Slack | None = None
    cpu_us: int = 0


class Prepared(Struct, frozen=True):
    """A program that keeps its state, before it goes on: it is started again, or waits already.

    Attributes:
        segment: descriptor of its state; ours to close.
        age_ns: how old that state is, since its commit.
    """

    order: messages.Start | messages.BeginTask
    segment: int
    age_ns: int


class Standing(Struct, frozen=True):
    """How a component stands, for ``status``. ``notes`` are whole sentences: each thing missing or degraded, and why."""

    state: str
    pid: int
    inner_pid: int
    isolated: bool
    frozen_by: str
    freezes_by: str
    exit_status: int | None
    totals: tuple[int, int]
    lease_until_ns: int
    notes: tuple[str, ...]


class Component:
    """One program under protection. Made in `agent.worker.components.launch`; ended by `forget` or `release`.

    Attributes:
        name, pid, inner_pid, isolated: as the guard said.
        logs: its output; `OutputLogs.read` serves ``failover logs``.
        guest: where it is not the guard's child.
        engine_wanted: as it was asked for: `AUTO`, `PTRACE` or `COOPERATIVE`.
        task_pid: of the process that keeps its state, 0 before it has said so (``connected``); keeps: it has made a commit.
        goes_on: it was started again, or had waited, with a state that it was to go on from.
        committed: called at its first commit to each segment.
        last_words: its guard's notes on its end.
        keeper: captures it.
        commit: the message with which `resume` commits to it.
        prepared: a program that is to be started with a state, by `resume`.
        streams: the guard's descriptors: counters, two read ends, two logs; none of a program that is not the guard's child.
        let_go_ns: when `resume` let it go on, by our clock; 0 where it is not known.
        ended: the wait status once the program has ended (None: it was not our child); GuardLostError if the guard died first.
    """

    def __init__(self, name: str, guard: Dialogue, places: Places) -> None:
        self.name = name
        self.pid = self.inner_pid = 0
        self.isolated = False
        self.notes: tuple[str, ...] = ()
        self.logs = OutputLogs(log_directory(name, places))
        self.ended: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()
        self._guard = guard
        self.keeper = Following(name, places)
        self.streams: tuple[int, ...] = ()
        self.let_go_ns = 0
        self._totals: dict[Position, tuple[int, int]] = {}
        self._commits: dict[Position, int] = {}
        self.engine_wanted = PTRACE
        self._impatient_at = asyncio.get_running_loop().time() + HELLO_PATIENCE_S
        self.task_pid = 0
        self.keeps = self.goes_on = False
        self.committed: Callable[[], None] = lambda: None
        self.connected = asyncio.Event()
        self.last_words: tuple[str, ...] = ()
        self.prepared: Prepared | None = None
        self.commit = messages.Commit()
        self._lease_until_ns = 0
        self._held = False
        self._output_limited: bool | None = None
        self._hears_kept = True
        self.guest: Guest | None = None
        guard.heard = self._heard
        guard.ended = self._guard_lost

    def begin_output(self, owner: int) -> None:
        """Its output begins anew, and is this owner's. A namesake that was let go may still write: to files without a name.

        Raises:
            OSError: its logs cannot be written.
        """
        directory = self.logs.directory
        self.logs.close()
        discard(directory)
        self.logs = logs_of(directory, owner)

    @property
    def engine(self) -> str:
        """By which it is captured now: `PTRACE` or `COOPERATIVE`."""
        if self.engine_wanted != AUTO:
            return self.engine_wanted
        return COOPERATIVE if self.task_pid else PTRACE

    def output_pending(self) -> int:
        """Bytes that it has written and that are in no acknowledged checkpoint: a takeover now would lose them.

        Raises:
            OSError: its logs cannot be looked at.
        """
        bounds = [self.logs.bounds(stream) for stream in STREAMS]
        return sum(stream.size - stream.committed for stream in bounds)

    async def resume(self, told: tuple[int, int] | None = None) -> str:
        """After `launch.restore`: commit to it and let it go on.

        Args:
            told: a signal, and its value, that it gets before its next instruction.

        Returns:
            Why it was not told; "" if it was, or was not wanted.

        Raises:
            RestoreError, GuardError, KeeperLostError: it did not get that far; nothing of it is left.
        """
        if self.prepared is not None:
            await self._begin_again(self.prepared)
            return "a program that is started again from its state is called back by on_resume" if told else ""
        untold = ""
        try:
            _, streams = await self.ask_guard(self.commit)
            untold = await self._tell(*told) if told else ""
            if streams:
                self._take_streams(streams)
            resumed, _ = await self.keeper.ask(keeper_messages.Resume(bool(streams)), streams)
        except (CheckpointError, GuardError, KeeperLostError):
            await self.undo()
            raise
        self.notes = (*self.notes, *resumed.notes)
        self.let_go_ns = resumed.let_go_ns
        if any(note.startswith(keeper_messages.UNPROTECTED) for note in resumed.notes):
            self._drop_keeper()  # the next capture tries with a new one
        else:
            self.keeper.followed = PTRACE, self.pid
        return untold

    async def _tell(self, number: int, value: int) -> str:
        """Have a signal wait for it; why not, "" if it does."""
        try:
            await self.ask_guard(messages.Tell(number, value))
        except GuardLostError:
            raise
        except GuardError as error:
            return str(error)
        return ""

    async def _begin_again(self, prepared: Prepared) -> None:
        """Have the program go on with the state that waits for it. One that waits has its lease before it can take a step."""
        self.prepared, self.goes_on = None, True
        try:
            if isinstance(prepared.order, messages.BeginTask):
                await self.lease(self._lease_until_ns)
            born, streams = await self.ask_guard(prepared.order, (prepared.segment,))
            self.take(born, streams)
            await self.lease(self._lease_until_ns)
        except GuardError:
            await self.undo()
            raise
        finally:
            os.close(prepared.segment)

    # --- protection ---

    async def protect(self) -> tuple[str, ...]:
        """Have a keeper follow it, or the process that keeps its state; returns the keeper's notes.

        Raises:
            checkpoint.errors.UnsupportedError: with the reasons; the program was not touched.
            ProcessGoneError: a program that is not the guard's child has ended, so that its number may be another process's.
            ProbeError, KeeperLostError.
        """
        followed = self.engine, (self.task_pid or self.pid) if self.engine == COOPERATIVE else self.pid
        if self.keeper.is_there and self.keeper.followed not in (None, followed):
            await self.keeper.let_loose()
        if not self.keeper.is_there:
            await self.keeper.give()
        if self.keeper.followed == followed or self._awaits_commit:
            return ()
        with self._patience():
            notes = await self.keeper.follow(*followed, self.streams)
        if self.guest is not None and self.guest.has_ended:
            self._drop_keeper()
            raise ProcessGoneError(f"cannot protect pid {self.pid}: it has ended, and another process may have its number")
        return notes

    @contextlib.contextmanager
    def _patience(self) -> Iterator[None]:
        """A program that cannot be captured from outside may yet say that it keeps its state: numpy's threads exist before that.

        Raises:
            NothingCommittedError: instead of UnsupportedError, for a while.
        """
        try:
            yield
        except UnsupportedError as refusal:
            is_young = asyncio.get_running_loop().time() < self._impatient_at
            if self.engine_wanted != AUTO or not is_young:
                raise
            raise NothingCommittedError(f"{refusal}; it may yet say that it keeps its state") from refusal

    @contextlib.contextmanager
    def _let_go_if_it_fails(self, is_held: bool) -> Iterator[None]:
        """A keeper that was to leave the program standing may have done so before it failed: it lets go of it as it ends."""
        try:
            yield
        except BaseException:
            if is_held:
                self._drop_keeper()
            raise

    @property
    def _awaits_commit(self) -> bool:
        """Whether there is nothing to follow yet."""
        return self.engine == COOPERATIVE and not self.keeps

    async def capture(
        self, *, base: bool, generation: int, sequence: int, epoch: int, hold: bool = False, lag_ns: int = 0
    ) -> Captured | keeper_messages.Unchanged:
        """Take a snapshot; a base if the keeper has no acknowledged position to start from.

        Args:
            hold: leave the program standing still afterwards, until `thaw` or `stop`.
            lag_ns: see `failover.core.acts.Capture`.

        Returns:
            `Unchanged` only where a delta of a program that is not to be held would say nothing new.

        Raises:
            checkpoint.errors.NothingCommittedError: there is nothing to capture yet; `committed` is called when there is.
            CaptureError, UnsupportedError, ProcessGoneError, ProbeError; KeeperLostError. The program runs on.
        """
        await self.protect()
        is_held_by_guard = hold and self.engine == COOPERATIVE
        if self._awaits_commit:
            what = "it has committed nothing yet" if self.task_pid else "it has not said yet that it keeps a state"
            raise NothingCommittedError(f"cannot capture {self.name}: {what}")
        share = self.keeper.share()
        async with self._standing_still(is_held_by_guard):
            with self._let_go_if_it_fails(hold and not is_held_by_guard), self._patience(), self.keeper.lending() as spare:
                order = keeper_messages.Capture(
                    base, generation, sequence, epoch, hold, share, lag_ns, if_changed=True, spare=bool(spare)
                )
                captured, descriptors = await self.keeper.ask(order, spare)
        if isinstance(captured, keeper_messages.Unchanged):
            return captured
        self.keeper.note(captured)
        (snapshot,) = descriptors or spare
        self._held = hold and not is_held_by_guard
        self._commits[captured.position] = captured.commit
        self._totals[captured.position] = captured.totals
        while len(self._totals) > TOTALS_LIMIT:
            del self._totals[next(iter(self._totals))]
        while len(self._commits) > TOTALS_LIMIT:
            del self._commits[next(iter(self._commits))]
        return Captured(
            captured.position,
            captured.parent,
            snapshot,
            captured.size,
            captured.freeze_us,
            captured.dirty_bytes,
            captured.notes,
            captured.commit,
            captured.age_ns,
            captured.known_bytes,
            captured.frozen_bytes,
            captured.slack,
            captured.cpu_us,
        )

    async def acknowledge(self, position: Position, *, is_safe: bool = True) -> None:
        """The snapshot of ``position`` is a checkpoint: deltas start there, and the output up to there is committed.

        Args:
            is_safe: a standby holds it; a program that waits for its commit is told; else, that this robot has it.
        """
        totals = self._totals.pop(position, None)
        if totals is not None:
            self.logs.commit(totals, is_safe=is_safe)
        self.limit_output(self.engine == PTRACE or not is_safe)
        self.keeper.tell(keeper_messages.Acknowledge(position))
        if (commit := self._commits.pop(position, 0)) and (is_safe or self._hears_kept):
            self._guard.tell(messages.CommitSafe(commit) if is_safe else messages.CommitKept(commit))

    def limit_output(self, limited: bool) -> None:
        """Bound how much of held output may wait, or do not.

        A program that keeps its state makes no checkpoint while it waits in a write: it is bounded only while no robot stands by,
        for then its checkpoints would not help.
        """
        if self._guard.open and self.logs.is_held and limited != self._output_limited:
            self._output_limited = limited
            self._guard.tell(messages.LimitOutput(HOLD_LIMIT if limited else 0))

    @contextlib.asynccontextmanager
    async def _standing_still(self, wanted: bool) -> AsyncIterator[None]:
        """Have the guard hold the program, as the keeper of another engine would; let it go on if the body fails."""
        if not wanted or (await self.describe()).frozen_by:
            yield
            return
        await self.freeze()
        try:
            yield
        except BaseException:
            await self.thaw()
            raise

    # --- holding still ---

    async def lease(self, until_ns: int) -> None:
        """Let it run until CLOCK_BOOTTIME passes ``until_ns``; renew in time. 0 for ever. Thaws a program that a lease froze."""
        self._lease_until_ns = until_ns
        if self.prepared is None:  # else it is given with the start
            await self.ask_guard(messages.Lease(until_ns))

    async def freeze(self, *, exposed: bool = False) -> None:
        """Hold the program still; it is when this returns. Held ``exposed`` it can be captured all the same."""
        await self.ask_guard(messages.Freeze(exposed))

    async def thaw(self) -> None:
        """Let it go on. Raises GuardError while its lease is over."""
        if self._held:
            self._drop_keeper()  # lets go of the program held by its last capture; the next capture has a new one
        await self.ask_guard(messages.Thaw())

    async def describe(self) -> Standing:
        """How it stands now."""
        described, streams = await self.ask_guard(messages.Describe())
        close_all(streams)
        return Standing(
            described.state,
            described.pid,
            described.inner_pid,
            described.isolated,
            described.frozen_by,
            described.freezes_by,
            described.exit_status,
            described.totals,
            described.lease_until_ns,
            (*described.notes, *((described.blocked,) if described.blocked else ())),
        )

    # --- the end ---

    async def stop(self, number: int = signal.SIGTERM, patience_s: float = 10.0) -> int | None:
        """End the program: the signal, and SIGKILL if it still lives after ``patience_s``; returns its wait status.

        Raises:
            GuardLostError: its guard is gone, and the program with it.
        """
        if self.ended.done():
            return self.ended.result()
        await self.ask_guard(messages.Kill(number))
        if number != signal.SIGKILL:
            with contextlib.suppress(TimeoutError):
                return await asyncio.wait_for(asyncio.shield(self.ended), patience_s)
            await self.ask_guard(messages.Kill(signal.SIGKILL))
        return await asyncio.shield(self.ended)

    async def release(self) -> None:
        """End protection; the program runs on, its guard keeps its streams until it ends."""
        with contextlib.suppress(CheckpointError, KeeperLostError):
            await self.keeper.let_loose()
        self._forget_guest()  # its guard may be gone as soon as it has answered
        await self.ask_guard(messages.LetGo())
        self.close()

    async def forget(self) -> None:
        """The exit status has been noted: the guard ends, its socket goes. The logs stay."""
        self._drop_keeper()
        with contextlib.suppress(GuardLostError):
            await self.ask_guard(messages.Forget())
        self.close()

    def close(self) -> None:
        """Let go of guard, keeper and logs without changing anything for the program, as a stopping agent does."""
        self._drop_keeper()
        self._guard.close()
        if self.prepared is not None:
            os.close(self.prepared.segment)
            self.prepared = None
        self._take_streams(())
        self._forget_guest()
        self.logs.close()

    # --- guard and keeper ---

    def take(self, born: Started | VesselReady | Described, streams: tuple[int, ...]) -> None:
        """Note the guard's facts about it."""
        self.pid, self.inner_pid, self.isolated, self.notes = born.pid, born.inner_pid, born.isolated, born.notes
        self._take_streams(streams)
        self.limit_output(self.engine == PTRACE)
        if isinstance(born, Described):
            self.engine_wanted, self.task_pid, self.keeps = born.engine, born.task_pid, born.keeps
            self._hears_kept = born.hears_kept

    def _take_streams(self, streams: tuple[int, ...]) -> None:
        """These are its streams' descriptors from now on; those before are closed."""
        before, self.streams = self.streams, streams
        close_all(before)

    async def ask_guard(self, request: Any, descriptors: tuple[int, ...] = ()) -> Any:
        """The guard's reply, and descriptors that are ours now.

        Raises:
            GuardError: it refuses, with its sentence; GuardLostError.
        """
        reply, streams = await self._guard.ask(request, descriptors)
        if isinstance(reply, Refused):
            raise GuardError(f"{self.name}: {reply.message}")
        return reply, streams

    async def undo(self) -> None:
        """Before the commit: kill all processes of the unfinished component. They have ended when this returns."""
        self._drop_keeper()
        with contextlib.suppress(GuardError):
            if self.pid:
                await self.stop(signal.SIGKILL)
            await self.forget()
        self.close()

    def _drop_keeper(self) -> None:
        self._held = False
        self.keeper.drop()

    def _heard(self, message: Any) -> bool:
        """Events of the guard."""
        if isinstance(message, Exited):
            self.last_words = message.notes
            if not self.ended.done():
                self.ended.set_result(message.status)
            return True
        if isinstance(message, TaskConnected | TaskKeeps):
            self.task_pid, self.keeps = message.pid, isinstance(message, TaskKeeps)
            if self.keeps:
                self.committed()
            if message.pid:
                self.connected.set()
            return True
        return isinstance(message, messages.FrozenByLease)

    def _guard_lost(self) -> None:
        if self.guest is not None:
            self.guest.end(self.name)
        if not self.ended.done():
            self.ended.set_exception(GuardLostError(f"the guard of {self.name} ended, and its program with it"))
            self.ended.exception()  # noted: after a release no task waits for the end

    def _forget_guest(self) -> None:
        if self.guest is not None:
            self.guest.close()
            self.guest = None
