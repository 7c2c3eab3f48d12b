"""The main loop's end of the process that speaks with etcd (``rule = "etcd"``): started, told, heard, never waited for."""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
import threading
from typing import Final

from agent.config import Settings
from agent.coordinator.messages import Begin, Ended, Know, ToCoordinator
from checkpoint.keeper.messages import Channel, ChannelError, pair
from failover.core.election.coordinator import Dialogue, Word
from failover.core.types import Config
from failover.core.wire.messages import Beat

PAUSE_NS: Final = 1_000_000_000
"""Before another process takes the place of one that ended: what ended it may last."""

UNBORN: Final = "the process that speaks with etcd has not answered yet"

log = logging.getLogger("failover.heart")


class CoordinatorLink:
    """One process after another, and what is said between it and the core.

    Attributes:
        trouble: why etcd has taken in nothing lately, for the status; "" where it has.
    """

    def __init__(self, settings: Settings, config: Config) -> None:
        self._settings, self._config = settings, config
        self._dialogue = Dialogue(config)
        self._is_busy = False
        self._ended_ns = 0
        self.trouble = UNBORN
        self._channel = self._begun()

    def fileno(self) -> int:
        """Readable when `receive` has something."""
        return self._channel.fileno()

    def _begun(self) -> Channel[Ended]:
        """A process that starts in a thread: its birth may take a busy machine long. What it is told waits for it."""
        ours, theirs = pair()
        ours.setblocking(False)
        self._is_busy, self._ended_ns = False, 0
        threading.Thread(target=self._bear, args=(theirs,), name="coordinator", daemon=True).start()
        channel: Channel[Ended] = Channel(ours, Ended)
        channel.send(Know(self._config))
        return channel

    def _bear(self, theirs: socket.socket) -> None:
        command = [sys.executable, "-P", "-m", "agent.coordinator.process", str(self._settings.path), str(theirs.fileno())]
        try:
            child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, process_group=0)
        except OSError as error:
            log.error("cannot start the process that speaks with etcd: %s", error.strerror)
            theirs.close()
            return
        theirs.close()
        child.wait()  # it ends when our end of the channel is closed

    def change(self, config: Config) -> None:
        """The team has changed."""
        self._config = config
        self._dialogue = self._dialogue.changed(config)
        self._send(Know(config))

    def next_ns(self) -> int | None:
        """When something is due here if nothing changes; None while an answer is awaited."""
        if self._ended_ns:
            return self._ended_ns + PAUSE_NS
        return None if self._is_busy else self._dialogue.next_ns()

    def look(self, word: Word, now_ns: int) -> None:
        """Begin a round with this word, if one is due; all of it is on the disk."""
        if not self._is_busy and not self._ended_ns and self._dialogue.is_due(word, now_ns):
            self._is_busy = True
            self._send(Begin(word))

    @property
    def wants_word(self) -> bool:
        """Whether a word is worth the making: no answer is awaited."""
        return not self._is_busy and not self._ended_ns

    @property
    def has_ended(self) -> bool:
        """Whether the process is gone, and no other one is there yet."""
        return self._ended_ns > 0

    def is_over(self, now_ns: int) -> bool:
        """Whether the process has ended long enough ago for another one."""
        return self._ended_ns > 0 and now_ns >= self._ended_ns + PAUSE_NS

    def replace(self) -> None:
        """Start another process."""
        self._channel.close()
        self._channel = self._begun()

    def receive(self, now_ns: int) -> Beat | None:
        """What etcd says now, as the core hears it; None where it says nothing."""
        try:
            ended, _ = self._channel.receive()
        except BlockingIOError:
            return None
        except ChannelError as error:
            self._fail(str(error), now_ns)
            return None
        self._is_busy = False
        if ended.trouble != self.trouble:
            log.log(logging.WARNING if ended.trouble else logging.INFO, "%s", ended.trouble or "etcd answers")
        self.trouble = ended.trouble
        return self._dialogue.beat(ended.said)

    def close(self) -> None:
        """Hang up: the process ends by itself."""
        self._channel.close()

    def _send(self, message: ToCoordinator) -> None:
        try:
            self._channel.send(message)
        except ChannelError as error:
            log.debug("the process that speaks with etcd: %s", error)  # it is full, or gone: `receive` says so

    def _fail(self, why: str, now_ns: int) -> None:
        self._ended_ns = now_ns
        self.trouble = f"the process that speaks with etcd has ended ({why}); another one starts"
        log.error("%s", self.trouble)
