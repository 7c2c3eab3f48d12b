"""The beat lane: plain UDP datagrams, one socket a link, never queued behind anything.

Nothing here blocks and nothing raises for the network's sake: a datagram that cannot leave is a beat that a peer misses, which
is exactly what beats are there to show. Authentication is `failover.core.wire`'s.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from agent.errors import LaneError
from agent.rtnetlink import ANCILLARY_SIZE, allow_absent, interface_index, tell_interfaces
from failover.client.team import Robot, for_lookup, split_address

FRAME_LIMIT: Final = 1_472
"""Bytes of one datagram: an Ethernet frame's worth, so that no beat is lost with half a fragment."""

TURN_LIMIT: Final = 128
"""Datagrams taken from one socket in one turn, so that a flood cannot keep the loop from its own beats."""

RECEIVE_BUFFER: Final = 256 << 10
"""Bytes: two hundred beats may wait while the loop persists nothing and sleeps."""

EXPEDITED: Final = 0xB8
"""IP type of service: DSCP EF, so that switches and the wireless card send beats first. Source: RFC 3246, RFC 8325."""


class BeatLane:
    """This robot's beat sockets and everybody's beat addresses."""

    def __init__(self, me: Robot, peers: Mapping[str, Robot]) -> None:
        """Bind one socket to each of this robot's beat addresses; one that no interface has yet works once an interface has it.

        Raises:
            LaneError: an address cannot be had.
        """
        self._sockets = [_bound(address) for address in me.beats]
        self._filenos = tuple(link.fileno() for link in self._sockets)
        self._names: dict[int, str] = {}
        self._ways = {name: _ways(self._sockets, robot) for name, robot in peers.items()}
        self.unsent = 0

    def filenos(self) -> tuple[int, ...]:
        """To wait for datagrams."""
        return self._filenos

    def send(self, peer: str, frame: bytes) -> None:
        """One datagram to the peer over every link."""
        for link, address in self._ways.get(peer, ()):
            try:
                link.sendto(frame, address)
            except OSError:
                self.unsent += 1  # no route, no buffer, link down: the peer's silence is the message

    def receive(self, fileno: int) -> Iterator[tuple[bytes, str]]:
        """The datagrams that wait at one socket, at most `TURN_LIMIT`, each with the interface that it came over ("": not told).

        Which one the kernel chose is not known by the address: where one link is gone, its packets may come over another.
        """
        link = next(link for link in self._sockets if link.fileno() == fileno)
        for _ in range(TURN_LIMIT):
            try:
                frame, ancillary, _, _ = link.recvmsg(FRAME_LIMIT + 1, ANCILLARY_SIZE)
                yield frame, self._interface(ancillary)
            except BlockingIOError:
                return
            except OSError:
                continue  # an ICMP error of an earlier datagram; the next call has the next datagram

    def _interface(self, ancillary: Iterable[tuple[int, int, bytes]]) -> str:
        index = interface_index(ancillary)
        if index and index not in self._names:
            with contextlib.suppress(OSError):  # it has gone already
                self._names[index] = socket.if_indextoname(index)
        return self._names.get(index, "")

    def close(self) -> None:
        """Close the sockets."""
        for link in self._sockets:
            link.close()


def _bound(address: str) -> socket.socket:
    host, port = split_address(address, "beat address")
    try:
        found = socket.getaddrinfo(for_lookup(host), port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, where = found[0]
        link = socket.socket(family, kind | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, protocol)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        with contextlib.suppress(OSError):
            link.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, EXPEDITED)
        allow_absent(link)
        tell_interfaces(link)
        link.bind(where)
    except OSError as error:
        raise LaneError(
            f"cannot listen for beats at {address}: {error.strerror}; is another agent running, or is it another robot's?"
        ) from error
    return link


def _ways(links: Sequence[socket.socket], peer: Robot) -> tuple[tuple[socket.socket, tuple[str, int]], ...]:
    """Link i of ours speaks to address i of theirs; the last link also serves what is left over on the other side."""
    count = max(len(links), len(peer.beats))
    return tuple(
        (links[min(i, len(links) - 1)], split_address(peer.beats[min(i, len(peer.beats) - 1)], "beat address"))
        for i in range(count)
    )
