"""All connections to the other robots: the replication link on the wire, and a message link on each further network link.

Snapshots, which are large and secret, stay on the replication link. Orders, questions and the keys of heartbeats are small. While
the cable is out they travel over another link, so that a robot whose agent restarts meanwhile is not taken for dead for want of a
key. A message link listens at the host of that network link's heartbeat address and at the replication link's port.
"""

from __future__ import annotations

import functools
import logging
import secrets
from collections.abc import Callable
from typing import Final

from agent.config import Settings
from agent.errors import LaneError
from agent.worker.network.links import Links
from agent.worker.network.replication_link import BulkLane, Keys, LinkState, Unread
from failover.config.team import Robot, split_address
from failover.core.wire.messages import Bulk

BEAT_KEY_SIZE: Final = 32

BULK: Final = 0
"""Number of the bulk lane among the ways; the others follow in the order of the beat addresses."""

Heard = Callable[[int, str, Bulk], None]
"""Called with (way, peer, message)."""

Changed = Callable[[int, str, LinkState, str], None]
"""Called with (way, peer, state, reason) when a connection changed."""

log = logging.getLogger("failover.lane")


class Ways:
    """The lanes of one robot. Lives in one asyncio loop.

    Attributes:
        bulk: the one that snapshots travel on.
        troubles: sentences: lanes that could not be had.
    """

    def __init__(
        self, settings: Settings, keys: Keys, heard: Heard, changed: Changed, links: Links, unread: Unread = lambda *_: None
    ) -> None:
        self.troubles: list[str] = []
        self._connected: set[tuple[int, str]] = set()
        self._beat_keys: dict[str, bytes] = {}
        self._their_keys: dict[tuple[int, str], bytes] = {}
        self._lanes: list[BulkLane] = []
        name = settings.config.robot
        bulks = {peer: robot.bulk for peer, robot in settings.peers.items()}
        hear, change = functools.partial(heard, BULK), functools.partial(changed, BULK)
        self.bulk = BulkLane(name, settings.me.bulk, bulks, keys, hear, change, links, unread)
        self._lanes.append(self.bulk)
        for way, (bind, peers) in enumerate(further_links(settings), start=1):
            hear, change = functools.partial(heard, way), functools.partial(changed, way)
            self._lanes.append(BulkLane(name, bind, peers, keys, hear, change, unread=unread))

    def open(self) -> None:
        """Listen on every link. A further link that cannot be had is done without, and said.

        Raises:
            LaneError: the bulk lane's address cannot be had.
        """
        for way, lane in enumerate(self._lanes):
            try:
                lane.open()
            except LaneError as error:
                if way == BULK:
                    raise
                self.troubles.append(f"orders cannot use a further link: {error}")
                log.warning("%s", self.troubles[-1])

    async def close(self) -> None:
        """Close every connection."""
        for lane in self._lanes:
            await lane.close()

    def say(self, peer: str, message: Bulk) -> bool:
        """Queue a word to a peer, over the first way that is connected; False: there is none, it was dropped."""
        lane = next((lane for lane in self._lanes if _is_connected(lane, peer)), None)
        return lane is not None and lane.say(peer, message)

    def answer(self, way: int, peer: str, message: Bulk) -> bool:
        """Queue a word to a peer over one way."""
        return self._lanes[way].say(peer, message)

    def refuse(self, way: int, peer: str, reason: str) -> None:
        """Talk no further with this peer there until it connects anew."""
        self._lanes[way].links[peer].refuse(reason)

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
        if any(_is_connected(lane, peer) for lane in self._lanes):
            return ""
        return f"the replication link is {link.state}" + (f", {link.reason}" if link.reason else "")

    def beat_key(self, peer: str) -> bytes:
        """The key for our beats to a peer on a new connection: a fresh one with the first, told again on any further."""
        connected = sum(_is_connected(lane, peer) for lane in self._lanes)
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


def further_links(settings: Settings) -> list[tuple[str, dict[str, str]]]:
    """For each link beside the bulk lane's: where to listen, and every peer's address there."""
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
    """The host of a beat address with the bulk lane's port; "" where it is the bulk lane's own host."""
    host, _ = split_address(beat_address, "beat address")
    bulk, port = split_address(robot.bulk, "bulk address")
    return "" if host == bulk else f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_connected(lane: BulkLane, peer: str) -> bool:
    return peer in lane.links and lane.links[peer].state is LinkState.CONNECTED
