"""Links of the worker process to this robot's main loop and to the other robots. Each kind of worker builds on it.

`agent.worker.process` is a robot's or a server's, `agent.worker.witness` a witness's: that one imports this file and nothing
that could read a snapshot or start a program.
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
from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

from agent.config import Settings
from agent.errors import AgentError, LaneError
from agent.main_loop import messages
from agent.main_loop.messages import (
    Alive,
    Ask,
    Ends,
    Farewell,
    HearKey,
    IsRestart,
    Life,
    LinkNow,
    LinksAre,
    Order,
    SpeakKey,
    TeamIs,
    Told,
    ToWorker,
)
from agent.system import syscalls
from agent.system.crash import end_worker_on_mistake
from agent.system.log_setup import set_up_log
from agent.system.systemd_units import is_restarted, starter
from agent.worker import known_sites
from agent.worker.control.queries import QUESTIONS, Questions
from agent.worker.control.rights_gate import RightsGate
from agent.worker.control.server import ControlServer
from agent.worker.network.connections import BULK, AllConnections, keys_of
from agent.worker.network.link_monitor import Wires
from agent.worker.network.links import Facts, Link, Links, Medium
from agent.worker.network.remote_orders import ITEMS, RECOVERED, SEALED, Errands, OrderOfPeer
from agent.worker.network.replication_link import LinkState
from agent.worker.team_changes import TEAM_IS, TEAM_TOLD, TeamChanges, digest
from checkpoint.errors import CheckpointError
from checkpoint.keeper.messages import Channel, ChannelClosedError, ChannelError
from checkpoint.runtime import allocator
from failover.client.control import SOCKET_NAME
from failover.config.team import Team, sites_of
from failover.core import acts, events
from failover.core.events import Event
from failover.core.frames.frame import KEY_SIZE_MIN
from failover.core.wire.messages import VERSION, Belongings, Bulk, Content, Errand, ErrandDone, Goodbye, Hello, Offer, Refuse

ALIVE_S: Final = 0.5
"""Between two signs of life to the main loop."""

ANSWER_PATIENCE_S: Final = 60.0
"""How long an operator's command may take; a handover's own limit in the core is shorter."""

MESSAGES_A_TURN: Final = 64

SIGNS_MAX: Final = 256
"""Kinds of them that are remembered: each names a key, and a stranger can make many keys."""

SIGN_S: Final = 1.0
"""Between two signs of one kind from a peer that cannot be authenticated: ZeroMQ tries twenty times a second."""

UNFIT_KEY: Final = (
    "this robot's secret key does not belong to its public key in team.toml: no other robot accepts it; failover team enrol "
    "makes a fresh pair"
)

OTHER_SITE: Final = (
    "{} is a member of another site: orders and snapshots do not leave a site; give the order at a robot of this one"
)

OTHER_SITES: Final = (
    "{} and this robot know other sites of {}, or a release there knows none: bring the same release, and the team.toml that "
    "is right, to every member, and restart their agents; until then these two start, take over, move and protect nothing "
    "between them"
)

log = logging.getLogger("failover.lanes")


class Switchboard:
    """One life of the process, as far as it talks.

    Attributes:
        verbs: what people may ask of it.
        gate: who may.
    """

    verbs: Questions

    def __init__(self, settings: Settings, main_loop: Channel[ToWorker]) -> None:
        self.settings = settings
        config = settings.config
        self._runtime = Path(config.runtime_directory)
        self.gate = RightsGate(Path(config.team_directory), Path(config.state_directory), starter())
        self._main_loop = main_loop
        self._outgoing: asyncio.Queue[messages.ToMainLoop] = asyncio.Queue()
        self._numbers = itertools.count(1)
        self._questions: dict[int, asyncio.Future[Told]] = {}
        self._commands: dict[int, asyncio.Future[acts.Answer]] = {}
        self._early: list[Event] | None = []
        self._life = Life(0, os.getppid(), ())
        self._begun: asyncio.Future[Life] = asyncio.get_running_loop().create_future()
        self._end: asyncio.Event = asyncio.Event()
        self._incompatible: dict[str, str] = {}
        self._own_troubles: list[str] = []
        self._board_troubles: list[str] = []
        self._signs: dict[tuple[str, str], float] = {}
        keys = keys_of(settings)
        if keys.present and keys.public not in settings.me.keys:
            self._own_troubles.append(UNFIT_KEY)
        facts = Facts(frozenset(config.wireless))
        self._links = Links(settings.me, facts, anywhere=config.snapshots_over == "any")
        self._wires = Wires(self._links, self._links_changed)
        self._connections = AllConnections(settings, keys, self._hear, self._way_changed, self._links, self._unread)
        self._replication_link = self._connections.bulk
        self.team_changes = TeamChanges(self)

    def connect(self, verbs: Questions, of_peers: Mapping[str, OrderOfPeer] = MappingProxyType({})) -> None:
        """Have the orders of people and robots carried out by these; ``of_peers``: further ones that robots give themselves."""
        self.verbs = verbs
        orders = {**self.team_changes.orders(), **of_peers}
        self.errands = Errands(self._connections.say, self.hindrance, verbs.errands(), orders)

    async def take_team(self, team: Team) -> None:
        """Go on with these members: the main loop's frames and rules, and every connection."""
        self.settings = self.settings.with_team(team)
        try:
            await asyncio.to_thread(known_sites.note, self.settings)
        except AgentError as error:
            log.warning("%s", error)
        await self.prepare_team()
        self._say(TeamIs(dict(team.robots)))
        await self._connect_anew()

    async def take_secret(self, secret: str) -> None:
        """Go on with this secret key, whose public half all members know."""
        self.settings = self.settings.with_secret(secret)
        await self._connect_anew()

    async def _connect_anew(self) -> None:
        """Every connection, as far as members and keys are others now."""
        try:
            await self._connections.change(self.settings, keys_of(self.settings))
        except LaneError as error:
            log.critical("%s; the worker process starts anew", error)
            self._end.set()

    # --- what builds on it ---

    @abstractmethod
    async def prepare(self) -> messages.Inventory:
        """Have ready whatever is needed before anything can be asked; what the main loop must know of it."""

    @abstractmethod
    def obeys(self, act: acts.Act) -> None:
        """Carry an act of the core out."""

    @abstractmethod
    def picture(self, told: Told) -> dict[str, Any]:
        """What ``status`` shows."""

    async def prepare_team(self) -> None:
        """The team has changed: have ready what the main loop opens for each member."""

    async def stop_work(self) -> None:
        """Give up what is under way, while the connections still stand."""

    async def close(self) -> None:
        """Give back what is left, when no client can ask for anything any more."""

    def hear_of_a_snapshot(self, peer: str, message: Bulk) -> None:
        """A word about a snapshot on the replication link."""

    def link_lost(self, peer: str) -> None:
        """The bulk lane to a peer is gone, and every transfer on it."""

    def link_is_new(self, peer: str) -> None:
        """A peer greets on a new replication link."""

    async def run(self) -> None:
        """From the main loop's first word to its last.

        Raises:
            AgentError, CheckpointError: something needed to begin cannot be had.
        """
        loop = asyncio.get_running_loop()
        make_directory(self._runtime)
        loop.add_reader(self._main_loop.fileno(), self._listen_to_main_loop)
        speaking = asyncio.create_task(self._speak_to_main_loop())
        living = asyncio.create_task(self._show_life())
        self._life = await self._begun
        await self._begin()
        self._wires.watch()
        self._connections.open()
        verbs = {**self.verbs.gated(), "team": self.team_changes.verb}
        server = ControlServer(self._runtime / SOCKET_NAME, self.settings.config.group, verbs, self.settings.config.page_user)
        await server.open()
        updating = asyncio.create_task(self.team_changes.bring_up_to_date())
        updating.add_done_callback(end_worker_on_mistake)
        syscalls.give_back()  # what the start has left
        try:
            await self._end.wait()
        finally:
            loop.remove_reader(self._main_loop.fileno())
            updating.cancel()
            await server.close()
            self.gate.close()
            self._wires.close()
            await self.errands.close()
            await self.stop_work()
            await self._connections.close()
            await self.close()
            speaking.cancel()
            living.cancel()

    # --- the main loop ---

    async def _begin(self) -> None:
        """Say what was found: the core is born with that."""
        inventory = await self.prepare()
        self._say(TeamIs(dict(self.settings.team.robots)))
        self._say(inventory)
        early, self._early = self._early or [], None
        for event in early:
            self.tell(event)

    def tell(self, event: Event) -> None:
        """Pass an event to the core. An event waits until the core is born: a program that was found may end before."""
        if self._early is not None:
            self._early.append(event)
        else:
            self._say(messages.happened(event))

    async def ask(self, what: Literal["status", "why", "elections"]) -> Told:
        """Ask the main loop for the core's view, for what it has not written down yet, or for the elections that it has."""
        number = next(self._numbers)
        answer: asyncio.Future[Told] = asyncio.get_running_loop().create_future()
        self._questions[number] = answer
        self._say(Ask(number, what))
        try:
            return await asyncio.wait_for(answer, ANSWER_PATIENCE_S)
        except TimeoutError:
            raise AgentError(f"the agent's main loop did not answer for {ANSWER_PATIENCE_S:.0f} s; see its log") from None
        finally:
            self._questions.pop(number, None)

    async def command(self, make: Callable[[int], events.Command | events.Drain]) -> acts.Answer:
        """Have the core decide; its answer."""
        number = next(self._numbers)
        answer: asyncio.Future[acts.Answer] = asyncio.get_running_loop().create_future()
        self._commands[number] = answer
        self.tell(make(number))
        try:
            return await asyncio.wait_for(answer, ANSWER_PATIENCE_S)
        except TimeoutError:
            raise AgentError(f"no decision in {ANSWER_PATIENCE_S:.0f} s; see failover why") from None
        finally:
            self._commands.pop(number, None)

    def _say(self, message: messages.ToMainLoop) -> None:
        self._outgoing.put_nowait(message)

    async def _show_life(self) -> None:
        while True:
            self._say(Alive())
            await asyncio.sleep(ALIVE_S)

    async def _speak_to_main_loop(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            message = await self._outgoing.get()
            while True:
                try:
                    self._main_loop.send(message)
                    break
                except ChannelClosedError:
                    self._end.set()
                    return
                except ChannelError:
                    writable = asyncio.Event()
                    loop.add_writer(self._main_loop.fileno(), writable.set)
                    await writable.wait()
                    loop.remove_writer(self._main_loop.fileno())

    def _listen_to_main_loop(self) -> None:
        try:
            for _ in range(MESSAGES_A_TURN):
                message, _descriptors = self._main_loop.receive()
                self._heed(message)
        except BlockingIOError:
            return
        except ChannelError:
            asyncio.get_running_loop().remove_reader(self._main_loop.fileno())
            self._end.set()

    def _heed(self, message: ToWorker) -> None:
        match message:
            case Order():
                self.obeys(messages.act_of(message))
            case Told():
                _resolve(self._questions, message.number, message)
            case Life():
                if not self._begun.done():
                    self._begun.set_result(message)
            case IsRestart():
                self._looking = asyncio.create_task(self._look_whether_it_restarts())
                self._looking.add_done_callback(end_worker_on_mistake)
            case Farewell():
                self._end.set()

    async def _look_whether_it_restarts(self) -> None:
        self._say(Ends(await asyncio.to_thread(is_restarted)))

    def answered(self, act: acts.Answer) -> None:
        """The core has decided about a command."""
        _resolve(self._commands, act.request, act)

    # --- peers ---

    def _way_changed(self, way: int, peer: str, state: LinkState, reason: str) -> None:
        """A connection stands: introduce ourselves. It is gone: so is every transfer on it, and every word that took it."""
        link = "replication link" if way == BULK else f"link {way}"
        log.info("%s to %s: %s%s", link, peer, state, f": {reason}" if reason else "")
        had_words = self._connections.carried_words(way, peer, state)
        if state is LinkState.CONNECTED:
            key = self._connections.beat_key(peer)
            self._greet(way, peer, key)
            self.errands.stands(peer)
            if peer in self.settings.peers:
                self._say(SpeakKey(peer, key))
            return
        if way == BULK:
            self.link_lost(peer)
        if had_words:
            self.errands.lost(peer)
            if not self.hindrance(peer):  # another way stands
                self.errands.stands(peer)

    def _unread(self, peer: str, why: str) -> None:
        """Something came from a peer, or from an unknown sender (""), that does not prove whose it is."""
        if peer in self.settings.former or self.settings.is_far(peer):
            return  # whether they live is no matter to any decision here
        now_s = asyncio.get_running_loop().time()
        sign = (peer, why if peer else "")
        if len(self._signs) > SIGNS_MAX:
            self._signs.clear()
        if now_s >= self._signs.get(sign, 0) + SIGN_S:
            self._signs[sign] = now_s
            self.tell(events.Unread(peer, why))

    async def _links_changed(self, sentences: list[str]) -> None:
        self._say(LinksAre(tuple(map(_link_now, self._links.of_beats()))))
        for sentence in sentences:
            log.info("%s", sentence)
            self.tell(events.Noticed("", sentence))
        try:
            await self._replication_link.hold_to_devices()
        except LaneError as error:
            log.critical("%s; the worker process starts anew", error)
            self._end.set()

    def hindrance(self, peer: str) -> str:
        """Why nothing can be said to a peer now; "" when it can."""
        return self._connections.hindrance(peer)

    def _hear(self, way: int, peer: str, message: Bulk) -> None:
        if peer not in self.settings.others:
            self._hear_former(peer, message)
            return
        is_far = self.settings.is_far(peer)
        match message:
            case Hello():
                self._greeted(way, peer, message)
            case Goodbye(reason):
                self._connections.refuse(way, peer, reason)
            case _ if peer in self._incompatible:
                return
            case Errand(verb=verb) if verb not in (*QUESTIONS, *TEAM_TOLD) and self.votes_only(peer):
                self._connections.say(
                    peer, ErrandDone(message.number, b"", f"{peer} is a witness: it votes, and gives no orders")
                )
            case Errand(verb=verb) if is_far and verb not in (*QUESTIONS, *self.team_changes.orders(), SEALED, ITEMS, RECOVERED):
                self._connections.say(peer, ErrandDone(message.number, b"", OTHER_SITE.format(peer)))
            case Offer() if is_far:
                self._connections.say(peer, Refuse(message.transfer, OTHER_SITE.format(peer)))
            case Belongings() | Content() if is_far and self.settings.me.role != "witness":
                return  # a witness keeps sealed copies of other sites, too
            case Errand():
                self.errands.received(peer, message)
            case ErrandDone():
                self.errands.done(peer, message)
            case _ if way == BULK:
                self.hear_of_a_snapshot(peer, message)

    def _hear_former(self, peer: str, message: Bulk) -> None:
        """A robot that was taken out, and has perhaps not heard of it; what it says counts for nothing else."""
        if peer not in self.settings.former:
            return
        match message:
            case Hello(team=team, change=change, members=members) if team == self.settings.team.team:
                self.team_changes.heard(peer, change, members)
            case Errand(verb=verb) if verb == TEAM_IS:
                self.errands.received(peer, message)
            case ErrandDone():
                self.errands.done(peer, message)

    def _greeted(self, way: int, peer: str, hello: Hello) -> None:
        reason = ""
        if hello.version != VERSION:
            reason = f"{peer} speaks version {hello.version}, this robot {VERSION}; install the same release on both"
        elif hello.team != self.settings.team.team:
            reason = f"{peer} belongs to team {hello.team!r}, this robot to {self.settings.team.team!r}"
        elif len(hello.beat_key) < KEY_SIZE_MIN:
            reason = f"{peer} sent a beat key of {len(hello.beat_key)} bytes; install the same release on both"
        elif moved := self._other_sites(hello):
            reason = OTHER_SITES.format(peer, moved)
            if peer in self.settings.peers:
                self._say(HearKey(peer, hello.beat_key, knows_other_sites=True))  # it lives, and is not to be replaced
        if way == BULK and not hello.again:
            self.link_is_new(peer)  # a new connection: what was half here stays half
        if reason:
            self._incompatible[peer] = reason
            self._unread(peer, reason)
            self._connections.answer(way, peer, Goodbye(reason))
            log.warning("%s", reason)
            return
        self._incompatible.pop(peer, None)
        self.team_changes.heard(peer, hello.change, hello.members)
        if peer in self.settings.peers:
            self._say(HearKey(peer, hello.beat_key))
        if self._connections.is_new_key(way, peer, hello.beat_key) and self._connections.present_key(peer):
            # A robot that lost its power ended no connection: ours to it seems to stand, and is refused at the first word.
            self._greet(way, peer, self._connections.present_key(peer), again=True)

    def _other_sites(self, hello: Hello) -> str:
        """The members that are elsewhere by a peer's word: robots that disagree about sites would count different majorities.

        A change that all members grant moves nobody, so two robots may have different changes, and members, all the same.
        """
        ours = sites_of(self.settings.team)
        theirs = dict.fromkeys(ours, "") if hello.sites is None else hello.sites
        return ", ".join(sorted(name for name, site in theirs.items() if ours.get(name, site) != site))

    def _greet(self, way: int, peer: str, key: bytes, *, again: bool = False) -> None:
        config, team = self.settings.config, self.settings.team
        hello = Hello(
            VERSION, team.team, config.robot, self._life.boot, key, again, team.change, digest(team.robots), sites_of(team)
        )
        self._connections.answer(way, peer, hello)

    def votes_only(self, peer: str) -> bool:
        """Whether nothing that this peer says may start, end or overwrite anything."""
        return self.settings.team.robots[peer].role == "witness"

    def notices(self) -> list[str]:
        """What is wrong with the lines, for the status."""
        return [
            *self._own_troubles,
            *self._board_troubles,
            *self._incompatible.values(),
            *self.team_changes.notes(),
            *self._replication_link.troubles(),
            *self._connections.troubles,
            *self._links.notes(),
        ]


def _link_now(link: Link | None) -> LinkNow:
    if link is None:
        return LinkNow()
    return LinkNow(link.name, link.index, link.medium is Medium.WIRELESS, link.medium is Medium.LOOPBACK)


def make_directory(directory: Path) -> None:
    """Have a directory for our eyes only.

    Raises:
        AgentError: it cannot be made.
    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise AgentError(
            f"cannot make {directory}: {error.strerror}; name directories that this user may write as state_directory "
            "and runtime_directory"
        ) from error


def _resolve(waiting: dict[int, asyncio.Future[Any]], number: int, answer: Any) -> None:
    future = waiting.pop(number, None)
    if future is not None and not future.done():
        future.set_result(answer)


def live(kind: Callable[[Settings, Channel[ToWorker]], Switchboard]) -> int:
    """Be the other process of the main loop that started us with CONFIG and DESCRIPTOR; its signals are its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    allocator.be_frugal()
    path, descriptor = Path(sys.argv[1]), int(sys.argv[2])
    try:
        settings = known_sites.load(path)
        set_up_log(settings.config.log_level, settings.config.robot)
        with contextlib.suppress(asyncio.CancelledError):
            asyncio.run(_live(kind, settings, descriptor))
    except (AgentError, CheckpointError, OSError) as error:
        log.critical("%s", error)
        return 1
    return 0


async def _live(kind: Callable[[Settings, Channel[ToWorker]], Switchboard], settings: Settings, descriptor: int) -> None:
    end = socket.socket(fileno=descriptor)
    end.setblocking(False)
    await kind(settings, Channel(end, ToWorker)).run()
