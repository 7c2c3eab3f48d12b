"""A real guard process for a test, and an agent's end of the conversation with it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import psutil

from agent.guard.messages import Describe, Described, Event, Exited, FrozenByLease, Reply, Start, Started
from checkpoint.keeper.messages import Channel, ChannelClosedError, close_all
from checkpoint.linux.unix_address import address_of

PATIENCE_S: Final = 30.0
"""A generous bound for whatever is waited for; the machine may be busy."""

POLL_S: Final = 0.002
PYTHON: Final = "/usr/bin/python3"

T = TypeVar("T")


def until(condition: Callable[[], T], what: str) -> T:
    """The first true value of the condition."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {PATIENCE_S:.0f} s in vain for {what}"
        time.sleep(POLL_S)
    return value


class Agent:
    """One connection to a guard. Events that come between answers are kept in ``events``."""

    def __init__(self, path: Path) -> None:
        self.end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
        until(lambda: self._connected(path), f"a guard at {path}")
        self.end.settimeout(PATIENCE_S)
        self._channel: Channel[Any] = Channel(self.end, Reply | Event)
        self.events: list[Any] = []

    def _connected(self, path: Path) -> bool:
        try:
            with address_of(path) as address:
                self.end.connect(address)
        except (FileNotFoundError, ConnectionRefusedError):
            return False
        return True

    def ask(self, request: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> Any:
        """Its answer, past any events; the streams that come with it are closed."""
        self._channel.send(request, descriptors)
        while isinstance(answer := self._next(), Exited | FrozenByLease):
            self.events.append(answer)
        return answer

    def event(self, kind: type[T]) -> T:
        """The first event of this kind, heard already or still to come."""
        while True:
            for each in self.events:
                if isinstance(each, kind):
                    return each
            self.events.append(self._next())

    def describe(self) -> Described:
        """How the component stands."""
        described = self.ask(Describe())
        assert isinstance(described, Described), described
        return described

    def hung_up(self) -> bool:
        """Wait until the guard closes this connection."""
        try:
            while True:
                self._next()
        except ChannelClosedError:
            return True

    def close(self) -> None:
        self._channel.close()

    def _next(self) -> Any:
        message, descriptors = self._channel.receive()
        close_all(descriptors)
        return message


class GuardProcess:
    """``python -m agent.guard.server`` and what it keeps.

    Attributes:
        logs: directory of the streams.
    """

    def __init__(self, directory: Path, around: tuple[str, ...] = ()) -> None:
        """
        Args:
            around: a command that runs the guard, as its last words say, and ends it with itself.
        """
        self.directory = directory
        self.path = directory / "one.guard"
        self.logs = directory / "logs"
        command = [*around, sys.executable, "-m", "agent.guard.server", str(self.path)]
        self.process = subprocess.Popen(command, start_new_session=True)
        self._agents: list[Agent] = []

    def agent(self) -> Agent:
        """A new connection."""
        self._agents.append(Agent(self.path))
        return self._agents[-1]

    def start(self, agent: Agent, *argv: str, cgroup: str = "") -> Started:
        """Have it start a program, in ``directory``."""
        started = agent.ask(self.order(*argv, cgroup=cgroup))
        assert isinstance(started, Started), started
        return started

    def order(self, *argv: str, cgroup: str = "") -> Start:
        """What `start` asks."""
        return Start(
            component="/test/one",
            argv=tuple(map(os.fsencode, argv)),
            environment=(b"PATH=/usr/bin:/bin", b"LC_ALL=C"),
            working_directory=os.fsencode(self.directory),
            umask=0o022,
            isolate=False,
            log_directory=str(self.logs),
            cgroup=cgroup,
        )

    def output(self, name: str = "stdout") -> bytes:
        """What the program has written so far."""
        return (self.logs / f"{name}.log").read_bytes()

    def ended(self) -> int:
        """Wait until the guard has ended; its exit status."""
        return self.process.wait(PATIENCE_S)

    def end(self) -> None:
        """End guard and program, whatever state they are in."""
        for agent in self._agents:
            agent.close()
        self.process.kill()
        self.process.wait()


@contextmanager
def guarding(directory: Path, around: tuple[str, ...] = ()) -> Iterator[GuardProcess]:
    """A guard, ended at last."""
    guard = GuardProcess(directory, around)
    try:
        yield guard
    finally:
        guard.end()


def lives(pid: int) -> bool:
    """Whether a process is there, and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def children(word: str) -> list[psutil.Process]:
    """Our children that run and have this word in their command line; one that ended is none, reaped or not."""
    return [child for child in psutil.Process().children() if word in _command(child)]


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:  # also a zombie
        return []
