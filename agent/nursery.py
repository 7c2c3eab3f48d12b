"""Guards and keepers are born here; one of each waits in advance: a takeover does not wait for an interpreter to start."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import socket
import subprocess
import sys
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
        self._spare_guard: asyncio.Task[GuardLink] | None = None
        self._spare_keeper: KeeperLink | None = None
        self._children: list[subprocess.Popen[bytes]] = []

    def prepare(self) -> None:
        """Have one of each wait."""
        if self._spare_guard is None:
            self._spare_guard = asyncio.create_task(self._guard_born())
        if self._spare_keeper is None or not self._spare_keeper.dialogue.open:
            self._spare_keeper = self._keeper_born()

    async def guard(self) -> GuardLink:
        """A guard that guards nothing yet.

        Raises:
            GuardError: it cannot be started.
        """
        spare, self._spare_guard = self._spare_guard, None
        link = await spare if spare is not None else await self._guard_born()
        if not link.dialogue.open:
            link = await self._guard_born()
        asyncio.get_running_loop().call_later(1.0, self.prepare)
        return link

    def keeper(self) -> KeeperLink:
        """A keeper that follows nothing yet.

        Raises:
            KeeperLostError: it cannot be started.
        """
        spare, self._spare_keeper = self._spare_keeper, None
        asyncio.get_running_loop().call_later(1.0, self.prepare)
        return spare if spare is not None and spare.dialogue.open else self._keeper_born()

    async def close(self) -> None:
        """End the ones that wait; they guard nothing. Those in use live on."""
        if self._spare_guard is not None:
            with contextlib.suppress(GuardError):
                (await self._spare_guard).dialogue.close()
        if self._spare_keeper is not None:
            self._spare_keeper.end()
        self._reap()

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
