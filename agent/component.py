"""One component on this robot: its guard, its keeper, its streams, as one thing to start, capture, freeze and restore.

All of it belongs to one asyncio loop (the lanes process). Everything here survives the agent: a restarted one finds the guards by
their sockets (`Component.reconnect`) and gives each component a new keeper, whose first capture is a base.

    component = await Component.start("/lab/robot1/mapper", program, places)
    await component.protect()
    captured = await component.capture(base=False, generation=1, sequence=7, epoch=3)   # send captured.snapshot to the standby …
    await component.acknowledge(captured.position)                                      # … and when it is stored there
    status = await component.ended                                                      # a wait status, then:
    await component.forget()

On the standby, when it takes over:

    component = await Component.restore(name, chain_descriptors, places, outage_ns=…)   # stopped, whole, uncommitted
    await component.resume()                                                            # it runs, protected already
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from agent import guard_messages
from agent.clock import Laps
from agent.errors import GuardError, GuardLostError, KeeperLostError
from agent.guard_messages import Described, Exited, Refused
from agent.nursery import GuardLink, KeeperLink, Nursery, connect
from agent.streams import OutputLogs, discard, total_of
from checkpoint import channel, errors, format
from checkpoint.channel import Failed, close_all
from checkpoint.errors import CheckpointError, RestoreError
from checkpoint.model import Position
from checkpoint.shelf import folder_name

TOTALS_LIMIT: Final = 64
"""Captures whose acknowledgement may still come; the core has one under way."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where the components of this robot keep their things.

    Attributes:
        sockets: directory of the guards' sockets; gone after a reboot, as the guards are.
        logs: directory with one directory of output a component.
        nursery: where guards and keepers come from.
        cgroup: a delegated cgroup v2 directory that each component gets a cgroup of its own in; "" for the guard's own.
        robot: this robot's name, for the snapshots.
    """

    sockets: Path
    logs: Path
    nursery: Nursery
    cgroup: str = ""
    robot: str = ""


@dataclass(frozen=True, slots=True)
class Program:
    """What to start, as execve(2) wants it."""

    argv: tuple[bytes, ...]
    environment: tuple[bytes, ...]
    working_directory: bytes
    umask: int = 0o022
    isolate: bool = True


@dataclass(frozen=True, slots=True)
class Captured:
    """One snapshot, fresh from the keeper.

    Attributes:
        parent: None for a base: also when a delta was asked of a keeper that has nothing to start from.
        snapshot: a sealed memfd with the encoded snapshot; the receiver closes it.
        size: bytes of it.
    """

    position: Position
    parent: Position | None
    snapshot: int
    size: int
    freeze_us: int
    dirty_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Standing:
    """How a component stands, for ``status``. ``notes`` are whole sentences: what is missing or degraded, and why."""

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
    """One program under protection. Made by `start`, `watch`, `restore` or `reconnect`; ended by `forget` or `release`.

    Attributes:
        name, pid, inner_pid, isolated: as the guard said.
        logs: its output; `OutputLogs.read` serves ``failover logs``.
        ended: the wait status once the program has ended (None: it was not our child); GuardLostError if the guard died first.
    """

    def __init__(self, name: str, guard: GuardLink, places: Places) -> None:
        self.name = name
        self.pid = self.inner_pid = 0
        self.isolated = False
        self.notes: tuple[str, ...] = ()
        self.logs = OutputLogs(log_directory(name, places))
        self.ended: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()
        self._places = places
        self._guard = guard
        self._keeper: KeeperLink | None = None
        self._streams: tuple[int, ...] = ()
        self._totals: dict[Position, tuple[int, int]] = {}
        self._held = False
        guard.dialogue.heard = self._heard
        guard.dialogue.ended = self._guard_lost

    # --- birth ---

    @classmethod
    async def start(cls, name: str, program: Program, places: Places) -> Component:
        """Start a guard and under it the program. It runs, and is not protected yet.

        Raises:
            GuardError: it could not be started; nothing is left of it.
        """
        guard = await places.nursery.guard()
        try:
            discard(log_directory(name, places))  # a namesake that was let go may still write to its own
        except OSError as error:
            guard.dialogue.close()
            raise GuardError(f"{name}: cannot begin its output anew in {error.filename}: {error.strerror}") from error
        component = cls(name, guard, places)
        request = guard_messages.Start(
            component=name,
            argv=program.argv,
            environment=program.environment,
            working_directory=program.working_directory,
            umask=program.umask,
            isolate=program.isolate,
            log_directory=str(log_directory(name, places)),
            cgroup=places.cgroup,
        )
        return await component._born(request)

    @classmethod
    async def watch(cls, name: str, pid: int, places: Places) -> Component:
        """Take a running process in: its guard is not its parent and does not own its streams.

        Raises:
            GuardError: there is no such process.
        """
        component = cls(name, await places.nursery.guard(), places)
        component.pid = component.inner_pid = pid
        return await component._born(guard_messages.Watch(name, pid))

    @classmethod
    async def restore(
        cls,
        name: str,
        chain: Sequence[int],
        places: Places,
        *,
        outage_ns: int,
        lease_until_ns: int = 0,
        laps: Laps | None = None,
    ) -> Component:
        """Rebuild a component from a chain (descriptors of encoded snapshots, oldest first), stopped, committed to nothing.

        Whatever fails, and whoever dies before `resume`: nothing of it is left.

        Args:
            laps: told how long each stage took.
            outage_ns: added to the program's monotonic and boot time: how long ago the newest snapshot was taken.

        Raises:
            checkpoint.errors.MismatchError, RestoreError, ChainError, FormatError; GuardError, KeeperLostError.
        """
        laps = laps or Laps()
        outline = await asyncio.to_thread(format.read_outline, chain[-1])
        await asyncio.to_thread(complete_logs, log_directory(name, places), chain)
        laps.lap("reading the newest")
        component = cls(name, await places.nursery.guard(), places)
        component._keeper = keeper = places.nursery.keeper()
        laps.lap("guard and keeper")
        request = guard_messages.MakeVessel(
            component=name,
            inner_pid=outline.process.pid,
            isolate=outline.process.isolated,
            clocks=outline.clocks,
            elapsed_ns=outage_ns,
            totals=total_of(outline.output),
            log_directory=str(log_directory(name, places)),
            cgroup=places.cgroup,
        )
        pidfd = os.pidfd_open(keeper.process.pid)
        try:
            await component._born(request, (pidfd,))
            laps.lap("vessel")
            order = channel.Restore(component.pid, name, outage_ns, streams=True, robot=places.robot)
            restored, _ = await component._ask_keeper(order, (*chain, *component._streams))
            laps.lap("restore")
            if lease_until_ns:
                await component.lease(lease_until_ns)
        except (CheckpointError, GuardError, KeeperLostError):
            await component._undo()
            raise
        finally:
            os.close(pidfd)
        component.notes = (*component.notes, *restored.notes)
        return component

    @classmethod
    async def reconnect(cls, socket_path: Path, places: Places) -> Component:
        """Find a component again after the agent was restarted.

        Raises:
            GuardLostError: nobody listens there any more; the left-over socket has been removed.
        """
        try:
            guard = connect(socket_path)
        except OSError as error:
            with contextlib.suppress(FileNotFoundError):
                socket_path.unlink()
            raise GuardLostError(f"the guard of {socket_path.name} has gone: {error.strerror}") from error
        guard.dialogue.heard = lambda message: isinstance(message, guard_messages.Event)  # the end is told by the answer, too
        described, streams = await guard.dialogue.ask(guard_messages.Describe())
        if described.state == "none":
            guard.dialogue.close()
            raise GuardLostError(f"the guard of {socket_path.name} guards nothing; it ends")
        component = cls(described.component, guard, places)
        component._take(described, streams)
        if described.state == "ended" and not component.ended.done():
            component.ended.set_result(described.exit_status)
        return component

    async def resume(self) -> None:
        """After `restore`: commit to it and let it go on.

        Raises:
            RestoreError, GuardError, KeeperLostError: it did not get that far; nothing of it is left.
        """
        try:
            await self._ask_guard(guard_messages.Commit())
            resumed, _ = await self._ask_keeper(channel.Resume())
        except (CheckpointError, GuardError, KeeperLostError):
            await self._undo()
            raise
        self.notes = (*self.notes, *resumed.notes)
        if any(note.startswith(channel.UNPROTECTED) for note in resumed.notes):
            self._drop_keeper()  # the next capture tries with a new one

    # --- protection ---

    async def protect(self) -> tuple[str, ...]:
        """Give it a keeper, if it has none; returns the keeper's notes.

        Raises:
            checkpoint.errors.UnsupportedError: with the reasons; the program was not touched.
            ProbeError, KeeperLostError.
        """
        if self._keeper is not None and self._keeper.dialogue.open:
            return ()
        self._keeper = self._places.nursery.keeper()
        order = channel.Protect(self.pid, self.name, bool(self._streams), self._places.robot)
        try:
            protected, _ = await self._ask_keeper(order, self._streams)
        except (CheckpointError, KeeperLostError):
            self._drop_keeper()
            raise
        return tuple(protected.notes)

    async def capture(self, *, base: bool, generation: int, sequence: int, epoch: int, hold: bool = False) -> Captured:
        """Take a snapshot; a base if the keeper has no acknowledged position to start from.

        Args:
            hold: leave the program standing still afterwards, until `thaw` or `stop`.

        Raises:
            checkpoint.errors.CaptureError, UnsupportedError, ProcessGoneError, ProbeError; KeeperLostError. The program runs on.
        """
        await self.protect()
        order = channel.Capture(base, generation, sequence, epoch, hold)
        captured, (snapshot,) = await self._ask_keeper(order)
        self._held = hold
        self._totals[captured.position] = captured.totals
        while len(self._totals) > TOTALS_LIMIT:
            del self._totals[next(iter(self._totals))]
        return Captured(
            captured.position,
            captured.parent,
            snapshot,
            captured.size,
            captured.freeze_us,
            captured.dirty_bytes,
            captured.notes,
        )

    async def acknowledge(self, position: Position) -> None:
        """A standby holds the snapshot of ``position``: deltas start there, and the output up to there is committed."""
        totals = self._totals.pop(position, None)
        if totals is not None:
            self.logs.commit(totals)
        if self._keeper is not None and self._keeper.dialogue.open:
            self._keeper.dialogue.tell(channel.Acknowledge(position))

    # --- holding still ---

    async def lease(self, until_ns: int) -> None:
        """The program may run until CLOCK_MONOTONIC passes ``until_ns``; renew in time. 0 for ever. Thaws what a lease froze."""
        await self._ask_guard(guard_messages.Lease(until_ns))

    async def freeze(self, *, exposed: bool = False) -> None:
        """Hold the program still; it is when this returns. Held ``exposed`` it can be captured all the same."""
        await self._ask_guard(guard_messages.Freeze(exposed))

    async def thaw(self) -> None:
        """Let it go on. Raises GuardError while its lease is over."""
        if self._held:
            self._drop_keeper()  # lets go of what its last capture held; the next capture has a new one
        await self._ask_guard(guard_messages.Thaw())

    async def describe(self) -> Standing:
        """How it stands now."""
        described, streams = await self._ask_guard(guard_messages.Describe())
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
        await self._ask_guard(guard_messages.Kill(number))
        if number != signal.SIGKILL:
            with contextlib.suppress(TimeoutError):
                return await asyncio.wait_for(asyncio.shield(self.ended), patience_s)
            await self._ask_guard(guard_messages.Kill(signal.SIGKILL))
        return await asyncio.shield(self.ended)

    async def release(self) -> None:
        """End protection; the program runs on, its guard keeps its streams until it ends."""
        if self._keeper is not None and self._keeper.dialogue.open:
            with contextlib.suppress(CheckpointError, KeeperLostError):
                await self._ask_keeper(channel.Release())
        await self._ask_guard(guard_messages.LetGo())
        self.close()

    async def forget(self) -> None:
        """The exit status has been noted: the guard ends, its socket goes. The logs stay."""
        self._drop_keeper()
        with contextlib.suppress(GuardLostError):
            await self._ask_guard(guard_messages.Forget())
        self.close()

    def close(self) -> None:
        """Let go of guard and keeper without changing anything for the program: what a stopping agent does."""
        self._drop_keeper()
        self._guard.dialogue.close()
        close_all(self._streams)
        self._streams = ()

    # --- guard and keeper ---

    async def _born(self, request: Any, descriptors: tuple[int, ...] = ()) -> Component:
        try:
            born, streams = await self._ask_guard(request, descriptors)
        except GuardError:
            self._guard.dialogue.close()
            raise
        if isinstance(born, guard_messages.Watching):
            self.notes = born.notes
            return self
        self._take(born, streams)
        return self

    def _take(self, born: guard_messages.Started | guard_messages.VesselReady | Described, streams: tuple[int, ...]) -> None:
        self.pid, self.inner_pid, self.isolated, self.notes = born.pid, born.inner_pid, born.isolated, born.notes
        self._streams = streams

    async def _ask_guard(self, request: Any, descriptors: tuple[int, ...] = ()) -> Any:
        reply, streams = await self._guard.dialogue.ask(request, descriptors)
        if isinstance(reply, Refused):
            raise GuardError(f"{self.name}: {reply.message}")
        return reply, streams

    async def _ask_keeper(self, request: Any, descriptors: tuple[int, ...] = ()) -> Any:
        if self._keeper is None:
            raise KeeperLostError(f"{self.name} has no keeper; protect it first")
        reply, received = await self._keeper.dialogue.ask(request, descriptors)
        if isinstance(reply, Failed):
            raise _failure(reply)
        return reply, received

    async def _undo(self) -> None:
        """Before the commit: whatever was made of it is killed, and has ended when this returns."""
        self._drop_keeper()
        with contextlib.suppress(GuardError):
            if self.pid:
                await self.stop(signal.SIGKILL)
            await self.forget()
        self.close()

    def _drop_keeper(self) -> None:
        keeper, self._keeper = self._keeper, None
        self._held = False
        if keeper is not None:
            keeper.end()

    def _heard(self, message: Any) -> bool:
        """Events of the guard."""
        if isinstance(message, Exited):
            if not self.ended.done():
                self.ended.set_result(message.status)
            return True
        return isinstance(message, guard_messages.FrozenByLease)

    def _guard_lost(self) -> None:
        if not self.ended.done():
            self.ended.set_exception(GuardLostError(f"the guard of {self.name} ended, and its program with it"))
            self.ended.exception()  # noted: after a release nobody waits for the end


def _failure(failed: Failed) -> CheckpointError:
    """The keeper's error as its own class."""
    kind = getattr(errors, failed.error, RestoreError)
    if issubclass(kind, errors.UnsupportedError | errors.MismatchError):
        return kind(failed.message, failed.reasons)
    return kind(failed.message) if issubclass(kind, CheckpointError) else RestoreError(failed.message)


def complete_logs(directory: Path, chain: Sequence[int]) -> bool:
    """Bring output logs as far as the newest snapshot of a chain says; returns whether they were shorter.

    They are where a robot died, or was killed, between storing a snapshot and extending its logs.

    Args:
        chain: descriptors of encoded snapshots, oldest first.
    """
    logs = OutputLogs(directory)
    try:
        told = total_of(format.read_outline(chain[-1]).output)
        short = any(has < total for has, total in zip(logs.totals(), told, strict=True))
        if short:
            for descriptor in chain:
                logs.apply(format.read_outline(descriptor).output)
        return short
    finally:
        logs.close()


def guard_sockets(places: Places) -> tuple[Path, ...]:
    """The sockets of all guards that may still live, for `Component.reconnect` after a restart."""
    return tuple(sorted(places.sockets.glob("*.guard")))


def log_directory(name: str, places: Places) -> Path:
    """Where a component's output is kept on this robot."""
    return places.logs / folder_name(name)
