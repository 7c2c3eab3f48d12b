"""One version's process, as its host sees it: started and confined, asked, and ended."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec import Struct

from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Envelope
from failover.core.programs.manifest import Manifest
from failover.drivers.declare import check_rate
from failover.errors import DriverError, ProgramError
from failover.kept_state.api import Resumed
from failover.programs.channel import (
    Begin,
    Call,
    Channel,
    ChannelClosedError,
    Confinement,
    Done,
    Failed,
    Hello,
    Message,
    Pause,
    Ready,
    Start,
    State,
)

LOAD_S: Final = 60.0
"""How long a program may import."""

BEGIN_S: Final = 10.0
"""How long it may take to begin with a state, or to let its device go."""

END_S: Final = 5.0


class Source(Struct, frozen=True):
    """Where a version comes from. ``digest``: "" for a directory of the host's own user."""

    manifest: Manifest
    directory: Path
    digest: str
    uid: int = 0

    @property
    def confinement(self) -> Confinement:
        """What its process may have."""
        said = self.manifest.permissions
        return Confinement(self.uid, not self.digest, said.network, said.devices, said.memory_mb)


class Answered(Struct, frozen=True):
    """What came of one message. ``state``: after it."""

    answer: Envelope
    state: State | None
    trouble: str = ""


class Running:
    """A version's process, warm or with a driver. Used by one thread at a time, but for `end`."""

    def __init__(self, source: Source, ended: Callable[[], None] = lambda: None) -> None:
        """Start its process; `load` comes next.

        Args:
            ended: called from another thread when the process has ended.

        Raises:
            ProgramError: the system gives no process.
        """
        self.source = source
        self.state: State | None = None
        self.notes: tuple[str, ...] = ()
        self._is_ended = False
        self._ended = ended
        try:
            self._start()
        except OSError as error:
            what = f"{source.manifest.name} {source.manifest.version}"
            raise ProgramError(f"{what} cannot be started: the system gives no process: {error.strerror}") from error

    def load(self) -> Running:
        """Wait until its imports are done.

        Raises:
            ProgramError: it cannot be loaded or confined, or `end` was called meanwhile; says why.
        """
        source = self.source
        try:
            file, name = source.manifest.entry_file, source.manifest.entry_class
            self._channel.send(Start(str(source.directory), file, name, source.confinement), LOAD_S)
            hello = self._next(LOAD_S)
            if not isinstance(hello, Hello):
                raise ChannelClosedError("its process said something else")
            if hello.path != source.manifest.path:
                raise ProgramError(f"it speaks for {hello.path}, and its manifest says {source.manifest.path}")
            _check_rates(hello)
            self.hello = hello
        except ProgramError as error:
            self.end()
            raise ProgramError(f"{source.manifest.name} {source.manifest.version} cannot be started: {error}") from error
        threading.Thread(target=self._wait, daemon=True, name=f"end of {self._process.pid}").start()
        return self

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        words = [sys.executable, "-P", "-m", "failover.programs.version_process", str(theirs.fileno())]
        environment = {
            key: value
            for key, value in os.environ.items()
            if key in ("PATH", "LANG", "LC_ALL", "TZ", "PYTHONPATH", "VIRTUAL_ENV")
        }
        root = str(Path(__file__).parents[2])
        places = environment.get("PYTHONPATH", "").split(os.pathsep)
        environment["PYTHONPATH"] = os.pathsep.join((root, *filter(None, places)))  # "" is the folder where the host was started
        with theirs, contextlib.ExitStack() as stack:
            stack.callback(ours.close)
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=2, pass_fds=(theirs.fileno(),), env=environment, start_new_session=True
            )
            stack.pop_all()
        self._channel = Channel(ours)

    @property
    def pid(self) -> int:
        """Of the process that was started."""
        return self._process.pid

    @property
    def lives(self) -> bool:
        """Whether its process has not ended."""
        return self._process.poll() is None

    def _wait(self) -> None:
        self._process.wait()
        self._ended()

    def _next(self, timeout_s: float) -> Message:
        found = self._channel.receive(timeout_s)
        if isinstance(found, Failed):
            raise ProgramError(found.sentence)
        return found

    def begin(self, state: State | None, resumed: Resumed) -> None:
        """Make its driver with this state; None: with its first one.

        Args:
            resumed: where the state comes from, for the driver's ``on_resume``.

        Raises:
            ProgramError: it cannot; says why.
        """
        self._channel.send(Begin(state, resumed), BEGIN_S)
        self._ready()

    def pause(self) -> None:
        """Have it let its device go; its last state is `state`.

        Raises:
            ProgramError: it did not.
        """
        self._channel.send(Pause(), BEGIN_S)
        self._ready()

    def _ready(self) -> None:
        found = self._next(BEGIN_S)
        if not isinstance(found, Ready):
            raise ChannelClosedError("its process said something else")
        self.state, self.notes = found.state, found.notes

    def call(self, message: Envelope) -> Answered:
        """Have one message carried out.

        Raises:
            ProgramError: its process ended, hangs, or said what is no answer.
        """
        timeout_s = self.source.manifest.health.answer_s
        self._channel.send(Call(envelopes.encode(message, "msgpack")), timeout_s)
        found = self._next(timeout_s)
        if not isinstance(found, Done):
            raise ChannelClosedError("its process said something else")
        answer = envelopes.decode(found.answer)
        state = found.state if found.state is not None else self.state
        return Answered(answer, state, found.trouble)

    def end(self) -> None:
        """End its process and those that it has started in its process group. May be called from any thread, and again."""
        self._channel.close()
        if self._is_ended:  # its number may be another's by now
            return
        self._is_ended = True
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)


def _check_rates(hello: Hello) -> None:
    """Raises ProgramError: the host cannot keep such a pace. The program's own process could tell anything."""
    streams = [one.rate_hz for one in hello.verbs.values() if one.role == "stream"]
    try:
        for rate_hz in (*streams, *(() if hello.rate_hz is None else (hello.rate_hz,))):
            check_rate(rate_hz)
    except DriverError as error:
        raise ProgramError(str(error)) from error
