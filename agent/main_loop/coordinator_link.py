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

LEASES_A_ROUND: Final = 2
"""A round hangs that takes longer than so many, and one for each endpoint: a step of a request is given up after a quarter."""

BIRTH_NS: Final = 30_000_000_000
"""The first round includes the start of the process."""

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
        self._is_busy = self._is_born = False
        self._asked_ns = self._ended_ns = 0
        self._child: subprocess.Popen[bytes] | None = None
        self._channel: Channel[Ended] | None = None
        self.trouble = UNBORN

    def fileno(self) -> int:
        """Readable when `receive` has something; there is one after `start` until `stop`."""
        assert self._channel is not None
        return self._channel.fileno()

    def start(self, now_ns: int) -> bool:
        """Start a process in a thread: its birth may take a busy machine long, and what it is told waits for it.

        Returns:
            False where there is none, and `has_ended` for a while.
        """
        self.close()
        self._is_busy, self._is_born, self._ended_ns = False, False, 0
        try:
            ours, theirs = pair()
        except OSError as error:
            self._fail(f"cannot open a socket: {error.strerror}", now_ns)
            return False
        try:
            threading.Thread(target=self._bear, args=(theirs,), name="coordinator", daemon=True).start()
        except RuntimeError as error:
            ours.close()
            theirs.close()
            self._fail(str(error), now_ns)
            return False
        ours.setblocking(False)
        self._channel = Channel(ours, Ended)
        self._tell_team()
        return True

    def _bear(self, theirs: socket.socket) -> None:
        command = [sys.executable, "-P", "-m", "agent.coordinator.process", str(theirs.fileno())]
        try:
            child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, process_group=0)
        except OSError as error:
            log.error("cannot start the process that speaks with etcd: %s", error.strerror)
            theirs.close()
            return
        theirs.close()
        self._child = child
        child.wait()  # it ends when our end of the channel is closed, or `stop` kills it

    def change(self, config: Config) -> None:
        """The team has changed."""
        self._config = config
        self._dialogue = self._dialogue.changed(config)
        self._tell_team()

    def _tell_team(self) -> None:
        self._send(Know(self._config, self._settings.team.team, self._settings.config.coordinator))

    def next_ns(self) -> int:
        """When something is due here if nothing changes."""
        if self._ended_ns:
            return self._ended_ns + PAUSE_NS
        return self._given_up_ns if self._is_busy else self._dialogue.next_ns()

    @property
    def _given_up_ns(self) -> int:
        """When a round has taken too long: each endpoint may hang for a while; a busy machine starts a process slowly."""
        allowed_ns = (LEASES_A_ROUND + len(self._settings.config.coordinator.endpoints)) * self._config.lease_ns
        return self._asked_ns + max(allowed_ns, 0 if self._is_born else BIRTH_NS)

    def is_hung(self, now_ns: int) -> bool:
        """Whether a round takes too long: then `stop`."""
        return self._is_busy and not self._ended_ns and now_ns >= self._given_up_ns

    def stop(self, now_ns: int) -> None:
        """Kill a process that does not answer; another one takes its place."""
        self._fail(f"it was silent for {(now_ns - self._asked_ns) / 1e9:.0f} s", now_ns)
        if self._child is not None:
            self._child.kill()
            self._child = None

    def look(self, word: Word, now_ns: int) -> None:
        """Begin a round with this word, if one is due; all of it is on the disk."""
        if self.wants_word and self._dialogue.is_due(word, now_ns):
            self._is_busy, self._asked_ns = True, now_ns
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

    def receive(self, now_ns: int) -> Beat | None:
        """What etcd says now, as the core hears it; None where it says nothing."""
        assert self._channel is not None
        try:
            ended, _ = self._channel.receive()
        except BlockingIOError:
            return None
        except ChannelError as error:
            self._fail(str(error), now_ns)
            return None
        self._is_busy, self._is_born = False, True
        if ended.trouble != self.trouble:
            log.log(logging.WARNING if ended.trouble else logging.INFO, "%s", ended.trouble or "etcd answers")
        self.trouble = ended.trouble
        return self._dialogue.beat(ended.said)

    def close(self) -> None:
        """Hang up: the process ends by itself."""
        if self._channel is not None:
            self._channel.close()
        self._channel = None

    def _send(self, message: ToCoordinator) -> None:
        if self._channel is None:
            return
        try:
            self._channel.send(message)
        except (ChannelError, OSError) as error:  # OSError: no descriptor is left for a long one
            log.debug("the process that speaks with etcd: %s", error)  # it is full, or gone: `receive` or `is_hung` says so

    def _fail(self, why: str, now_ns: int) -> None:
        self._ended_ns = now_ns
        self.trouble = f"the process that speaks with etcd has ended ({why}); another one starts"
        log.error("%s", self.trouble)
