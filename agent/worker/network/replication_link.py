"""The replication link: ZeroMQ between agents, authenticated and encrypted by CURVE. The only ``zmq`` import.

One ROUTER socket receives from all peers; one DEALER socket sends to each peer. A connection carries one direction's messages, in
order. Messages queued for a connection are lost with the connection: the core repeats messages that still matter.

The link identifies a sender by key, not by claim: the ZAP answer below admits only public keys of the team file. While a member
replaces its key, two are its own. ZeroMQ asks once, when a connection is made, and notes the key with each message. Whose that
is now is looked up then, so that a key that does not count any more is refused at once.

Source: rfc.zeromq.org/spec/25 (CURVE), /27 (ZAP); zmq_setsockopt(3), zmq_socket_monitor(3).
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import logging
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, Protocol

import zmq
import zmq.asyncio
from msgspec import Struct
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

from agent.errors import LaneError
from agent.system.connection_quota import Arrivals, plain
from agent.system.crash import end_worker_on_mistake
from agent.system.rtnetlink import allow_absent
from agent.worker.network.links import Device
from failover.config.team import for_lookup, split_address
from failover.core.wire.codec import decode_bulk, encode_bulk
from failover.core.wire.messages import CHUNK_SIZE_MAX, Bulk, Chunk, Offer

QUEUE_LIMIT: Final = 1_024
"""Messages waiting for one peer, chunks not counted: a peer that takes none for so long has lost them anyway."""

HIGH_WATER: Final = 6
"""Messages inside ZeroMQ for one peer: a vote can no longer overtake them."""

MESSAGE_LIMIT: Final = CHUNK_SIZE_MAX + (64 << 10)
"""Bytes of one frame from a stranger; more closes the connection."""

RECONNECT_FIRST_MS: Final = 50
RECONNECT_MOST_MS: Final = 2_000
"""ZeroMQ doubles the pause from first to most and adds a random part of its own."""

CONNECT_LIMIT_MS: Final = 3_000
"""An attempt to connect that nobody answers is given up, and another one begins: the kernel's own pauses grow to a minute."""

RETRANSMIT_LIMIT_MS: Final = 3_000
"""A connection whose bytes stay unacknowledged so long is dead (TCP_USER_TIMEOUT); the beats have known it much earlier."""

HANDSHAKE_LIMIT_MS: Final = 5_000

LISTEN_TRIES: Final = 100
LISTEN_PAUSE_S: Final = 0.02

BACKLOG: Final = 100
"""Connections that wait to be accepted: more than a team has robots."""

KEY_SIZE: Final = 32
SHOWN: Final = 8
"""Characters of a public key by which people tell it from another one."""

MEND: Final = "bring the same team.toml to every robot, or enrol the robot whose key is another one again, and restart its agent"

HANDSHAKE_FAILURES: Final = frozenset(
    {zmq.EVENT_HANDSHAKE_FAILED_AUTH, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL}
)

ZAP_ADDRESS: Final = "inproc://zeromq.zap.01"
ZAP_DOMAIN: Final = b"failover"

log = logging.getLogger("failover.lane")


class LinkState(enum.StrEnum):
    """How the connection *to* a peer stands."""

    CONNECTING = "connecting"
    CONNECTED = "connected"
    REFUSED = "refused"
    DOWN = "down"


class Keys(Struct, frozen=True):
    """This robot's pair of keys and all members' public keys by name; Z85. Empty strings: no encryption.

    Attributes:
        following: of the members that replace their key now: the one that counts besides.
    """

    public: str
    secret: str
    peers: Mapping[str, str]
    following: Mapping[str, str] = {}

    def of(self, peer: str) -> tuple[str, ...]:
        """Each key by which a peer may be known."""
        return tuple(key for key in (self.peers.get(peer), self.following.get(peer)) if key)

    @property
    def present(self) -> bool:
        """Whether the link is authenticated and encrypted."""
        return bool(self.secret)


class KeyOwners:
    """Whose each public key is now. All links of one robot share it: a key that is refused on one is refused on each."""

    def __init__(self, keys: Keys) -> None:
        self._replaced: set[str] = set()
        self.know(keys)

    def know(self, keys: Keys) -> None:
        """From now on these count, but for those that their owner is replacing, and has used the next one."""
        self._keys = keys
        owners = {key: name for name in keys.peers for key in keys.of(name)}
        self._replaced &= {keys.peers[name] for name in keys.following if name in keys.peers}
        self._owners = {key: name for key, name in owners.items() if key not in self._replaced}

    def is_replaced(self, key: str) -> bool:
        """Whether its owner has used its next key since, while both are in the team file."""
        return key in self._replaced

    def owner(self, key: str) -> str | None:
        """The member that this key proves; None: none."""
        return self._owners.get(key)

    def used(self, key: str, peer: str) -> None:
        """A peer has used this key. If it is its new one, it goes back to no old one."""
        if key == self._keys.following.get(peer):
            self._replaced.add(self._keys.peers[peer])
            self._owners.pop(self._keys.peers[peer], None)


class Devices(Protocol):
    """Which interfaces connections are held to; see `agent.worker.network.links.Links`."""

    def device(self, host: str) -> Device | None:
        """By which a connection to that host of a peer must leave; None for any."""

    def listening(self, peers: Iterable[str]) -> Device | None:
        """By which connections of the peers at those hosts must come; None: as before, and at first any."""


class AnyDevice:
    """Connections take whichever interface the kernel chooses."""

    def device(self, _host: str) -> Device | None:
        """Any."""
        return None

    def listening(self, _peers: Iterable[str]) -> Device | None:
        """Any."""
        return None


ANY_DEVICE: Final = AnyDevice()

Receive = Callable[[str, Bulk], None]
"""Called with (peer, message)."""

Changed = Callable[[str, LinkState, str], None]
"""Called with (peer, state, reason) when a connection changed."""

Unread = Callable[[str, str], None]
"""Called with (peer, why) whenever something comes from a peer's address that does not prove to be its; "" for no peer's."""


class Callbacks(Struct, frozen=True):
    """Functions to which a link tells its events."""

    receive: Receive
    changed: Changed
    unread: Unread = lambda *_: None


def new_keys() -> tuple[str, str]:
    """A fresh (public, secret) pair, Z85."""
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def public_key_of(secret: str) -> str:
    """The public half of a secret key.

    Raises:
        LaneError: it is no key.
    """
    try:
        return zmq.curve_public(secret.encode()).decode()
    except (zmq.ZMQError, ValueError) as error:
        raise LaneError("this robot's secret key is not a CURVE key of 40 characters; failover team enrol makes one") from error


class PeerConnection:
    """The way to one peer: a DEALER socket, the messages that wait for it, and how its connection stands."""

    def __init__(
        self,
        context: zmq.asyncio.Context,
        me: str,
        peer: str,
        address: str,
        keys: Keys,
        callbacks: Callbacks,
        device: Device | None = None,
    ) -> None:
        """
        Args:
            device: the interface that the connection is held to; None for whichever the kernel chooses.
        """
        self.peer = peer
        self.device = device
        self.state = LinkState.CONNECTING
        self.reason = ""
        self._callbacks = callbacks
        self._own_key = shown(keys.public)
        self._their_keys = deque(keys.of(peer))
        self._misfits = 0
        self._words: deque[bytes] = deque(maxlen=QUEUE_LIMIT)
        self._chunk: tuple[bytes, asyncio.Future[None]] | None = None
        self._wake = asyncio.Event()
        self._socket = context.socket(zmq.DEALER)
        _limits(self._socket)
        self._socket.setsockopt(zmq.IDENTITY, me.encode())
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        if device is not None:
            self._socket.setsockopt(zmq.BINDTODEVICE, device.name.encode())
        self._socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_FIRST_MS)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MOST_MS)
        self._socket.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_LIMIT_MS)
        self._socket.setsockopt(zmq.TCP_MAXRT, RETRANSMIT_LIMIT_MS)
        if keys.present:
            self._socket.curve_publickey = keys.public.encode()
            self._socket.curve_secretkey = keys.secret.encode()
            self._socket.curve_serverkey = self.their_key.encode()
        self._monitor = self._socket.get_monitor_socket()
        self._address = f"tcp://{address}"
        self._loop = asyncio.get_running_loop()
        self._socket.connect(self._address)
        self._tasks = (asyncio.create_task(self._watch()), asyncio.create_task(self._send()))
        for task in self._tasks:
            task.add_done_callback(end_worker_on_mistake)

    @property
    def their_key(self) -> str:
        """The key that the peer must prove to have on this connection; "" without keys."""
        return self._their_keys[0] if self._their_keys else ""

    def know(self, keys: tuple[str, ...]) -> None:
        """The peer may prove to have any of these; the one that this connection is for is among them."""
        if keys:
            self._their_keys = deque((self.their_key, *(key for key in keys if key != self.their_key)))

    def say(self, message: Bulk) -> bool:
        """Queue a small message; it overtakes chunks. False: there is no connection, it was dropped."""
        if self.state is not LinkState.CONNECTED:
            return False
        self._words.append(encode_bulk(message))
        self._wake.set()
        return True

    async def ship(self, chunk: Chunk | Offer) -> None:
        """Send one chunk, or an offer that is as large, after all small messages; returns when ZeroMQ has taken it.

        Raises:
            LaneError: the connection is down, or went down meanwhile.
        """
        while self._chunk is not None and self.state is LinkState.CONNECTED:
            await asyncio.wait((self._chunk[1],))  # given up by its own sender, too
        if self.state is not LinkState.CONNECTED:
            raise LaneError(f"the replication link to {self.peer} is down: {self.reason or self.state}")
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._chunk = waiting = (encode_bulk(chunk), done)
        self._wake.set()
        try:
            await done
        finally:
            if done.cancelled() and self._chunk is waiting:  # what is given up does not leave any more
                self._chunk = None

    def refuse(self, reason: str) -> None:
        """Talk no further with this peer until it connects anew: it broke the rules."""
        self._enter(LinkState.REFUSED, reason)

    async def close(self) -> None:
        """Let the connection go; nothing lingers."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close(0)
        self._fail_chunk("the agent ends")

    async def _send(self) -> None:
        """Send waiting messages, small ones first, one at a time, so that little is committed to the socket's own queue."""
        while True:
            await self._wake.wait()
            if self._words:
                await self._socket.send(self._words.popleft())
            elif self._chunk is not None:
                body, done = self._chunk
                await self._socket.send(body)
                self._chunk = None if self._chunk and self._chunk[1] is done else self._chunk
                if not done.done():
                    done.set_result(None)
            else:
                self._wake.clear()

    async def _watch(self) -> None:
        """Follow the connection's events."""
        while True:
            event = parse_monitor_message(await self._monitor.recv_multipart())
            kind = event["event"]
            if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._misfits = 0
                self._enter(LinkState.CONNECTED, "")
            elif kind in HANDSHAKE_FAILURES:
                self._refused(kind)
            elif kind == zmq.EVENT_DISCONNECTED and self.state is not LinkState.REFUSED:
                self._enter(LinkState.CONNECTING, "the connection was lost")
            elif kind == zmq.EVENT_CLOSED and self.state is LinkState.CONNECTING:
                self._enter(LinkState.CONNECTING, "no agent listens there")

    def _refused(self, kind: int) -> None:
        """A handshake failed. Of a peer with two keys the other one is tried before anything is said."""
        is_misfit = kind != zmq.EVENT_HANDSHAKE_FAILED_AUTH  # else the key is the peer's, and ours is not known there
        self._misfits += is_misfit
        if is_misfit and len(self._their_keys) > 1 and self._misfits % len(self._their_keys):
            self._their_keys.rotate()
            self._connect_anew()
            return
        reason = _refusal(self.peer, kind, self._own_key, shown(self.their_key))
        self._enter(LinkState.REFUSED, reason)
        self._callbacks.unread(self.peer, reason)
        if not is_misfit or len(self._their_keys) > 1:
            self._loop.call_later(RECONNECT_MOST_MS / 1_000, self._knock_again)

    def _knock_again(self) -> None:
        """ZeroMQ does not by itself where a key was refused; and both robots are to know that the other one lives."""
        if self.state is LinkState.REFUSED and not self._socket.closed:
            self._connect_anew()

    def _connect_anew(self) -> None:
        with contextlib.suppress(zmq.ZMQError):
            self._socket.disconnect(self._address)
        if self._their_keys:
            self._socket.curve_serverkey = self.their_key.encode()
        self._socket.connect(self._address)

    def _enter(self, state: LinkState, reason: str) -> None:
        if (state, reason) == (self.state, self.reason):
            return
        self.state, self.reason = state, reason
        if state is not LinkState.CONNECTED:
            self._words.clear()
            self._fail_chunk(reason)
        self._callbacks.changed(self.peer, state, reason)

    def _fail_chunk(self, reason: str) -> None:
        waiting, self._chunk = self._chunk, None
        if waiting is not None and not waiting[1].done():
            waiting[1].set_exception(LaneError(f"the replication link to {self.peer} went down: {reason}"))


class ReplicationLink:
    """All connections of this robot. Lives in one asyncio loop."""

    def __init__(
        self,
        me: str,
        bind: str,
        peers: Mapping[str, str],
        keys: Keys,
        callbacks: Callbacks,
        devices: Devices = ANY_DEVICE,
        owners: KeyOwners | None = None,
    ) -> None:
        """
        Args:
            bind: "host:port" to listen at.
            peers: "host:port" by name.
            devices: which interfaces connections are held to.
            owners: of the keys, as all links of this robot know them; None: this is the only link.
        """
        self._devices = devices
        self._router: zmq.asyncio.Socket | None = None
        self._listening: Device | None = None
        self._me = me
        self._bind = bind
        self._peers = peers
        self._keys = keys
        self._callbacks = callbacks
        self._context = zmq.asyncio.Context()
        self._tasks: list[asyncio.Task[None]] = []
        self.links: dict[str, PeerConnection] = {}
        self.strangers = 0
        self._stranger = ""
        self._mismatch: dict[str, str] = {}
        self._misunderstood: Counter[str] = Counter()
        self._arrivals = Arrivals(split_address(bind, "bulk address")[1], self._hosts())
        self._owners = owners or KeyOwners(keys)

    async def change(self, peers: Mapping[str, str], keys: Keys) -> None:
        """Go on with these peers: who has left is refused from now on, who has come is connected to.

        A connection goes on as long as both keys that it was made with count. Where our own key is another one now, all that
        we have made are made anew with it, and peers must know it to connect to us from now on.

        Raises:
            LaneError: the address cannot be had any more.
        """
        before, self._peers = self._peers, peers
        former, self._keys = self._keys, keys
        self._owners.know(keys)
        self._arrivals.expect(self._hosts())
        for peer, link in list(self.links.items()):
            is_proved = not keys.present or link.their_key in keys.of(peer)
            if peers.get(peer) == before.get(peer) and is_proved and keys.public == former.public:
                link.know(keys.of(peer))
                continue
            self.links.pop(peer, None)
            await link.close()
            self._mismatch.pop(peer, None)
            self._callbacks.changed(peer, LinkState.DOWN, "its entry in the team, or this robot's own key, has changed")
        if self._router is None:
            return
        if keys.public != former.public:
            self._router.curve_secretkey = keys.secret.encode()
            await self._listen_anew(self._router)
        for peer in peers:
            if peer not in self.links:
                self._connect(peer)
        await self.hold_to_devices()

    def open(self) -> None:
        """Listen, and begin to connect to all peers.

        Raises:
            LaneError: the address cannot be had.
        """
        if self._keys.present:
            gate = self._context.socket(zmq.REP)
            gate.bind(ZAP_ADDRESS)
            self._tasks.append(asyncio.create_task(self._admit(gate)))
        router = self._context.socket(zmq.ROUTER)
        _limits(router)
        router.setsockopt(zmq.ROUTER_HANDOVER, 1)
        if self._keys.present:
            router.curve_server = True
            router.curve_secretkey = self._keys.secret.encode()
            router.zap_domain = ZAP_DOMAIN
        self._router = router
        monitor = router.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        try:
            self._listen(router)
        except LaneError:
            self._router = None
            router.disable_monitor()
            monitor.close(0)
            router.close(0)
            raise
        self._tasks.append(asyncio.create_task(self._hear(router)))
        self._tasks.append(asyncio.create_task(self._watch(monitor)))
        for task in self._tasks:
            task.add_done_callback(end_worker_on_mistake)
        for peer in self._peers:
            self._connect(peer)

    def _listen(self, router: zmq.asyncio.Socket) -> None:
        """Take connections by the interface that they must come by.

        Raises:
            LaneError: the address cannot be had.
        """
        self._listening = self._devices.listening(self._hosts())
        try:
            router.setsockopt(zmq.USE_FD, _listener(self._bind, self._listening))
            router.bind(f"tcp://{self._bind}")
        except (zmq.ZMQError, OSError) as error:
            raise LaneError(
                f"cannot listen for snapshots at {self._bind}: {error.strerror}; is another agent running, or is it not ours?"
            ) from error

    def _hosts(self) -> list[str]:
        return [split_address(address, "bulk address")[0] for address in self._peers.values()]

    async def hold_to_devices(self) -> None:
        """Interfaces have come or gone: connect, or listen, anew where it must be by another one than before.

        Where an interface has only gone, the sockets bound to it wait for its return.

        Raises:
            LaneError: the address cannot be had any more.
        """
        wanted = self._devices.listening(self._hosts())
        if self._router is not None and wanted not in (None, self._listening):
            await self._listen_anew(self._router)
        for peer, link in list(self.links.items()):
            if peer in self._peers and self._device_to(peer) not in (None, link.device):
                await link.close()
                self._callbacks.changed(peer, LinkState.CONNECTING, "its interface is another one now")
                if peer in self._peers:
                    self._connect(peer)

    async def _listen_anew(self, router: zmq.asyncio.Socket) -> None:
        """ZeroMQ lets an address go some time after it was told to."""
        with contextlib.suppress(zmq.ZMQError):
            router.unbind(f"tcp://{self._bind}")
        for _ in range(LISTEN_TRIES):
            try:
                self._listen(router)
                return
            except LaneError as error:
                trouble = error
                await asyncio.sleep(LISTEN_PAUSE_S)
        raise trouble

    def _connect(self, peer: str) -> None:
        address, device = self._peers[peer], self._device_to(peer)
        self.links[peer] = PeerConnection(self._context, self._me, peer, address, self._keys, self._callbacks, device)

    def _device_to(self, peer: str) -> Device | None:
        return self._devices.device(split_address(self._peers[peer], "bulk address")[0])

    def say(self, peer: str, message: Bulk) -> bool:
        """Queue a small message to a peer; False: it is not connected, the message was dropped."""
        return peer in self.links and self.links[peer].say(message)

    async def ship(self, peer: str, chunk: Chunk | Offer) -> None:
        """Send one chunk, or an offer that is as large; see `PeerConnection.ship`."""
        if peer not in self.links:
            raise LaneError(f"{peer} has left the team")
        await self.links[peer].ship(chunk)

    def troubles(self) -> list[str]:
        """The messages that this robot refused in this life, for the status: a sentence each."""
        told = [
            f"{peer} sent {count} messages on the replication link that this robot does not understand; "
            "install the same release on both"
            for peer, count in self._misunderstood.items()
        ]
        if trouble := self._arrivals.trouble():
            told.append(trouble)
        told.extend(self._mismatch.values())
        if self.strangers:
            told.append(
                f"this robot refused a key that is not in its team.toml on the replication link, {self.strangers} times, "
                f"last from {self._stranger}; bring the same team.toml to every robot if it is one of yours"
            )
        return told

    async def close(self) -> None:
        """Close every socket and wait for the tasks."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(link.close() for link in self.links.values()))
        self._context.destroy(linger=0)

    async def _hear(self, router: zmq.asyncio.Socket) -> None:
        """Every message of every peer, in order; a message that is malformed or of a stranger is counted and dropped."""
        try:
            while True:
                frames = await router.recv_multipart(copy=False)
                peer = self._speaker(frames)
                message = decode_bulk(frames[1].buffer) if peer and len(frames) == 2 else None
                if message is not None:
                    self._callbacks.receive(peer, message)
                elif peer:
                    self._misunderstood[peer] += 1
                elif not self._is_of_another_member(frames):
                    self._refused("a sender under another robot's name, or with a key that does not count any more")
        finally:
            router.close(0)

    async def _watch(self, monitor: zmq.asyncio.Socket) -> None:
        """Follow which connections come and go; a connection too many is ended before it has said a word."""
        try:
            while True:
                event = parse_monitor_message(await monitor.recv_multipart())
                if event["event"] == zmq.EVENT_ACCEPTED:
                    self._arrivals.accepted(event["value"])
                else:
                    self._arrivals.ended(event["value"])
        finally:
            monitor.close(0)

    def _is_of_another_member(self, frames: list[Any]) -> bool:
        """Whether it is of a member that this link is not for: `agent.visit` talks with one alone."""
        claimed = bytes(frames[0].bytes).decode(errors="replace")
        is_proved = self._keys.present and self._owners.owner(frames[-1].get("User-Id")) == claimed
        return is_proved and claimed not in self._peers

    def _speaker(self, frames: list[Any]) -> str:
        """The peer whose message this is, by its key; "" for a stranger or a peer under another's name."""
        claimed = bytes(frames[0].bytes).decode(errors="replace")
        if claimed not in self._peers:
            return ""
        if not self._keys.present:
            return claimed
        key = frames[1].get("User-Id")
        if self._owners.owner(key) != claimed:
            return ""
        self._owners.used(key, claimed)
        return claimed

    async def _admit(self, gate: zmq.asyncio.Socket) -> None:
        """Answer ZeroMQ's question which peer may connect: the owners of the team's keys, by name."""
        try:
            while True:
                version, request, _domain, address, _identity, mechanism, *credentials = await gate.recv_multipart()
                key = _presented(credentials) if mechanism == b"CURVE" else ""
                owner = self._owners.owner(key)
                if owner is None:
                    self._refuse(address.decode(errors="replace"), credentials)
                else:
                    self._arrivals.is_of_member(address.decode(errors="replace"))
                    self._mismatch.pop(owner, None)
                status = (b"200", b"OK", key.encode()) if owner else (b"400", b"not in the team", b"")
                await gate.send_multipart([version, request, *status, b""])
        finally:
            gate.close(0)

    def _refuse(self, address: str, credentials: list[bytes]) -> None:
        """A key that is not in the team: of a member whose key, or whose entry in our team file, is an old one?"""
        self._refused(address)
        host = plain(address)
        peers = [peer for peer, there in self._peers.items() if plain(split_address(there, "bulk address")[0]) == host]
        key = shown(_presented(credentials))
        for peer in peers:
            if self._owners.is_replaced(_presented(credentials)):
                self._mismatch[peer] = (
                    f"{peer} presents the key {key}, and has used its next key already: if its files were set back, take it out "
                    f"of the team and invite it again; if not, somebody has a copy of its old key, and failover team rotate "
                    f"{peer} ends the rotation"
                )
            else:
                known = shown(self._keys.peers[peer])
                self._mismatch[peer] = f"{peer} presents the key {key}, and team.toml here has {known} for it: {MEND}"
            self._callbacks.unread(peer, self._mismatch[peer])
        if not peers:
            self._callbacks.unread("", f"a sender at {address} presents the key {key}")

    def _refused(self, stranger: str) -> None:
        """Count one that is not in the team; the log hears of it once, for it may knock for ever."""
        self.strangers += 1
        if stranger != self._stranger:
            log.warning("refused a key that is not in team.toml on the replication link: %s", stranger)
        self._stranger = stranger


def _presented(credentials: list[bytes]) -> str:
    """The key of one who connects, Z85; "" for none."""
    return z85.encode(credentials[0]).decode() if len(credentials) == 1 and len(credentials[0]) == KEY_SIZE else ""


def _limits(socket: zmq.asyncio.Socket) -> None:
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
    socket.setsockopt(zmq.RCVHWM, HIGH_WATER)
    socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_LIMIT)
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_LIMIT_MS)
    socket.setsockopt(zmq.IPV6, 1)


def _listener(address: str, device: Device | None) -> int:
    """A descriptor that listens there, also where no interface has the address yet; it becomes ZeroMQ's.

    Raises:
        OSError: the address is taken, or is none.
    """
    host, port = split_address(address, "bulk address")
    found = socket.getaddrinfo(for_lookup(host), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, kind, protocol, _, where = found[0]
    with socket.socket(family, kind | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, protocol) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        allow_absent(listener)
        if device is not None:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.name.encode() + b"\0")
        listener.bind(where)
        listener.listen(BACKLOG)
        return listener.detach()


def shown(key: str) -> str:
    """The beginning of a public key, by which a person tells it from another in team.toml."""
    return f"{key[:SHOWN]}…" if key else "none"


def _refusal(peer: str, kind: int, own: str, theirs: str) -> str:
    if kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
        return f"{peer} does not know this robot's key, {own}: {MEND}"
    if kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
        return (
            f"the handshake with {peer} broke off: its key is not {theirs}, which team.toml here has, or one side runs without "
            f"keys: {MEND}"
        )
    return (
        f"{peer} closed the connection during the handshake: wrong key, or no agent; if its agent runs, its key is not {theirs}, "
        f"which team.toml here has: {MEND}"
    )
