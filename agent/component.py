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

    component = await Component.restore(name, chain_descriptors, places, options, until_ns)   # stopped, whole, uncommitted
    await component.resume()                                                                  # it runs, protected already
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.streams import OutputLogs
from checkpoint.model import Position
from checkpoint.shelf import folder_name


@dataclass(frozen=True, slots=True)
class Places:
    """Where the components of this robot keep their things.

    Attributes:
        sockets: directory of the guards' sockets; gone after a reboot, as the guards are.
        logs: directory with one directory of output a component.
        cgroup: a delegated cgroup v2 directory that each component gets a cgroup of its own in; "" for the guard's own.
        launcher: put before a guard's and keeper's command line, to move them out of the agent's own cgroup; for systemd
            ``("systemd-run", "--scope", …)``.
    """

    sockets: Path
    logs: Path
    cgroup: str = ""
    launcher: tuple[str, ...] = ()


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
        keeper_lost: set while there is no keeper; `protect`, or the next `capture`, makes another.
    """

    name: str
    pid: int
    inner_pid: int
    isolated: bool
    notes: tuple[str, ...]
    logs: OutputLogs
    ended: asyncio.Future[int | None]
    keeper_lost: asyncio.Event

    @classmethod
    async def start(cls, name: str, program: Program, places: Places) -> Component:
        """Start a guard and under it the program. It runs, and is not protected yet."""
        raise NotImplementedError

    @classmethod
    async def watch(cls, name: str, pid: int, places: Places) -> Component:
        """Take a running process in: its guard is not its parent and does not own its streams."""
        raise NotImplementedError

    @classmethod
    async def restore(
        cls, name: str, chain: Sequence[int], places: Places, *, outage_ns: int, lease_until_ns: int = 0
    ) -> Component:
        """Rebuild a component from a chain (descriptors of encoded snapshots, oldest first), stopped, committed to nothing.

        Whatever fails, and whoever dies before `resume`: nothing of it is left.

        Args:
            outage_ns: added to the program's monotonic and boot time: how long ago the newest snapshot was taken.

        Raises:
            checkpoint.errors.MismatchError, RestoreError, ChainError, FormatError; GuardError, KeeperLostError.
        """
        raise NotImplementedError

    @classmethod
    async def reconnect(cls, socket_path: Path, places: Places) -> Component:
        """Find a component again after the agent was restarted.

        Raises:
            GuardLostError: nobody listens there any more; the left-over socket has been removed.
        """
        raise NotImplementedError

    async def resume(self) -> None:
        """After `restore`: commit to it and let it go on."""
        raise NotImplementedError

    async def protect(self) -> tuple[str, ...]:
        """Give it a keeper, if it has none; returns the keeper's notes.

        Raises:
            checkpoint.errors.UnsupportedError: with the reasons; the program was not touched.
        """
        raise NotImplementedError

    async def capture(self, *, base: bool, generation: int, sequence: int, epoch: int) -> Captured:
        """Take a snapshot; a base if the keeper has no acknowledged position to start from.

        Raises:
            checkpoint.errors.CaptureError, UnsupportedError, ProcessGoneError, ProbeError; KeeperLostError. The program runs on.
        """
        raise NotImplementedError

    async def acknowledge(self, position: Position) -> None:
        """A standby holds the snapshot of ``position``: deltas start there, and the output up to there is committed."""
        raise NotImplementedError

    async def lease(self, until_ns: int) -> None:
        """The program may run until CLOCK_MONOTONIC passes ``until_ns``; renew in time. 0 for ever. Thaws what a lease froze."""
        raise NotImplementedError

    async def freeze(self) -> None:
        """Hold the program still; it is when this returns."""
        raise NotImplementedError

    async def thaw(self) -> None:
        """Let it go on. Raises GuardError while its lease is over."""
        raise NotImplementedError

    async def describe(self) -> Standing:
        """How it stands now."""
        raise NotImplementedError

    async def stop(self, signal: int = 15, patience_s: float = 10.0) -> int | None:
        """End the program: the signal, and SIGKILL if it still lives after ``patience_s``; returns its wait status."""
        raise NotImplementedError

    async def release(self) -> None:
        """End protection; the program runs on, its guard keeps its streams until it ends."""
        raise NotImplementedError

    async def forget(self) -> None:
        """The exit status has been noted: the guard ends, its socket goes. The logs stay."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of guard and keeper without changing anything for the program: what a stopping agent does."""
        raise NotImplementedError


def guard_sockets(places: Places) -> tuple[Path, ...]:
    """The sockets of all guards that may still live, for `Component.reconnect` after a restart."""
    return tuple(sorted(places.sockets.glob("*.guard")))


def log_directory(name: str, places: Places) -> Path:
    """Where a component's output is kept on this robot."""
    return places.logs / folder_name(name)
