"""The worker process of a witness: it hands over the keys of heartbeats and answers users' requests, and nothing else.

Started as `python -m agent.system.child_main agent.worker.witness CONFIG DESCRIPTOR` in place of `agent.worker.process`.
There is no store, no pool of processes and no output log. Nothing that could read a snapshot or start a program is even imported.
It needs no right that an ordinary user does not have.

With ``sealed_size`` in its ``[store]`` it keeps sealed copies of checkpoints, which it cannot open
(`agent.worker.replication.sealed_copies`).
"""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from agent.config import Settings
from agent.errors import RefusedError
from agent.main_loop.messages import Inventory, Told, ToWorker
from agent.worker.control.queries import Questions
from agent.worker.control.status_view import WorkerView, team_view
from agent.worker.hub import Switchboard, live
from agent.worker.network.remote_orders import SEALED
from checkpoint.keeper.messages import Channel
from checkpoint.sentences import in_words
from failover.config.quantities import size_bytes
from failover.core import acts
from failover.core.wire.messages import Bulk, Cancel, Chunk, Content, Offer, Refuse
from failover.errors import ArchiveError

if TYPE_CHECKING:
    from agent.worker.replication.sealed_copies import SealedCopies
    from agent.worker.replication.transfer import Receiver

NO_COPIES: Final = (
    "{0} is a witness that keeps no sealed copies: set sealed_size in [store] of its agent.toml, and restart its agent"
)

NOT_FOUND: Final = "{0} cannot keep sealed copies in {1}: {2}; repair that folder, and restart its agent"

log = logging.getLogger("failover.lanes")


class Witness(Switchboard):
    """One life of the process."""

    def __init__(self, settings: Settings, main_loop: Channel[ToWorker]) -> None:
        super().__init__(settings, main_loop)
        self.connect(Questions(self, self.gate), {SEALED: self._asked_for_a_copy})
        self._sealed: SealedCopies | None = None
        self._no_copies = NO_COPIES.format(settings.config.robot)
        self._receiver: Receiver | None = None

    async def prepare(self) -> Inventory:
        """Nothing runs here; the core hears of no copy that could not be opened here."""
        if self.settings.config.store.sealed_size:
            await self._prepare_copies()
        return Inventory((), ())

    async def _prepare_copies(self) -> None:
        """Find the sealed copies. Where their folder is harmed, the witness says so, keeps none, and votes as before."""
        from agent.worker.replication import sealed_copies, transfer  # here: a witness that keeps none does not load them
        from failover.archive.signature import read_public

        config = self.settings.config
        directory = Path(config.state_directory) / sealed_copies.FOLDER
        size_max, team = size_bytes(config.store.sealed_size), Path(config.team_directory)
        sealed = sealed_copies.SealedCopies(directory, size_max, config.robot, lambda: read_public(team))
        try:
            await asyncio.to_thread(sealed.load)
        except (ArchiveError, OSError) as error:
            why = in_words(error) if isinstance(error, OSError) else str(error)
            self._no_copies = NOT_FOUND.format(config.robot, directory, why)
            self._own_troubles.append(self._no_copies)
            log.error("%s", self._no_copies)
            return
        self._receiver = transfer.Receiver(self._replication_link, directory, sealed)
        sealed.arriving, self._sealed = self._receiver.arriving, sealed

    async def _asked_for_a_copy(self, peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if self._sealed is None:
            raise RefusedError(self._no_copies)
        return await self._sealed.answer(peer, arguments)

    def link_is_new(self, peer: str) -> None:
        """What was half here stays half."""
        if self._sealed is not None and self._receiver is not None:
            self._receiver.lost(peer)
            self._sealed.lost(peer)

    def obeys(self, act: acts.Act) -> None:
        """Pass the core's answers on; it orders nothing else that would be carried out here."""
        if isinstance(act, acts.Answer):
            self.answered(act)
        else:
            log.debug("a witness does not do %s", type(act).__name__)

    def hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        """A witness is offered no snapshot; a sealed copy comes as a content."""
        match message:
            case Offer():
                self._replication_link.say(
                    peer, Refuse(message.transfer, f"{self.settings.config.robot} is a witness and keeps no snapshots")
                )
            case _ if self._receiver is None or self.votes_only(peer):
                return
            case Content():
                self._receiver.offered(peer, message)
            case Chunk():
                self._receiver.chunk(peer, message)
            case Cancel():
                self._receiver.cancelled(peer, message)

    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""
        ours = WorkerView(self._replication_link.links, self.notices(), self._links.shown(), sealed=self._copies_of)
        return team_view(self.settings, self._life, told, ours)

    def _copies_of(self, component: str) -> dict[str, Any] | None:
        """What the status shows of a component's sealed copies here."""
        if self._sealed is None:
            return None
        from checkpoint.store.index import folder_name

        found = self._sealed.of_component(folder_name(component))
        if found is None:
            return None
        copies, size, age_s = found
        return {"at": self.settings.config.robot, "age_s": age_s, "copies": copies, "size": size}


def main() -> int:
    """Be the other process of the witness's main loop that started us."""
    return live(Witness)
