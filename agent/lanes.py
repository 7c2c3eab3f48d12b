"""The lanes process: snapshots, programs and people; everything that may take its time.

Started as `python -m agent.lanes CONFIG DESCRIPTOR`. One asyncio loop at ordinary priority. The heart orders
(`agent.door`), this carries out and answers. If it dies, the heart starts another; guards and programs live on and are found
again by their sockets. If the heart dies, this ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal

from agent import births, door
from agent import config as configuration
from agent.charge import Charge
from agent.config import Settings
from agent.control import ControlServer
from agent.deposit import Deposit
from agent.dispatch import Dispatch
from agent.door import Alive, Ask, Farewell, HearKey, Inventory, Life, Order, SpeakKey, ToLanes, Told
from agent.errands import Errands
from agent.errors import AgentError, GuardLostError, LaneError
from agent.hooks import Hooks
from agent.journal import set_up_log
from agent.links import Facts, Links
from agent.nursery import Nursery
from agent.places import Places, guard_sockets
from agent.records import Records
from agent.rules import retention
from agent.shipping import Receiver, Shipper
from agent.surroundings import Surroundings
from agent.transport import Keys, LinkState, public_key_of
from agent.units import starter
from agent.verbs import Verbs
from agent.view import team_view
from agent.ways import BULK, Ways
from agent.wires import Wires
from checkpoint import format
from checkpoint.channel import Channel, ChannelClosedError, ChannelError, close_all
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import CheckpointError, StoreError
from checkpoint.model import Snapshot
from checkpoint.store import Store, open_store
from failover.client.control import SOCKET_NAME
from failover.core import acts, events
from failover.core.events import Event
from failover.core.messages import (
    VERSION,
    Bulk,
    Cancel,
    Chunk,
    Credit,
    Errand,
    ErrandDone,
    Goodbye,
    Hello,
    Offer,
    Refuse,
    Taken,
)
from failover.core.types import HISTORY_MAX, Found, Held
from failover.core.wire import KEY_SIZE_MIN

ALIVE_S: Final = 0.5
"""Between two signs of life to the heart."""

BYTES_A_MEGABIT: Final = 125_000
ANSWER_PATIENCE_S: Final = 60.0
"""How long an operator's command may take; a handover's own limit in the core is shorter."""

MESSAGES_A_TURN: Final = 64

STORE_TRIES: Final = 50
STORE_PAUSE_S: Final = 0.1
"""Between two tries to have the store: it is also what keeps two lives of an agent apart."""

log = logging.getLogger("failover.lanes")


class Lanes:
    """One life of the process."""

    def __init__(self, settings: Settings, heart: Channel[ToLanes]) -> None:
        self.settings = settings
        self.charges: dict[str, Charge] = {}
        config = settings.config
        state, runtime = Path(config.state_directory), Path(config.runtime_directory)
        self._runtime = runtime
        self._store_path = state / "store"
        sockets = runtime / "guards"
        self._starter = starter()
        self._nursery = Nursery(sockets, self._starter)
        self.places = Places(sockets, state / "logs", self._nursery, robot=config.robot)
        self._heart = heart
        self._outgoing: asyncio.Queue[door.ToHeart] = asyncio.Queue()
        self._numbers = itertools.count(1)
        self._questions: dict[int, asyncio.Future[Told]] = {}
        self._commands: dict[int, asyncio.Future[acts.Answer]] = {}
        self._life = Life(0, os.getppid(), ())
        self._begun: asyncio.Future[Life] = asyncio.get_running_loop().create_future()
        self._end: asyncio.Event = asyncio.Event()
        self._incompatible: dict[str, str] = {}
        self._own_troubles: list[str] = []
        keys = Keys("", "", {})
        if not config.insecure:
            publics = {name: robot.public_key for name, robot in settings.team.robots.items()}
            keys = Keys(public_key_of(settings.secret_key), settings.secret_key, publics)
            if keys.public != settings.me.public_key:
                self._own_troubles.append(UNFIT_KEY)
        facts = Facts(frozenset(config.wireless))
        self._links = Links(settings.me, facts, anywhere=config.snapshots_over == "any")
        self._wires = Wires(self._links, self._links_changed)
        self._ways = Ways(settings, keys, self._hear, self._way_changed, self._links)
        self._lane = self._ways.bulk
        self._shipper = Shipper(self._lane, config.link_mbit_s * BYTES_A_MEGABIT)
        self._verbs = Verbs(self)
        self.errands = Errands(self._ways.say, self.hindrance, self._verbs.errands())

    async def run(self) -> None:
        """From the heart's first word to its last.

        Raises:
            AgentError, CheckpointError: something needed to begin cannot be had.
        """
        loop = asyncio.get_running_loop()
        self._prepare_directories()
        loop.add_reader(self._heart.fileno(), self._listen_to_heart)
        speaking = asyncio.create_task(self._speak_to_heart())
        living = asyncio.create_task(self._show_life())
        self._life = await self._begun
        store = await self._open_store()
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
        self._say(Inventory(_held(store), found))
        self._wires.watch()
        self._ways.open()
        server = ControlServer(self._runtime / SOCKET_NAME, self.settings.config.group, self._verbs.table())
        await server.open()
        try:
            await self._end.wait()
        finally:
            loop.remove_reader(self._heart.fileno())
            await server.close()
            self._wires.close()
            await self.errands.close()
            await self._dispatch.close()
            await asyncio.gather(*(charge.close() for charge in self.charges.values()))
            await self._ways.close()
            await self._nursery.close()
            speaking.cancel()
            living.cancel()
            store.close()

    async def _open_store(self) -> Store:
        """Have the store to ourselves; an earlier life of the agent that still ends is waited for."""
        for _ in range(STORE_TRIES):
            try:
                return await asyncio.to_thread(open_store, self._store_path, None, retention(self.settings.config))
            except StoreError as error:
                trouble: StoreError = error
                await asyncio.sleep(STORE_PAUSE_S)
        raise trouble

    def _prepare_directories(self) -> None:
        for directory in (self._runtime, self.places.sockets, self.places.logs):
            try:
                directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            except OSError as error:
                raise AgentError(
                    f"cannot make {directory}: {error.strerror}; name directories that this user may write as state_directory "
                    "and runtime_directory"
                ) from error

    # --- the heart ---

    def tell(self, event: Event) -> None:
        """Pass an event to the core."""
        self._say(door.happened(event))

    async def ask(self, what: Literal["status", "why"]) -> Told:
        """Ask the heart for the core's view, or for what it has not written down yet."""
        number = next(self._numbers)
        answer: asyncio.Future[Told] = asyncio.get_running_loop().create_future()
        self._questions[number] = answer
        self._say(Ask(number, what))
        try:
            return await asyncio.wait_for(answer, ANSWER_PATIENCE_S)
        except TimeoutError:
            raise AgentError(f"the agent's heart did not answer for {ANSWER_PATIENCE_S:.0f} s; see its log") from None
        finally:
            self._questions.pop(number, None)

    async def command(self, make: Callable[[int], events.Command]) -> acts.Answer:
        """Have the core decide; its answer."""
        number = next(self._numbers)
        answer: asyncio.Future[acts.Answer] = asyncio.get_running_loop().create_future()
        self._commands[number] = answer
        self.tell(make(number))
        try:
            return await asyncio.wait_for(answer, ANSWER_PATIENCE_S)
        except TimeoutError:
            raise AgentError(f"no decision in {ANSWER_PATIENCE_S:.0f} s; failover why tells what it waits for") from None
        finally:
            self._commands.pop(number, None)

    def _say(self, message: door.ToHeart) -> None:
        self._outgoing.put_nowait(message)

    async def _show_life(self) -> None:
        while True:
            self._say(Alive())
            await asyncio.sleep(ALIVE_S)

    async def _speak_to_heart(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            message = await self._outgoing.get()
            while True:
                try:
                    self._heart.send(message)
                    break
                except ChannelClosedError:
                    self._end.set()
                    return
                except ChannelError:
                    writable = asyncio.Event()
                    loop.add_writer(self._heart.fileno(), writable.set)
                    await writable.wait()
                    loop.remove_writer(self._heart.fileno())

    def _listen_to_heart(self) -> None:
        try:
            for _ in range(MESSAGES_A_TURN):
                message, _descriptors = self._heart.receive()
                self._heed(message)
        except BlockingIOError:
            return
        except ChannelError:
            asyncio.get_running_loop().remove_reader(self._heart.fileno())
            self._end.set()

    def _heed(self, message: ToLanes) -> None:
        match message:
            case Order():
                self._obey(door.act_of(message))
            case Told():
                _resolve(self._questions, message.number, message)
            case Life():
                if not self._begun.done():
                    self._begun.set_result(message)
            case Farewell():
                self._end.set()

    def _obey(self, act: acts.Act) -> None:
        match act:
            case acts.Answer():
                _resolve(self._commands, act.request, act)
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

    # --- peers ---

    def _way_changed(self, way: int, peer: str, state: LinkState, reason: str) -> None:
        """A connection stands: introduce ourselves. It is gone: so is every transfer on it, and every word that took it."""
        lane = "bulk lane" if way == BULK else f"lane {way}"
        log.info("%s to %s: %s%s", lane, peer, state, f": {reason}" if reason else "")
        had_words = self._ways.carried_words(way, peer, state)
        if state is LinkState.CONNECTED:
            key = self._ways.beat_key(peer)
            self._greet(way, peer, key)
            self._say(SpeakKey(peer, key))
            return
        if way == BULK:
            self._shipper.lost(peer)
        if had_words:
            self.errands.lost(peer)

    async def _links_changed(self, sentences: list[str]) -> None:
        for sentence in sentences:
            log.info("%s", sentence)
            self.tell(events.Noticed("", sentence))
        try:
            await self._lane.hold_to_devices()
        except LaneError as error:
            log.critical("%s; the lanes begin anew", error)
            self._end.set()

    def hindrance(self, peer: str) -> str:
        """Why nothing can be said to a peer now; "" when it can."""
        return self._ways.hindrance(peer)

    def _hear(self, way: int, peer: str, message: Bulk) -> None:
        match message:
            case Hello():
                self._greeted(way, peer, message)
            case Goodbye(reason):
                self._ways.refuse(way, peer, reason)
            case _ if peer in self._incompatible:
                return
            case Errand():
                self.errands.received(peer, message)
            case ErrandDone():
                self.errands.done(peer, message)
            case _ if way == BULK:
                self._hear_of_a_snapshot(peer, message)

    def _hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        match message:
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

    def _greeted(self, way: int, peer: str, hello: Hello) -> None:
        reason = ""
        if hello.version != VERSION:
            reason = f"{peer} speaks version {hello.version}, this robot {VERSION}; install the same release on both"
        elif hello.team != self.settings.team.team:
            reason = f"{peer} belongs to team {hello.team!r}, this robot to {self.settings.team.team!r}"
        elif len(hello.beat_key) < KEY_SIZE_MIN:
            reason = f"{peer} sent a beat key of {len(hello.beat_key)} bytes; install the same release on both"
        if way == BULK and not hello.again:
            self._receiver.lost(peer)  # a new connection: what was half here stays half
        if reason:
            self._incompatible[peer] = reason
            self._ways.answer(way, peer, Goodbye(reason))
            log.warning("%s", reason)
            return
        self._incompatible.pop(peer, None)
        self._say(HearKey(peer, hello.beat_key))
        if self._ways.is_new_key(way, peer, hello.beat_key) and self._ways.present_key(peer):
            # Whoever lost its power ended no connection: ours to it seems to stand, and is refused at the first word.
            self._greet(way, peer, self._ways.present_key(peer), again=True)

    def _greet(self, way: int, peer: str, key: bytes, *, again: bool = False) -> None:
        config = self.settings.config
        self._ways.answer(way, peer, Hello(VERSION, self.settings.team.team, config.robot, self._life.boot, key, again))

    def _stored(self, component: str, snapshot: Snapshot, size: int) -> None:
        self.charge(component).figures.stored(snapshot.position, size, snapshot.engine)

    async def _silence_ns(self, component: str) -> int:
        """For how long the robot that sent this component's snapshots has been silent; 0 if there is none."""
        sender = self._deposit.sender(component)
        if not sender:
            return 0
        told = await self.ask("status")
        peers = told.status.peers if told.status else ()
        return max((peer.silent_ns for peer in peers if peer.robot == sender), default=0)

    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""
        notices = [
            *self._own_troubles,
            *self._incompatible.values(),
            *self._lane.troubles(),
            *self._ways.troubles,
            *self._links.notes(),
            *self._around.store.notices[-NOTICES_SHOWN:],
        ]
        return team_view(
            self.settings, self._life, told, self.charges, self._lane.links, notices, self._links.shown(), self._around.store
        )


UNFIT_KEY: Final = (
    "this robot's secret key does not belong to its public key in team.toml: no other robot lets it in; failover team enrol "
    "makes a fresh pair"
)

NOTICES_SHOWN: Final = 10
"""Of the store's latest findings."""


def _resolve(waiting: dict[int, asyncio.Future[Any]], number: int, answer: Any) -> None:
    future = waiting.pop(number, None)
    if future is not None and not future.done():
        future.set_result(answer)


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


async def _live(settings: Settings, descriptor: int) -> None:
    end = socket.socket(fileno=descriptor)
    end.setblocking(False)
    await Lanes(settings, Channel(end, ToLanes)).run()


def main() -> int:
    """Be the lanes of the heart that started us; its signals are its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    path, descriptor = Path(sys.argv[1]), int(sys.argv[2])
    try:
        settings = configuration.load(path)
        set_up_log(settings.config.log_level)
        with contextlib.suppress(asyncio.CancelledError):
            asyncio.run(_live(settings, descriptor))
    except (AgentError, CheckpointError, OSError) as error:
        log.critical("%s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
