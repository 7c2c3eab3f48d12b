"""Starts guards and keepers in advance: a takeover does not wait for an interpreter to start.

One pair waits for each component that this robot may have to take over and of which it has no ready copy (a ready copy has its
own pair), up to `SPARES_MAX`. From the first component on, at least one pair waits. An agent without components has no waiting
pairs, and so spends no memory on them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
import socket
import struct
import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Final

from msgspec import Struct

import checkpoint
from agent.errors import GuardError, GuardLostError, KeeperLostError
from agent.guard import messages
from agent.system.systemd_units import Kind, in_a_unit
from agent.worker.components.connection import Dialogue
from checkpoint.keeper import messages as keeper_messages
from checkpoint.linux.unix_address import address_of

BIRTH_S: Final = 20.0
"""How long a guard may take until it listens; a tenth of a second is usual."""

POLL_S: Final = 0.005
_PEER: Final = struct.Struct("3i")

SPARES_MAX: Final = 8
"""Pairs that wait at most; each holds about 60 MB. A takeover of more components waits for interpreters to start."""

REFILL_S: Final = 1.0
"""How long after one was used its successor is started: a takeover has the processor for itself."""

KEEPER: Final = (checkpoint.__name__, "keeper")
"""Its module and verb."""

GATES: Final = "agent.slack_gate"
"""The module by which a keeper captures a program between two activations of its tasks."""

log = logging.getLogger("failover.component")


class KeeperLink(Struct):
    """A keeper, and our conversation with it."""

    dialogue: Dialogue
    pid: int

    def pidfd(self) -> int:
        """A descriptor of its process, the caller's to close.

        Raises:
            KeeperLostError: it has ended.
        """
        try:
            return os.pidfd_open(self.pid)
        except ProcessLookupError as error:
            raise KeeperLostError("the keeper ended before it was asked anything") from error

    def end(self) -> None:
        """Hang up: it lets go of the component that it follows, and ends."""
        self.dialogue.close()


class ProcessPool:
    """Starts guards and keepers. Lives in one loop."""

    def __init__(self, sockets: Path, starter: str) -> None:
        """
        Args:
            starter: of services of their own, see `agent.system.systemd_units`; "": they are our children.
        """
        self._sockets = sockets
        self._starter = starter
        self._expected = self._least = 0
        self._relieved: set[str] = set()
        self._guards: deque[asyncio.Task[Dialogue]] = deque()
        self._keepers: deque[asyncio.Task[KeeperLink]] = deque()
        self._children: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def begin(self) -> None:
        """There is a component: have a pair born, both at the same time: a worker that takes a guard asks for a keeper next."""
        if not self._least:
            self._least = 1
            self._prepare_if_possible()

    def expect(self, components: int) -> None:
        """This robot may have to take over so many components."""
        self._expected = components
        self._prepare_if_possible()

    def relieve(self, component: str, is_ready: bool) -> None:
        """A component has a guard and a keeper already, by which it would be taken over, or has them no more."""
        if is_ready:
            self._relieved.add(component)
        elif component in self._relieved:
            self._relieved.discard(component)
            self._refill()

    @property
    def _wanted(self) -> int:
        return max(self._least, min(self._expected - len(self._relieved), SPARES_MAX))

    def prepare(self) -> None:
        """Have as many wait as are wanted."""
        self._keepers = deque(born for born in self._keepers if not _lost(born))
        while len(self._guards) < self._wanted:
            self._guards.append(asyncio.create_task(self._guard_born()))
        while len(self._keepers) < self._wanted:
            self._keepers.append(asyncio.create_task(self._keeper_waits()))

    async def guard(self) -> Dialogue:
        """A guard that guards nothing yet.

        Raises:
            GuardError: it cannot be started.
        """
        self.begin()
        self._refill()
        while self._guards:
            with contextlib.suppress(GuardError):
                guard = await self._guards.popleft()
                if guard.open:
                    return guard
        return await self._guard_born()

    async def keeper(self) -> KeeperLink:
        """A keeper that follows nothing yet.

        Raises:
            KeeperLostError: it cannot be started.
        """
        self.begin()
        self._refill()
        while self._keepers:
            with contextlib.suppress(KeeperLostError):
                link = await self._keepers.popleft()
                link.dialogue.ended = lambda: None
                if link.dialogue.open:
                    return link
        return await self._keeper_born()

    async def onlooker(self) -> KeeperLink:
        """A keeper for a question, besides those that wait for a takeover; the asker's to end.

        Raises:
            KeeperLostError: it cannot be started.
        """
        return await self._keeper_born()

    async def close(self) -> None:
        """End the ones that wait; they guard nothing. Those in use live on."""
        self._closed = True
        for guard in self._guards:
            with contextlib.suppress(GuardError):
                (await guard).close()
        for keeper in self._keepers:
            with contextlib.suppress(KeeperLostError):
                (await keeper).end()
        self._reap()

    def _refill(self) -> None:
        asyncio.get_running_loop().call_later(REFILL_S, self._prepare_if_possible)

    def _prepare_if_possible(self) -> None:
        """Spare processes only wait: they must not fail a machine without memory or processes left."""
        if self._closed:
            return
        try:
            self.prepare()
        except (GuardError, KeeperLostError) as error:
            log.warning("the agent has no spare guard and keeper, so a takeover will take longer: %s", error)

    async def _guard_born(self) -> Dialogue:
        name = _new_name()
        path = self._sockets / f"{name}.guard"
        child = self._spawn("guard", name, ["agent.guard.server", str(path)])
        return _guard_at(path, await self._connected(path, child, "a guard"))

    async def _keeper_waits(self) -> KeeperLink:
        """A keeper whose end, while nothing needs it, is noticed."""
        link = await self._keeper_born()
        link.dialogue.ended = self._refill
        return link

    async def _keeper_born(self) -> KeeperLink:
        try:
            end, pid = await self._keeper_called() if self._starter else self._keeper_forked()
        except GuardError as error:
            raise KeeperLostError(str(error)) from error
        dialogue = Dialogue(end, keeper_messages.Reply, KeeperLostError, "the keeper")
        dialogue.watch(pid)
        return KeeperLink(dialogue, pid)

    async def _keeper_called(self) -> tuple[socket.socket, int]:
        """One that systemd started: it listens as a guard does."""
        name = _new_name()
        path = self._sockets / f"{name}.keeper"
        child = self._spawn("keeper", name, [*KEEPER, str(path), GATES])
        end = await self._connected(path, child, "a keeper")
        return end, _peer_of(end)

    def _keeper_forked(self) -> tuple[socket.socket, int]:
        ours, theirs = keeper_messages.pair()
        with theirs:
            try:
                child = self._spawn("keeper", "", [*KEEPER, str(theirs.fileno()), GATES], (theirs.fileno(),))
            except GuardError:
                ours.close()
                raise
        return ours, child.pid

    async def _connected(self, path: Path, child: subprocess.Popen[bytes], what: str) -> socket.socket:
        """Wait until a process listens at a path.

        Raises:
            GuardError: it has ended, or takes longer than `BIRTH_S`.
        """
        waited = 0.0
        while waited < BIRTH_S:
            with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
                return _call(path)
            status = child.poll()
            if status is not None and (status or not self._starter):  # systemd-run ends well as soon as it has been started
                raise GuardError(f"{what} ended at once, status {status}; its last words stand in the agent's log")
            await asyncio.sleep(POLL_S)
            waited += POLL_S
        child.kill()
        raise GuardError(f"{what} did not listen within {BIRTH_S:.0f} s; is the machine out of memory?")

    def _spawn(self, kind: Kind, name: str, module: list[str], descriptors: tuple[int, ...] = ()) -> subprocess.Popen[bytes]:
        self._reap()
        way = in_a_unit(self._starter, kind, name) if self._starter else []
        try:
            child = subprocess.Popen(
                [*way, sys.executable, "-P", "-m", *module],
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise GuardError(f"cannot start a {kind}: {error.strerror}; is memory or the process limit used up?") from error
        self._children.append(child)
        return child

    def _reap(self) -> None:
        """Collect the processes that have ended."""
        self._children = [child for child in self._children if child.poll() is None]


def connect(path: Path) -> Dialogue:
    """Speak to the guard that listens at a path.

    Raises:
        FileNotFoundError, ConnectionRefusedError: none does (yet, or any more).
    """
    return _guard_at(path, _call(path))


def _guard_at(path: Path, end: socket.socket) -> Dialogue:
    incoming = messages.Reply | messages.Event
    dialogue = Dialogue(end, incoming, GuardLostError, f"the guard at {path.name}")
    dialogue.watch(_peer_of(end))
    return dialogue


def _peer_of(end: socket.socket) -> int:
    """The process that listens at the other end."""
    pid, _, _ = _PEER.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
    return int(pid)


def _call(path: Path) -> socket.socket:
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        with address_of(path) as address:
            end.connect(address)
    except OSError:
        end.close()
        raise
    return end


def _new_name() -> str:
    """Of a guard or keeper: one that none of an earlier agent's has."""
    return secrets.token_hex(4)


def _lost(born: asyncio.Task[KeeperLink]) -> bool:
    """Whether a keeper that was to wait has not come, or has gone."""
    return born.done() and (born.cancelled() or born.exception() is not None or not born.result().dialogue.open)
