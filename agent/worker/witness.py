"""The worker process of a witness: it hands over the keys of heartbeats and answers users' requests, and nothing else.

Started as `python -m agent.system.child_main agent.worker.witness CONFIG DESCRIPTOR` in place of `agent.worker.process`.
There is no store, no pool of processes and no output log. Nothing that could read a snapshot or start a program is even imported.
It needs no right that an ordinary user does not have.
"""

from __future__ import annotations

import logging
from typing import Any

from agent.config import Settings
from agent.main_loop.messages import Inventory, Told, ToWorker
from agent.worker.control.queries import Questions
from agent.worker.control.status_view import WorkerView, team_view
from agent.worker.hub import Switchboard, live
from checkpoint.keeper.messages import Channel
from failover.core import acts
from failover.core.wire.messages import Bulk, Offer, Refuse

log = logging.getLogger("failover.lanes")


class Witness(Switchboard):
    """One life of the process."""

    def __init__(self, settings: Settings, main_loop: Channel[ToWorker]) -> None:
        super().__init__(settings, main_loop)
        self.connect(Questions(self, self.gate))

    async def prepare(self) -> Inventory:
        """Nothing is kept here and nothing runs here."""
        return Inventory((), ())

    def obeys(self, act: acts.Act) -> None:
        """Pass the core's answers on; it orders nothing else that would be carried out here."""
        if isinstance(act, acts.Answer):
            self.answered(act)
        else:
            log.debug("a witness does not do %s", type(act).__name__)

    def hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        """A witness is offered none."""
        if isinstance(message, Offer):
            self._replication_link.say(
                peer, Refuse(message.transfer, f"{self.settings.config.robot} is a witness and keeps no snapshots")
            )

    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""
        ours = WorkerView(self._replication_link.links, self.notices(), self._links.shown())
        return team_view(self.settings, self._life, told, ours)


def main() -> int:
    """Be the other process of the witness's main loop that started us."""
    return live(Witness)
