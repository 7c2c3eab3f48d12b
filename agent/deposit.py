"""What a standby does with what comes in: only from whom the core admitted, verified, stored, and only then told."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection

from agent.config import ComponentConfig
from agent.places import Places, complete_logs, log_directory
from agent.shipping import Refusal
from agent.streams import OutputLogs
from checkpoint import carried, foreign, format
from checkpoint.channel import close_all
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import ChainError, CheckpointError, FormatError, StoreError
from checkpoint.model import Snapshot
from checkpoint.store import Store
from failover.core.acts import Admit
from failover.core.events import Event, Stored, StoreFailed
from failover.core.messages import Offer
from failover.core.types import COMMITTED

log = logging.getLogger("failover.deposit")


class Deposit:
    """The desk (`agent.shipping.Desk`) at which peers hand in snapshots."""

    def __init__(
        self,
        store: Store,
        places: Places,
        tell: Callable[[Event], None],
        kept: Callable[[Offer, Snapshot], None],
        *,
        runs: bool = True,
        here: Callable[[str], ComponentConfig] = lambda _: ComponentConfig(),
    ) -> None:
        """
        Args:
            kept: called with what was offered, and that snapshot without its pages, for the status.
            runs: this member runs components: what it keeps it may have to lay down.
            here: what this robot's operator wants for a component.
        """
        self._runs = runs
        self._here = here
        self._store = store
        self._places = places
        self._tell = tell
        self._kept = kept
        self._admitted: dict[str, Admit] = {}
        self._senders: dict[str, str] = {}
        self._turns: dict[str, asyncio.Lock] = {}

    def admit(self, act: Admit) -> None:
        """From now on take this component's snapshots from this sender alone."""
        self._admitted[act.component] = act
        if act.sender:
            self._senders[act.component] = act.sender
        self._places.nursery.expect(sum(bool(known.sender) for known in self._admitted.values()))

    def last_sender(self, component: str) -> str:
        """From whom its snapshots come, or came until this robot claimed it; "" from nobody."""
        return self._senders.get(component, "")

    def admits(self, peer: str, offer: Offer) -> None:
        """Refuse what was not asked for, before a byte of it travels.

        Raises:
            Refusal: with the reason for the sender's status.
        """
        if hindrance := self.hindrance(offer.component, peer):
            raise Refusal(hindrance)
        admitted = self._admitted[offer.component]
        if offer.epoch < admitted.epoch:
            raise Refusal(f"epoch {offer.epoch} of {offer.component} is over; {admitted.epoch} has begun")

    def hindrance(self, component: str, peer: str) -> str:
        """Why nothing of a component is taken from a peer; "" if it is."""
        admitted = self._admitted.get(component)
        taken = admitted is not None and admitted.sender == peer
        return "" if taken else f"this robot does not take snapshots of {component} from {peer}"

    async def make_room(self, size: int) -> None:
        """Have room for a snapshot of so many bytes, if what is kept for people can give it."""
        try:
            await asyncio.to_thread(self._store.make_room, size)
        except StoreError as error:
            log.warning("%s", error)

    def not_taken(self, peer: str, offer: Offer, why: str) -> None:
        """The disk did not take what was admitted: the core hears of it, and status tells."""
        self._tell(StoreFailed(offer.component, offer.epoch, peer, why, needs_base=False))

    async def take(self, peer: str, offer: Offer, descriptor: int) -> None:
        """Verify, store durably, extend the output streams; then the core hears of it. One at a time for each component."""
        async with self._turns.setdefault(offer.component, asyncio.Lock()):
            try:
                self.admits(peer, offer)
                snapshot = await asyncio.to_thread(self._put, offer, descriptor)
            except Refusal as refusal:
                log.info("dropped a snapshot of %s from %s: %s", offer.component, peer, refusal)
                return
            except (CheckpointError, OSError) as error:
                log.warning("a snapshot of %s from %s was not kept: %s", offer.component, peer, error)
                needs_base = isinstance(error, ChainError)
                self._tell(StoreFailed(offer.component, offer.epoch, peer, str(error), needs_base))
                return
            except foreign.NOT_UNDERSTOOD as error:  # the sender is known, and still its word is its own
                why = foreign.sentence(f"keep a snapshot of {offer.component} from {peer}", error)
                log.warning("%s", why, exc_info=error)
                self._tell(StoreFailed(offer.component, offer.epoch, peer, why, needs_base=False))
                return
        self._kept(offer, snapshot)
        keeps_state = snapshot.engine == COOPERATIVE
        self._tell(Stored(offer.component, offer.epoch, snapshot.position, peer, offer.spec, keeps_state))

    async def settled(self, component: str) -> None:
        """Return once no snapshot of it is being stored: from then on a guard writes its output here.

        The core has ordered that nobody's are taken any more; what waits for its turn is refused.
        """
        async with self._turns.setdefault(component, asyncio.Lock()):
            pass

    def mend_logs(self, running: Collection[str]) -> None:
        """Bring each stream as far as the newest checkpoint says: an earlier life, or a power cut, may have come in between.

        Args:
            running: components whose program runs here; their guards write their logs, which are ahead of any checkpoint.
        """
        for name in self._store.components():
            if name not in running:
                self._mend_logs_of(name)

    def _mend_logs_of(self, name: str) -> None:
        descriptors = self._store.open_chain(name)
        try:
            if complete_logs(log_directory(name, self._places), descriptors):
                log.info("%s: its output was completed from its checkpoints", name)
        finally:
            close_all(tuple(descriptors))

    def _lack_of_room(self, component: str, descriptor: int) -> str:
        """Why the files that a snapshot carries will not fit here; "" if they will."""
        return carried.lack_of_room_for(format.read_outline(descriptor), self._here(component).carry_at)

    def _put(self, offer: Offer, descriptor: int) -> Snapshot:
        header = format.read_header(descriptor)
        told = (offer.component, offer.position, offer.parent, offer.epoch)
        if (header.component, header.position, header.parent, header.epoch) != told:
            raise FormatError(f"a snapshot of {offer.component} is not the one that was offered: it names {header.component}")
        if self._runs and offer.spec.launch.carry and (lack := self._lack_of_room(offer.component, descriptor)):
            raise StoreError(f"a checkpoint of {offer.component} is of no use here: {lack}")
        snapshot = self._store.put(descriptor)
        logs = OutputLogs(log_directory(offer.component, self._places))
        try:
            logs.hold(offer.spec.launch.output == COMMITTED)
            logs.apply(snapshot.output, is_safe=True)
        finally:
            logs.close()
        return snapshot
