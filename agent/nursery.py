"""Guards and keepers are born here, in advance: a takeover does not wait for an interpreter to start.

As many pairs wait as there are components that this robot may have to take over, up to `SPARES_MAX`, and always one.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import socket
import subprocess
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from agent import guard_messages
from agent.dialogue import Dialogue
from agent.errors import GuardError, GuardLostError, KeeperLostError
from checkpoint import channel

BIRTH_S: Final = 20.0
"""How long a guard may take until it listens; a tenth of a second is usual."""

POLL_S: Final = 0.005

SPARES_MAX: Final = 8
"""Pairs that wait at most; each holds about 60 MB. Whatever is taken over beyond that waits for interpreters to start."""

REFILL_S: Final = 1.0
"""How long after one was used its successor is started: a takeover has the processor for itself."""

log = logging.getLogger("failover.component")


@dataclass(slots=True)
class GuardLink:
    """A guard that listens, and our conversation with it."""

    dialogue: Dialogue
    socket_path: Path


@dataclass(slots=True)
class KeeperLink:
    """A keeper, and our conversation with it."""

    dialogue: Dialogue
    process: subprocess.Popen[bytes]

    def pidfd(self) -> int:
        """A descriptor of its process, the caller's to close.

        Raises:
            KeeperLostError: it has ended.
        """
        try:
            return os.pidfd_open(self.process.pid)
        except ProcessLookupError as error:
            raise KeeperLostError("the keeper ended before it was asked anything") from error

    def end(self) -> None:
        """Hang up: it lets go of what it follows, and ends."""
        self.dialogue.close()


class Nursery:
    """Starts guards and keepers. Lives in one loop."""

    def __init__(self, sockets: Path, launcher: tuple[str, ...]) -> None:
        """
        Args:
            launcher: put before every command line, see `agent.scope`.
        """
        self._sockets = sockets
        self._launcher = launcher
        self._numbers = itertools.count(1)
        self._wanted = 1
        self._guards: deque[asyncio.Task[GuardLink]] = deque()
        self._keepers: deque[KeeperLink] = deque()
        self._children: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def expect(self, components: int) -> None:
        """This robot may have to take over so many components."""
        self._wanted = max(1, min(components, SPARES_MAX))
        self._prepare_if_possible()

    def prepare(self) -> None:
        """Have as many wait as are wanted."""
        self._keepers = deque(keeper for keeper in self._keepers if keeper.dialogue.open)
        while len(self._guards) < self._wanted:
            self._guards.append(asyncio.create_task(self._guard_born()))
        while len(self._keepers) < self._wanted:
            keeper = self._keeper_born()
            keeper.dialogue.ended = self._refill
            self._keepers.append(keeper)

    async def guard(self) -> GuardLink:
        """A guard that guards nothing yet.

        Raises:
            GuardError: it cannot be started.
        """
        self._refill()
        while self._guards:
            with contextlib.suppress(GuardError):
                link = await self._guards.popleft()
                if link.dialogue.open:
                    return link
        return await self._guard_born()

    def keeper(self) -> KeeperLink:
        """A keeper that follows nothing yet.

        Raises:
            KeeperLostError: it cannot be started.
        """
        self._refill()
        while self._keepers:
            link = self._keepers.popleft()
            link.dialogue.ended = lambda: None
            if link.dialogue.open:
                return link
        return self._keeper_born()

    async def close(self) -> None:
        """End the ones that wait; they guard nothing. Those in use live on."""
        self._closed = True
        for born in self._guards:
            with contextlib.suppress(GuardError):
                (await born).dialogue.close()
        for keeper in self._keepers:
            keeper.end()
        self._reap()

    def _refill(self) -> None:
        asyncio.get_running_loop().call_later(REFILL_S, self._prepare_if_possible)

    def _prepare_if_possible(self) -> None:
        """A machine without memory or processes left is not made to fail by what only waits."""
        if self._closed:
            return
        try:
            self.prepare()
        except (GuardError, KeeperLostError) as error:
            log.warning("no guard and keeper wait in advance, a takeover will take longer: %s", error)

    async def _guard_born(self) -> GuardLink:
        path = self._sockets / f"{os.getpid()}-{next(self._numbers)}.guard"
        command = [*self._launcher, sys.executable, "-m", "agent.guard", str(path)]
        child = self._spawn(command)
        waited = 0.0
        while waited < BIRTH_S:
            with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
                return connect(path)
            if child.poll() is not None:
                raise GuardError(f"a guard ended at once, status {child.returncode}; what it said stands in the agent's log")
            await asyncio.sleep(POLL_S)
            waited += POLL_S
        child.kill()
        raise GuardError(f"a guard did not listen within {BIRTH_S:.0f} s; is the machine out of memory?")

    def _keeper_born(self) -> KeeperLink:
        ours, theirs = channel.pair()
        command = [*self._launcher, sys.executable, "-m", "checkpoint", "keeper", str(theirs.fileno())]
        try:
            child = self._spawn(command, (theirs.fileno(),))
        except GuardError as error:
            ours.close()
            raise KeeperLostError(str(error)) from error
        finally:
            theirs.close()
        return KeeperLink(Dialogue(ours, channel.Reply, KeeperLostError, "the keeper"), child)

    def _spawn(self, command: list[str], descriptors: tuple[int, ...] = ()) -> subprocess.Popen[bytes]:
        self._reap()
        try:
            child = subprocess.Popen(command, pass_fds=descriptors, stdin=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            raise GuardError(f"cannot start {command[-2]}: {error.strerror}; is memory or the process limit used up?") from error
        self._children.append(child)
        return child

    def _reap(self) -> None:
        """Collect what has ended."""
        self._children = [child for child in self._children if child.poll() is None]


def connect(path: Path) -> GuardLink:
    """Speak to the guard that listens at a path.

    Raises:
        FileNotFoundError, ConnectionRefusedError: nobody does (yet, or any more).
    """
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        end.connect(str(path))
    except OSError:
        end.close()
        raise
    incoming = guard_messages.Reply | guard_messages.Event
    return GuardLink(Dialogue(end, incoming, GuardLostError, f"the guard at {path.name}"), path)
