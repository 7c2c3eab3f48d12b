"""All connections to the other robots: the replication link on the wire, and a message link on each further network link.

Snapshots, which are large and secret, stay on the replication link. Orders, questions and the keys of heartbeats are small. While
the cable is out they travel over another link, so that a robot whose agent restarts meanwhile is not taken for dead for want of a
key. A message link listens at the host of that network link's heartbeat address and at the replication link's port.
"""

from __future__ import annotations

import functools
import logging
import secrets
from collections.abc import Callable, Iterable
from typing import Final

from agent.config import Settings
from agent.errors import LaneError
from agent.worker.network.links import EVERY_DEVICE, Device
from agent.worker.network.replication_link import (
    Callbacks,
    Devices,
    KeyOwners,
    Keys,
    LinkState,
    ReplicationLink,
    Unread,
    public_key_of,
)
from failover.config.team import Robot, split_address
from failover.core.wire.messages import Bulk

BEAT_KEY_SIZE: Final = 32

BULK: Final = 0
"""Number of the replication link among the ways; the others follow in the order of the beat addresses."""

Heard = Callable[[int, str, Bulk], None]
"""Called with (way, peer, message)."""

Changed = Callable[[int, str, LinkState, str], None]
"""Called with (way, peer, state, reason) when a connection changed."""

log = logging.getLogger("failover.lane")


class _DevicesOfSite:
    """Connections to members of other sites take whichever interface leads there: a router's, or a tunnel's."""

    def __init__(self, devices: Devices) -> None:
        self._devices = devices
        self._far: frozenset[str] = frozenset()

    def know(self, settings: Settings) -> None:
        """These are the sites now."""
        self._far = frozenset(split_address(robot.bulk, "bulk address")[0] for robot in settings.far.values())

    def device(self, host: str) -> Device | None:
        """See `agent.worker.network.replication_link.Devices`."""
        return None if host in self._far else self._devices.device(host)

    def listening(self, peers: Iterable[str]) -> Device | None:
        """See `agent.worker.network.replication_link.Devices`."""
        hosts = list(peers)
        return EVERY_DEVICE if self._far.intersection(hosts) else self._devices.listening(hosts)


class AllConnections:
    """The connections of one robot. Lives in one asyncio loop.

    Attributes:
        bulk: the one that snapshots travel on.
        troubles: sentences: links that could not be had.
    """

    def __init__(
        self, settings: Settings, keys: Keys, heard: Heard, changed: Changed, links: Devices, unread: Unread = lambda *_: None
    ) -> None:
        self.troubles: list[str] = []
        self._connected: set[tuple[int, str]] = set()
        self._beat_keys: dict[str, bytes] = {}
        self._their_keys: dict[tuple[int, str], bytes] = {}
        self._all: list[ReplicationLink] = []
        self._name, self._tell = settings.config.robot, (heard, changed, unread)
        self._further: dict[str, ReplicationLink] = {}
        self._owners = KeyOwners(keys)
        callbacks = self._callbacks(BULK)
        self._devices = _DevicesOfSite(links)
        self._devices.know(settings)
        self.bulk = ReplicationLink(self._name, settings.me.bulk, _bulks(settings), keys, callbacks, self._devices, self._owners)
        self._all.append(self.bulk)
        for bind, peers in further_links(settings):
            self._add(bind, peers, keys)

    def _callbacks(self, way: int) -> Callbacks:
        heard, changed, unread = self._tell
        return Callbacks(functools.partial(heard, way), functools.partial(changed, way), unread)

    def _add(self, bind: str, peers: dict[str, str], keys: Keys) -> ReplicationLink:
        callbacks = self._callbacks(len(self._all))
        link = self._further[bind] = ReplicationLink(self._name, bind, peers, keys, callbacks, owners=self._owners)
        self._all.append(link)
        return link

    def open(self) -> None:
        """Listen on every link. A further link that cannot be had is done without, and said.

        Raises:
            LaneError: the replication link's address cannot be had.
        """
        self.bulk.open()
        for link in self._further.values():
            self._open_further(link)

    def _open_further(self, link: ReplicationLink) -> None:
        try:
            link.open()
        except LaneError as error:
            self.troubles.append(f"orders cannot use a further link: {error}")
            log.warning("%s", self.troubles[-1])

    async def change(self, settings: Settings, keys: Keys) -> None:
        """Go on with these members. A key that counts no more is refused on every link before the first one is made anew.

        Raises:
            LaneError: the replication link's address cannot be had any more.
        """
        self._owners.know(keys)
        self._devices.know(settings)
        former = set(self._beat_keys) - set(settings.others)
        self._beat_keys = {peer: key for peer, key in self._beat_keys.items() if peer not in former}
        self._their_keys = {ways: key for ways, key in self._their_keys.items() if ways[1] not in former}
        await self.bulk.change(_bulks(settings), keys)
        there = dict(further_links(settings))
        for bind, link in self._further.items():
            await link.change(there.pop(bind, {}), keys)
        for bind, peers in there.items():
            self._open_further(self._add(bind, peers, keys))

    async def close(self) -> None:
        """Close every connection."""
        for link in self._all:
            await link.close()

    def say(self, peer: str, message: Bulk) -> bool:
        """Queue a word to a peer, over the first way that is connected; False: there is none, it was dropped."""
        link = next((link for link in self._all if _is_connected(link, peer)), None)
        return link is not None and link.say(peer, message)

    def answer(self, way: int, peer: str, message: Bulk) -> bool:
        """Queue a word to a peer over one way."""
        return self._all[way].say(peer, message)

    def refuse(self, way: int, peer: str, reason: str) -> None:
        """Talk no further with this peer there until it connects anew."""
        if peer in self._all[way].links:
            self._all[way].links[peer].refuse(reason)

    def carried_words(self, way: int, peer: str, state: LinkState) -> bool:
        """Called at each change of a connection: whether words to the peer took this way until now, and may be lost with it."""
        was_connected = (way, peer) in self._connected
        if state is LinkState.CONNECTED:
            self._connected.add((way, peer))
        else:
            self._connected.discard((way, peer))
        has_better = any((better, peer) in self._connected for better in range(way))
        return was_connected and not has_better

    def hindrance(self, peer: str) -> str:
        """Why nothing can be said to a peer now; "" when it can."""
        link = self.bulk.links.get(peer)
        if link is None:
            return "it is no robot of this team"
        if any(_is_connected(one, peer) for one in self._all):
            return ""
        return f"the replication link is {link.state}" + (f", {link.reason}" if link.reason else "")

    def beat_key(self, peer: str) -> bytes:
        """The key for our beats to a peer on a new connection: a fresh one with the first, told again on any further."""
        connected = sum(_is_connected(link, peer) for link in self._all)
        if connected <= 1 or peer not in self._beat_keys:
            self._beat_keys[peer] = secrets.token_bytes(BEAT_KEY_SIZE)
        return self._beat_keys[peer]

    def present_key(self, peer: str) -> bytes:
        """The key that our beats to a peer are sealed with; empty before the first connection."""
        return self._beat_keys.get(peer, b"")

    def is_new_key(self, way: int, peer: str, key: bytes) -> bool:
        """Whether a peer greets with another key than it did last on this way: then it has begun anew, and knows none of ours."""
        known = self._their_keys.get((way, peer))
        self._their_keys[way, peer] = key
        return known != key


def keys_of(settings: Settings) -> Keys:
    """This robot's pair of keys, and those of all members.

    Raises:
        LaneError: its secret key is none.
    """
    if settings.config.insecure:
        return Keys("", "", {})
    known = {**settings.former, **settings.team.robots}
    publics = {name: robot.public_key for name, robot in known.items()}
    following = {name: robot.next_key for name, robot in known.items() if robot.next_key}
    return Keys(public_key_of(settings.secret_key), settings.secret_key, publics, following)


def _bulks(settings: Settings) -> dict[str, str]:
    """A robot that was taken out is connected to as well: it may not have heard of it."""
    return {peer: robot.bulk for peer, robot in (*settings.former.items(), *settings.others.items())}


def further_links(settings: Settings) -> list[tuple[str, dict[str, str]]]:
    """For each link beside the replication link's: where to listen, and every peer's address there."""
    found = []
    for number, address in enumerate(settings.me.beats):
        bind = _beside(address, settings.me)
        peers = {
            name: there
            for name, peer in settings.peers.items()
            if number < len(peer.beats) and (there := _beside(peer.beats[number], peer))
        }
        if bind and peers:
            found.append((bind, peers))
    return found


def _beside(beat_address: str, robot: Robot) -> str:
    """The host of a beat address with the replication link's port; "" where it is the replication link's own host."""
    host, _ = split_address(beat_address, "beat address")
    bulk, port = split_address(robot.bulk, "bulk address")
    return "" if host == bulk else f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_connected(link: ReplicationLink, peer: str) -> bool:
    return peer in link.links and link.links[peer].state is LinkState.CONNECTED
