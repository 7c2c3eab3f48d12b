"""The lanes process: snapshots, programs and people; everything that may take its time.

Started as `python -m agent.lanes CONFIG DESCRIPTOR`. One asyncio loop at ordinary priority. The heart orders
(`agent.door`), this carries out and answers. If it dies, the heart starts another; guards and programs live on and are found
again by their sockets. If the heart dies, this ends.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from pathlib import Path
from typing import Any, Final

from agent import births
from agent.charge import Charge
from agent.config import Settings
from agent.deposit import Deposit
from agent.dispatch import Dispatch
from agent.door import Inventory, ToLanes, Told
from agent.errors import GuardLostError
from agent.hooks import Hooks
from agent.nursery import Nursery
from agent.places import Places, guard_sockets
from agent.records import Records
from agent.rules import retention
from agent.shipping import Receiver, Shipper
from agent.surroundings import Surroundings
from agent.switchboard import Switchboard, live, make_directory
from agent.units import starter
from agent.verbs import Verbs
from agent.view import team_view
from checkpoint import format
from checkpoint.channel import Channel, close_all
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import CheckpointError, StoreError
from checkpoint.model import Snapshot
from checkpoint.store import Store, open_store
from failover.core import acts
from failover.core.messages import (
    Bulk,
    Cancel,
    Chunk,
    Credit,
    Offer,
    Refuse,
    Taken,
)
from failover.core.types import HISTORY_MAX, Found, Held

BYTES_A_MEGABIT: Final = 125_000
STORE_TRIES: Final = 50
STORE_PAUSE_S: Final = 0.1
"""Between two tries to have the store: it is also what keeps two lives of an agent apart."""

log = logging.getLogger("failover.lanes")


class Lanes(Switchboard):
    """One life of the process."""

    def __init__(self, settings: Settings, heart: Channel[ToLanes]) -> None:
        super().__init__(settings, heart)
        self.charges: dict[str, Charge] = {}
        config = settings.config
        state, runtime = Path(config.state_directory), Path(config.runtime_directory)
        self._store_path = state / "store"
        sockets = runtime / "guards"
        self._starter = starter()
        self._nursery = Nursery(sockets, self._starter)
        self.places = Places(sockets, state / "logs", self._nursery, robot=config.robot)
        self._shipper = Shipper(self._lane, config.link_mbit_s * BYTES_A_MEGABIT)
        self.connect(Verbs(self))

    async def prepare(self) -> Inventory:
        """Open the store, find what outlived the last agent."""
        for directory in (self.places.sockets, self.places.logs):
            make_directory(directory)
        store = self._store = await self._open_store()
        records = Records(self._runtime / "running")
        hooks, here = Hooks(self._starter), self.settings.component
        self._deposit = Deposit(store, self.places, self.tell, self._stored)
        settled = self._deposit.settled
        self._around = Surroundings(self.places, store, records, self.tell, self._silence_ns, settled, here, hooks)
        self._dispatch = Dispatch(store, self._shipper, self.tell, self._links.hindrance)
        self._receiver = Receiver(self._lane, self._store_path, self._deposit)
        found = await self._find_guards(records)
        await self._mend_logs(found)
        self._nursery.prepare()
        return Inventory(_held(store), found)

    async def stop_work(self) -> None:
        """Give up what is under way; guards and programs live on."""
        await self._dispatch.close()
        await asyncio.gather(*(charge.close() for charge in self.charges.values()))

    async def close(self) -> None:
        """Let another life have the store."""
        await self._nursery.close()
        self._store.close()

    async def _open_store(self) -> Store:
        """Have the store to ourselves; an earlier life of the agent that still ends is waited for."""
        for _ in range(STORE_TRIES):
            try:
                return await asyncio.to_thread(open_store, self._store_path, None, retention(self.settings.config))
            except StoreError as error:
                trouble: StoreError = error
                await asyncio.sleep(STORE_PAUSE_S)
        raise trouble

    def obeys(self, act: acts.Act) -> None:
        """Carry an act of the core out."""
        match act:
            case acts.Answer():
                self.answered(act)
            case acts.Admit():
                self._deposit.admit(act)
            case acts.Ship():
                self._dispatch.ship(act)
            case acts.CancelShip():
                self._dispatch.cancel(act)
            case _:
                self.charge(act.component).order(act)

    def charge(self, name: str) -> Charge:
        """The component of that name, known or new."""
        if name not in self.charges:
            self.charges[name] = Charge(name, self._around)
            self.charges[name].begin()
        return self.charges[name]

    async def _find_guards(self, records: Records) -> tuple[Found, ...]:
        """Take the guards that outlived the last agent into charge."""
        found = []
        for path in guard_sockets(self.places):
            try:
                component = await births.reconnect(path, self.places)
                standing = await component.describe()
            except GuardLostError as error:
                log.info("%s", error)
                continue
            epoch = records.epoch(component.name)
            self.charge(component.name).adopt(component, epoch)
            running = standing.state in ("running", "frozen")
            found.append(Found(component.name, epoch, running, standing.exit_status or 0))
            log.info("%s: found again, pid %d, %s", component.name, component.pid, standing.state)
        return tuple(found)

    async def _mend_logs(self, found: tuple[Found, ...]) -> None:
        try:
            await asyncio.to_thread(self._deposit.mend_logs, {one.component for one in found})
        except (CheckpointError, OSError) as error:
            log.warning("the output of earlier checkpoints is not complete here: %s", error)

    def hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        """A word about a snapshot on the bulk lane."""
        match message:
            case Offer() if self.votes_only(peer):
                self._lane.say(peer, Refuse(message.transfer, f"{peer} is a witness: it votes, and keeps no snapshots"))
            case Offer() if hindrance := self._links.hindrance():
                self._lane.say(peer, Refuse(message.transfer, f"snapshots wait: at {self.settings.config.robot} {hindrance}"))
            case Offer():
                self._receiver.offered(peer, message)
            case Chunk():
                self._receiver.chunk(peer, message)
            case Cancel():
                self._receiver.cancelled(peer, message)
            case Credit() | Taken() | Refuse():
                self._shipper.heard(peer, message)

    def lane_lost(self, peer: str) -> None:
        """The bulk lane to a peer is gone, and every transfer on it."""
        self._shipper.lost(peer)

    def lane_is_new(self, peer: str) -> None:
        """A peer greets on a new bulk lane: what was half here stays half."""
        self._receiver.lost(peer)

    def _stored(self, component: str, snapshot: Snapshot, size: int) -> None:
        self.charge(component).figures.stored(snapshot.position, size, snapshot.engine)

    async def _silence_ns(self, component: str) -> int:
        """For how long the robot that last sent this component's snapshots has been silent; 0 if there is none."""
        sender = self._deposit.last_sender(component)
        if not sender:
            return 0
        told = await self.ask("status")
        peers = told.status.peers if told.status else ()
        return max((peer.silent_ns for peer in peers if peer.robot == sender), default=0)

    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""
        notices = [*self.notices(), *self._around.store.notices[-NOTICES_SHOWN:]]
        return team_view(
            self.settings, self._life, told, self.charges, self._lane.links, notices, self._links.shown(), self._around.store
        )


NOTICES_SHOWN: Final = 10
"""Of the store's latest findings."""


def _held(store: Store) -> tuple[Held, ...]:
    return tuple(Held(name, store.positions(name)[-HISTORY_MAX:], _keeps_state(store, name)) for name in store.components())


def _keeps_state(store: Store, name: str) -> bool:
    """Whether the newest snapshot is of a program that keeps its state; False also where it cannot be read now."""
    chain: list[int] = []
    try:
        chain = store.open_chain(name)
        return format.read_outline(chain[-1]).engine == COOPERATIVE
    except (CheckpointError, OSError) as error:
        log.warning("%s: its newest checkpoint cannot be read: %s", name, error)
        return False
    finally:
        close_all(tuple(chain))


def main() -> int:
    """Be the lanes of the heart that started us."""
    return live(Lanes)


if __name__ == "__main__":
    sys.exit(main())
