"""Receives snapshots at a standby: takes them only from senders that the core admitted, verifies, stores, then reports them."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

from msgspec import Struct

from agent.config import ComponentConfig
from agent.guard.output_logs import STREAMS, logs_of
from agent.system.threads import to_its_end
from agent.worker.components.paths import Places, complete_logs, log_directory
from agent.worker.replication.transfer import Refusal
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import ChainError, CheckpointError, FormatError, StoreError
from checkpoint.keeper.messages import close_all
from checkpoint.model import OutputPiece, Position, Snapshot
from checkpoint.sentences import in_words
from checkpoint.snapshot import carried_files, format, untrusted
from checkpoint.store.contract import SnapshotStore
from failover.core.acts import Accept, Admit, Discard, Show
from failover.core.events import Event, Stored, StoreFailed
from failover.core.types import COMMITTED
from failover.core.wire.messages import Offer

log = logging.getLogger("failover.deposit")

UNSHOWN_MAX: Final = 64
"""Accepted snapshots of a component whose output is remembered until readers may see it; older ones are read from their files."""


class Unshown(Struct, frozen=True):
    """The output of one accepted snapshot that readers do not see yet."""

    position: Position
    output: tuple[OutputPiece, ...]
    is_held: bool
    owner: int


class Shown(Struct, frozen=True):
    """The output logs of a component as this worker has brought them to a position; no other process writes them meanwhile.

    Attributes:
        ends: of each stream that the position's snapshot tells of.
    """

    position: Position
    is_held: bool
    owner: int
    ends: dict[int, int]

    @classmethod
    def by(cls, one: Unshown) -> Shown:
        """As they are when the output of this snapshot is in them."""
        ends = {piece.stream: piece.offset + len(piece.content) for piece in one.output}
        return cls(one.position, one.is_held, one.owner, ends)

    def is_continued_by_nothing(self, one: Unshown) -> bool:
        """Whether nothing was written up to this snapshot."""
        if any(piece.content for piece in one.output) or one.position.generation != self.position.generation:
            return False
        after = Shown.by(one)
        return (after.is_held, after.owner, after.ends) == (self.is_held, self.owner, self.ends)


class Deposit:
    """The desk (`agent.worker.replication.transfer.Desk`) at which peers hand in snapshots."""

    def __init__(
        self,
        store: SnapshotStore,
        places: Places,
        tell: Callable[[Event], None],
        kept: Callable[[Offer, Snapshot], None],
        *,
        runs: bool = True,
        here: Callable[[str], ComponentConfig] = lambda _: ComponentConfig(),
    ) -> None:
        """
        Args:
            kept: called with the offer, and that snapshot without its pages, once the core has accepted it.
            runs: this member runs components: it may have to lay down the files that it keeps.
            here: the settings that this robot's operator gives a component.
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
        self._stored: dict[tuple[str, Position], tuple[Offer, Snapshot]] = {}
        self._unshown: dict[str, deque[Unshown]] = {}
        self._shown: dict[str, Shown] = {}

    def admit(self, act: Admit) -> None:
        """From now on take this component's snapshots from this sender alone."""
        self._admitted[act.component] = act
        if act.sender:
            self._senders[act.component] = act.sender
        self._places.process_pool.expect(sum(bool(known.sender) for known in self._admitted.values()))

    def last_sender(self, component: str) -> str:
        """From whom its snapshots come, or came until this robot claimed it; "" for none."""
        return self._senders.get(component, "")

    def admits(self, peer: str, offer: Offer) -> None:
        """Refuse a snapshot that was not asked for, before a byte of it travels.

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

    def make_room(self, size: int) -> None:
        """Have room for a snapshot of so many bytes, if the snapshots kept for people can give it."""
        try:
            self._store.make_room(size)
        except StoreError as error:
            log.warning("%s", error)

    def not_taken(self, peer: str, offer: Offer, why: str) -> None:
        """The disk did not take an admitted snapshot: the core hears of it, and status tells."""
        self._tell(StoreFailed(offer.component, offer.epoch, peer, why, needs_base=False))

    async def take(self, peer: str, offer: Offer, descriptor: int) -> None:
        """Verify, store durably; then the core hears of it, and decides. One at a time for each component."""
        async with self._turns.setdefault(offer.component, asyncio.Lock()):
            try:
                self.admits(peer, offer)
                snapshot = await to_its_end(self._put, offer, descriptor)
            except Refusal as refusal:
                log.info("dropped a snapshot of %s from %s: %s", offer.component, peer, refusal)
                return
            except (CheckpointError, OSError) as error:
                log.warning("a snapshot of %s from %s was not kept: %s", offer.component, peer, error)
                needs_base = isinstance(error, ChainError)
                self._tell(StoreFailed(offer.component, offer.epoch, peer, in_words(error), needs_base))
                return
            except untrusted.NOT_UNDERSTOOD as error:  # the sender is known, and still its word is its own
                why = untrusted.sentence(f"keep a snapshot of {offer.component} from {peer}", error)
                log.warning("%s", why, exc_info=error)
                self._tell(StoreFailed(offer.component, offer.epoch, peer, why, needs_base=False))
                return
        self._stored[offer.component, snapshot.position] = offer, snapshot
        keeps_state = snapshot.engine == COOPERATIVE
        told = offer.acknowledged
        self._tell(Stored(offer.component, offer.epoch, snapshot.position, peer, offer.spec, keeps_state, told))

    def accept(self, act: Accept) -> None:
        """It counts as held here: the ready copy and the status follow; its output waits for `show`."""
        offer, snapshot = self._stored.pop((act.component, act.position), (None, None))
        if offer is None or snapshot is None:  # an earlier worker stored it
            return
        unshown = self._unshown.setdefault(act.component, deque(maxlen=UNSHOWN_MAX))
        unshown.append(Unshown(snapshot.position, snapshot.output, offer.spec.launch.output == COMMITTED, offer.spec.owner))
        if snapshot.is_base:  # perhaps of another component, which has this name now
            self._shown.pop(act.component, None)
        self._kept(offer, snapshot)

    async def discard(self, act: Discard) -> None:
        """It came too late: neither is it shown, nor does this robot ever go on from it."""
        self._stored.pop((act.component, act.position), None)
        async with self._turns.setdefault(act.component, asyncio.Lock()):
            try:
                await asyncio.to_thread(self._store.discard, act.component, act.position)
            except StoreError as error:
                log.warning("%s", error)
        log.info("%s: snapshot %d came too late and is forgotten again", act.component, act.position.sequence)

    async def show(self, act: Show) -> None:
        """Extend the output streams that readers see up to an accepted position."""
        async with self._turns.setdefault(act.component, asyncio.Lock()):
            if self._has_shown_all(act.component, act.position):
                return
            try:
                await asyncio.to_thread(self._show, act.component, act.position)
            except (CheckpointError, OSError) as error:
                log.warning("the output of %s up to snapshot %d cannot be shown: %s", act.component, act.position.sequence, error)

    def _due(self, component: str, position: Position) -> list[Unshown]:
        """Those that are to be shown up to a position."""
        unshown = tuple(self._unshown.setdefault(component, deque()))
        return [one for one in unshown if one.position.generation == position.generation and one.position <= position]

    def _forget_shown(self, component: str, position: Position) -> None:
        unshown = self._unshown[component]
        while unshown and unshown[0].position <= position:
            unshown.popleft()

    def _has_shown_all(self, component: str, position: Position) -> bool:
        """Whether the logs hold all up to a position already: the program has written nothing since the one before."""
        due, shown = self._due(component, position), self._shown.get(component)
        if shown is None or not due or due[-1].position != position or not all(map(shown.is_continued_by_nothing, due)):
            return False
        self._forget_shown(component, position)
        self._shown[component] = Shown.by(due[-1])
        return True

    def _show(self, component: str, position: Position, *, is_elsewhere: bool = True) -> None:
        """Have the logs hold all up to a position.

        Args:
            is_elsewhere: another robot is known to hold it, also where this one took it in.
        """
        shown = self._shown.pop(component, None)
        if shown is not None and shown.position == position and not is_elsewhere:
            return  # a takeover need not read the whole chain again
        directory, due = log_directory(component, self._places), self._due(component, position)
        if not due or due[-1].position != position:
            self._complete(component, directory, position, is_safe=is_elsewhere)
            return
        logs = logs_of(directory, due[-1].owner)
        try:
            sizes = dict(zip(STREAMS, logs.totals(), strict=True))
            is_gap = any(piece.offset > sizes[piece.stream] for piece in due[0].output)
            logs.hold(due[-1].is_held)
            for one in () if is_gap else due:
                logs.apply(one.output, is_safe=True)
        finally:
            logs.close()
        if is_gap:  # an earlier worker took in the snapshots before
            self._complete(component, directory, position, is_safe=True)
        self._shown[component] = Shown.by(due[-1])
        self._forget_shown(component, position)

    def _complete(self, component: str, directory: Path, position: Position, *, is_safe: bool) -> None:
        """An earlier worker took it in, or too many wait: read it from the files."""
        descriptors = self._store.open_chain(component, position)
        try:
            complete_logs(directory, descriptors, is_safe=is_safe)
        finally:
            close_all(tuple(descriptors))

    async def settled(self, component: str, position: Position | None = None) -> None:
        """Return once no snapshot of it is being stored: from then on a guard writes its output here.

        The core has ordered that snapshots are taken from no robot any more; a snapshot that waits for its turn is refused.

        Args:
            position: of the checkpoint to go on from here: its output is in the logs when this returns, shown before or not.
        """
        async with self._turns.setdefault(component, asyncio.Lock()):
            if position is not None:
                await asyncio.to_thread(self._show, component, position, is_elsewhere=False)
            self._shown.pop(component, None)

    def mend_logs(self, running: Collection[str]) -> None:
        """Bring each stream as far as the newest checkpoint says: an earlier life, or a power cut, may have come in between.

        Args:
            running: components whose program runs here; their guards write their logs, which are ahead of any checkpoint.
        """
        for name in self._store.components():
            if name not in running:
                self._mend_logs_of(name)

    def _mend_logs_of(self, name: str) -> None:
        """The chain before the newest snapshot was acknowledged; the core will say whether the newest one was (`show`)."""
        descriptors = self._store.open_chain(name)
        try:
            if len(descriptors) > 1 and complete_logs(log_directory(name, self._places), descriptors[:-1]):
                log.info("%s: its output was completed from its checkpoints", name)
        finally:
            close_all(tuple(descriptors))

    def _lack_of_room(self, component: str, descriptor: int) -> str:
        """Why the files that a snapshot carries will not fit here; "" if they will."""
        return carried_files.lack_of_room_for(format.read_outline(descriptor), self._here(component).carry_at)

    def _put(self, offer: Offer, descriptor: int) -> Snapshot:
        header = format.read_header(descriptor)
        told = (offer.component, offer.position, offer.parent, offer.epoch)
        if (header.component, header.position, header.parent, header.epoch) != told:
            raise FormatError(f"a snapshot of {offer.component} is not the one that was offered: it names {header.component}")
        if self._runs and offer.spec.launch.carry and (lack := self._lack_of_room(offer.component, descriptor)):
            raise StoreError(f"this robot cannot use a checkpoint of {offer.component}: {lack}")
        return self._store.put(descriptor)
