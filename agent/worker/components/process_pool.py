"""Starts guards in advance, and has keepers forked: a takeover does not wait for an interpreter to start.

One guard waits for each component that this robot may have to take over and of which it has no ready copy (a ready copy has its
own), up to `SPARES_MAX`; from the first component on, at least one. From then on the process that forks keepers waits, too
(`checkpoint.keeper.fork_server`). An agent without components has none of these, and so spends no memory on them.
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

ANSWER_S: Final = 1.0
"""How long a guard that waits may take to answer; a tenth of a millisecond is usual. The next one is used then."""

_PEER: Final = struct.Struct("3i")

SPARES_MAX: Final = 8
"""Guards that wait at most. A takeover of more components waits for interpreters to start."""

REFILL_S: Final = 1.0
"""How long after one was used its successor is started: a takeover has the processor for itself."""

FORK_SERVER: Final = (checkpoint.__name__, "keepers")
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
        self._fork_server: asyncio.Task[Dialogue] | None = None
        self._children: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def begin(self) -> None:
        """There is a component: have a guard and the fork server born, both at the same time."""
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
        while len(self._guards) < self._wanted:
            self._guards.append(asyncio.create_task(self._guard_born()))
        if self._wanted:
            self._forking()

    async def guard(self) -> Dialogue:
        """A guard that guards nothing yet, and that answers.

        One that waited may have been killed together with the guard that it replaces, and its end not be seen yet. A restore
        that fails by it would count as one more crash of the program; after some, an older checkpoint is resumed.

        Raises:
            GuardError: it cannot be started.
        """
        self.begin()
        self._refill()
        while self._guards:
            with contextlib.suppress(GuardError):
                guard = await self._guards.popleft()
                if await _answers(guard):
                    return guard
        return await self._guard_born()

    async def keeper(self) -> KeeperLink:
        """A keeper that follows nothing yet.

        Raises:
            KeeperLostError: it cannot be started.
        """
        self.begin()
        try:
            return await self._keeper_forked()
        except KeeperLostError:  # the fork server may have been lost since it was last asked: another one is started
            return await self._keeper_forked()

    async def close(self) -> None:
        """End the ones that wait; they guard nothing. Those in use live on."""
        self._closed = True
        for guard in self._guards:
            with contextlib.suppress(GuardError):
                (await guard).close()
        if self._fork_server is not None:
            with contextlib.suppress(KeeperLostError):
                (await self._fork_server).close()
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

    def _forking(self) -> asyncio.Task[Dialogue]:
        """The fork server: the one that is there or comes, else another one."""
        if self._fork_server is None or _lost(self._fork_server):
            self._fork_server = asyncio.create_task(self._fork_server_born())
        return self._fork_server

    async def _fork_server_born(self) -> Dialogue:
        try:
            end, pid = await self._fork_server_called() if self._starter else self._fork_server_inheriting()
        except GuardError as error:
            raise KeeperLostError(str(error)) from error
        server = Dialogue(end, keeper_messages.Forked | keeper_messages.Failed, KeeperLostError, "the process that forks keepers")
        server.watch(pid)
        server.ended = self._refill
        return server

    async def _fork_server_called(self) -> tuple[socket.socket, int]:
        """One that systemd started: it listens as a guard does."""
        name = _new_name()
        path = self._sockets / f"{name}.keepers"
        child = self._spawn("keepers", name, [*FORK_SERVER, str(path), GATES])
        end = await self._connected(path, child, "the process that forks keepers")
        return end, _peer_of(end)

    def _fork_server_inheriting(self) -> tuple[socket.socket, int]:
        ours, theirs = keeper_messages.pair()
        with theirs:
            try:
                child = self._spawn("keepers", "", [*FORK_SERVER, str(theirs.fileno()), GATES], (theirs.fileno(),))
            except GuardError:
                ours.close()
                raise
        return ours, child.pid

    async def _keeper_forked(self) -> KeeperLink:
        server = await asyncio.shield(self._forking())
        ours, theirs = keeper_messages.pair()
        try:
            with theirs:
                forked, _ = await server.ask(keeper_messages.Fork(), (theirs.fileno(),))
            if isinstance(forked, keeper_messages.Failed):
                raise KeeperLostError(f"{forked.message}; is memory or the process limit used up?")
        except BaseException:
            ours.close()
            raise
        dialogue = Dialogue(ours, keeper_messages.Reply, KeeperLostError, "the keeper")
        dialogue.watch(forked.pid)
        return KeeperLink(dialogue, forked.pid)

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


async def _answers(guard: Dialogue) -> bool:
    """Whether a guard that waited does; one that does not, in time, is hung up on."""
    answered = False
    try:
        with contextlib.suppress(GuardError, TimeoutError):
            await asyncio.wait_for(guard.ask(messages.Describe()), ANSWER_S)
            answered = True
    finally:  # also where the asker is cancelled
        if not answered:
            guard.close()
    return answered


def _lost(born: asyncio.Task[Dialogue]) -> bool:
    """Whether the fork server has not come, or has gone."""
    return born.done() and (born.cancelled() or born.exception() is not None or not born.result().open)
