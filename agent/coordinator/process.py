"""The process that speaks with etcd: one round after the other, each begun by the main loop. Ends when the main loop does.

Started as `python -P -m agent.coordinator.process DESCRIPTOR`, with all modules of Python: TLS needs some that
`agent.system.child_main` leaves out. It keeps nothing on the disk: etcd has all that must not be forgotten.
"""

from __future__ import annotations

import socket
import sys
from typing import Final

from agent.coordinator.etcd import Etcd
from agent.coordinator.messages import Begin, Ended, Know, ToCoordinator
from agent.errors import CoordinatorError
from agent.system import clock
from checkpoint.keeper.messages import Channel, ChannelError
from failover.core.election.coordinator import Arbiter, Said, Word
from failover.errors import RulesError

PATIENCES_IN_LEASE: Final = 4
"""A step of a request may take so long a part of a lease: the next try is still in time."""

MS_A_SECOND: Final = 1_000


class Coordinator:
    """etcd, and how this robot has it vote."""

    def __init__(self) -> None:
        self._etcd: Etcd | None = None
        self._arbiter: Arbiter | None = None

    def heed(self, message: ToCoordinator) -> Ended | None:
        """Take a message in; the answer of a round."""
        match message:
            case Know(config, team, coordinator):
                if self._etcd is not None:
                    self._etcd.close()
                self._etcd = Etcd(coordinator, config.lease_ms / MS_A_SECOND / PATIENCES_IN_LEASE)
                self._arbiter = Arbiter(config, team)  # it watches anew: a new team may mean another majority
                return None
            case Begin(word):
                try:
                    return Ended(self._round(word))
                except (CoordinatorError, RulesError) as error:
                    return Ended(Said(0, 0), str(error))

    def _round(self, word: Word) -> Said:
        assert self._arbiter is not None and self._etcd is not None, "Know comes first"
        steps = self._arbiter.round(word)
        request = next(steps)
        while True:
            answer = self._etcd.answer(request)
            try:
                request = steps.send((answer, clock.now_ns()))
            except StopIteration as end:
                said: Said = end.value
                return said


def main() -> int:
    """Ask etcd until the main loop has gone."""
    channel: Channel[ToCoordinator] = Channel(socket.socket(fileno=int(sys.argv[1])), ToCoordinator)
    coordinator = Coordinator()
    while True:
        try:
            message, _ = channel.receive()
            answer = coordinator.heed(message)
            if answer is not None:
                channel.send(answer)
        except (ChannelError, KeyboardInterrupt):
            return 0


if __name__ == "__main__":
    sys.exit(main())
