"""The worker process as the main loop sees it: started, sent messages without ever waiting, collected when dead and replaced."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Final

from agent.config import Settings
from agent.errors import AgentError
from agent.main_loop import messages
from agent.main_loop.messages import Inventory, ToMainLoop, ToWorker
from checkpoint.keeper.messages import Channel, ChannelError, pair
from failover.core import acts, events
from failover.core.acts import Act
from failover.core.events import Event

WAITING_LIMIT: Final = 4_096
"""Messages that wait for a worker which does not read; beyond it, it is hung and is replaced."""

MESSAGES_A_TURN: Final = 64
"""Taken from the worker in one turn of the main loop."""

END_PATIENCE_S: Final = 5.0

LOST: Final = "the agent's worker process restarted in the middle of it"

log = logging.getLogger("failover.heart")

vars(subprocess)["_USE_VFORK"] = False
"""Of the whole main loop, which would stand still until the child, at ordinary priority, has had a processor.

Source: the documentation of subprocess.
"""


class WorkerProcess:
    """One child process after another, and what the core still expects of it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._child: subprocess.Popen[bytes] | None = None
        self._awaited: SimpleQueue[socket.socket | None] = SimpleQueue()
        self._wanted = self._begun = 0
        self._is_doomed = False
        self._successor = threading.Thread(target=self._succeed, name="successor", daemon=True)
        self._successor.start()  # now: later the main loop would wait for the birth of a thread at ordinary priority
        self._channel: Channel[ToMainLoop] | None = None
        self._waiting: deque[ToWorker] = deque()
        self._expected: dict[tuple[str, str], Act] = {}
        self._admitted: dict[str, acts.Admit] = {}
        self._warm: dict[str, acts.Warm] = {}
        self._ready = False
        self._early: deque[Act] = deque(maxlen=WAITING_LIMIT)

    @property
    def pid(self) -> int:
        """Of the process, or of the one before it as long as no other could be started."""
        assert self._child is not None, "start comes first"
        return self._child.pid

    def start(self) -> None:
        """Start the process; it begins by sending its inventory.

        Raises:
            AgentError: it cannot be started.
        """
        self._child = self._born(self._opened())

    def replace(self) -> None:
        """End the process, if it still is there, and start another one: in a thread, for either may take a busy machine long.

        One that cannot be started is told by `receive`, as one that ended at once.
        """
        self._wanted += 1
        self._awaited.put(self._opened())

    def _opened(self) -> socket.socket:
        """Begin a new channel; the other end of it, for a new process."""
        if self._channel is not None:
            self._channel.close()
        ours, theirs = pair()
        ours.setblocking(False)
        self._channel = Channel(ours, ToMainLoop)
        self._waiting.clear()
        self._ready = False
        return theirs

    def _succeed(self) -> None:
        """The thread's life: whenever another process is wanted, let the one before come to its end, and start it."""
        while (theirs := self._awaited.get()) is not None:
            self._kill()
            if self._child is not None:
                self._child.wait()
            try:
                self._child = self._born(theirs)
            except AgentError as error:
                log.error("%s", error)
            self._begun += 1
            if self._is_doomed:
                self._is_doomed = False
                self._kill()

    def _born(self, theirs: socket.socket) -> subprocess.Popen[bytes]:
        """A new process; our copy of its end of the channel is closed.

        Raises:
            AgentError: it cannot be started.
        """
        module = "agent.worker.witness" if self._settings.me.role == "witness" else "agent.worker.process"
        command = [sys.executable, "-P", "-m", "agent.system.child_main", module, str(self._settings.path), str(theirs.fileno())]
        try:
            return subprocess.Popen(
                command,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                process_group=0,  # a Ctrl-C at the terminal is the main loop's to act on
            )
        except OSError as error:
            raise AgentError(
                f"cannot start the worker process: {error.strerror}; is memory or the process limit used up?"
            ) from error
        finally:
            theirs.close()

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        assert self._channel is not None, "start comes first"
        return self._channel.fileno()

    def send(self, message: ToWorker) -> None:
        """Queue a message; it leaves in `flush`, as soon as the process reads."""
        if len(self._waiting) >= WAITING_LIMIT:
            log.error("the worker process does not read; the main loop ends it")
            self._waiting.clear()
            if self._wanted > self._begun:
                self._is_doomed = True  # it will miss its messages
            else:
                self._kill()
        self._waiting.append(message)

    def order(self, act: Act) -> None:
        """Pass an act on, and remember it until it is answered.

        A process that has not sent its inventory cannot carry anything out yet. When the inventory comes, acts that await
        an answer count as lost, and all other acts are sent.
        """
        expected = isinstance(act, EXPECTED)
        if isinstance(act, acts.Admit):
            self._admitted[act.component] = act
        elif isinstance(act, acts.Warm):
            self._warm[act.component] = act
        elif isinstance(act, acts.Cool | acts.Start | acts.Restore | acts.Stop):
            self._warm.pop(act.component, None)
        if expected:
            self._expected[type(act).__name__, act.component] = act  # type: ignore[union-attr]
        if self._ready:
            self.send(messages.order(act))
        elif not expected and not isinstance(act, acts.Admit | acts.Warm):
            self._early.append(act)

    def ready(self) -> None:
        """The inventory has come: acts that were ordered in the meantime leave now."""
        self._ready = True
        lasting: tuple[Act, ...] = (*self._admitted.values(), *self._warm.values())
        for act in lasting:
            self.send(messages.order(act))
        while self._early:
            self.send(messages.order(self._early.popleft()))

    def flush(self) -> None:
        """Send waiting messages, as many as go without waiting."""
        assert self._channel is not None, "start comes first"
        while self._waiting:
            try:
                self._channel.send(self._waiting[0])
            except ChannelError:
                return  # full: the next turn; closed: `receive` says so
            self._waiting.popleft()

    def receive(self) -> Iterator[ToMainLoop]:
        """The messages that have come, without waiting.

        Raises:
            ChannelError: it has gone, or sent nonsense.
        """
        assert self._channel is not None, "start comes first"
        for _ in range(MESSAGES_A_TURN):
            try:
                message, _descriptors = self._channel.receive()
            except BlockingIOError:
                return
            yield message

    def answered(self, event: Event) -> None:
        """An event came: the acts that it answers are expected no longer."""
        for kind in ANSWERS.get(type(event), ()):
            self._expected.pop((kind, event.component), None)  # type: ignore[union-attr]

    def lost(self, inventory: Inventory) -> list[Event]:
        """After a restart: the events that the core must hear. Tell the new process again all that it must know."""
        self.ready()
        expected, self._expected = self._expected, {}
        told: list[Event] = []
        for act in expected.values():
            if isinstance(act, acts.Stop | acts.End):
                self.order(act)
            else:
                told.append(_failure(act))
        told += [events.Warmed(act.component, act.epoch, False) for act in self._warm.values()]  # they ended with it
        told += [events.Exited(found.component, found.epoch, found.status) for found in inventory.found if not found.running]
        return told

    def wait(self) -> None:
        """Let it end by itself, for a while; then make sure that it is gone."""
        self._awaited.put(None)
        self._successor.join()
        if self._child is None:
            return
        try:
            self._child.wait(END_PATIENCE_S)
        except subprocess.TimeoutExpired:
            log.warning("the worker process did not end in %.0f s; the main loop kills it", END_PATIENCE_S)
        self._kill()
        self._child.wait()
        if self._channel is not None:
            self._channel.close()
        self._channel = None

    def _kill(self) -> None:
        """End it, without waiting for that."""
        if self._child is not None and self._child.poll() is None:
            os.kill(self._child.pid, signal.SIGKILL)


EXPECTED: Final = (acts.Start, acts.Restore, acts.Capture, acts.Ship, acts.Stop, acts.End)
"""Acts that the core waits for."""

ANSWERS: Final[dict[type[Event], tuple[str, ...]]] = {
    events.Started: ("Start",),
    events.Restored: ("Restore",),
    events.ActFailed: ("Start", "Restore"),
    events.Captured: ("Capture",),
    events.Unchanged: ("Capture",),
    events.CaptureFailed: ("Capture",),
    events.ShipEnded: ("Ship",),
    events.Stopped: ("Stop", "Start", "Restore", "Capture", "End"),
    events.Exited: ("End", "Capture"),
}


def _failure(act: Act) -> Event:
    match act:
        case acts.Capture():
            return events.CaptureFailed(act.component, act.epoch, LOST, needs_base=True)
        case acts.Ship():
            return events.ShipEnded(act.component, act.epoch, act.position, act.to, False, LOST)
        case acts.Start() | acts.Restore():
            return events.ActFailed(act.component, act.epoch, LOST)
    raise AssertionError(f"{type(act).__name__} has no failure")
