"""The beat lane: plain UDP datagrams, one socket a link, never queued behind anything.

Nothing here blocks and nothing raises for the network's sake: a datagram that cannot leave is a beat that a peer misses, which
is exactly what beats are there to show. Authentication is `failover.core.wire`'s.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from agent.errors import LaneError
from agent.rtnetlink import ANCILLARY_SIZE, allow_absent, interface_index, tell_interfaces
from failover.client.team import Robot, for_lookup, split_address

FRAME_LIMIT: Final = 1_472
"""Bytes of one datagram: an Ethernet frame's worth, so that no beat is lost with half a fragment."""

TURN_LIMIT: Final = 128
"""Datagrams taken in one turn, so that a flood cannot keep the loop from its own beats."""

RECEIVE_BUFFER: Final = 256 << 10
"""Bytes: two hundred beats may wait while the loop persists nothing and sleeps."""

EXPEDITED: Final = 0xB8
"""IP type of service: DSCP EF, so that switches and the wireless card send beats first. Source: RFC 3246, RFC 8325."""


SO_TIMESTAMPNS: Final = 35
_ARRIVAL: Final = struct.Struct("@ll")
"""Source: socket(7), SO_TIMESTAMP; asm-generic/socket.h; a struct timespec."""


class BeatLane:
    """This robot's beat sockets and everybody's beat addresses."""

    def __init__(self, me: Robot, peers: Mapping[str, Robot]) -> None:
        """Bind one socket to each of this robot's beat addresses; one that no interface has yet works once an interface has it.

        Raises:
            LaneError: an address cannot be had.
        """
        self._sockets = {link.fileno(): link for link in map(_bound, me.beats)}
        self._waiting = select.epoll()
        for fileno in self._sockets:
            self._waiting.register(fileno, select.EPOLLIN)
        self._names: dict[int, str] = {}
        self._ways = {name: _ways(tuple(self._sockets.values()), robot) for name, robot in peers.items()}
        self.unsent = 0

    def fileno(self) -> int:
        """Readable while datagrams wait."""
        return self._waiting.fileno()

    def send(self, peer: str, frame: bytes) -> None:
        """One datagram to the peer over every link."""
        for link, address in self._ways.get(peer, ()):
            try:
                link.sendto(frame, address)
            except OSError:
                self.unsent += 1  # no route, no buffer, link down: the peer's silence is the message

    def receive(self) -> Iterator[tuple[bytes, str, int]]:
        """The datagrams that wait, at most `TURN_LIMIT`: each with the interface that it came over ("": not told), and when.

        Which one the kernel chose is not known by the address: where one link is gone, its packets may come over another. The
        instant is by this machine's calendar, in nanoseconds since 1970; 0: not told.
        """
        taken = 0
        while taken < TURN_LIMIT:  # asked before each: to be told that none waits is cheaper than a call that fails
            ready = self._waiting.poll(0)
            if not ready:
                return
            for fileno, _ in ready:
                taken += 1
                try:
                    frame, ancillary, _, _ = self._sockets[fileno].recvmsg(FRAME_LIMIT + 1, ANCILLARY_SIZE)
                except OSError:
                    continue  # an ICMP error of an earlier datagram; the next call has the next datagram
                yield frame, self._interface(ancillary), _arrival_ns(ancillary)

    def _interface(self, ancillary: Iterable[tuple[int, int, bytes]]) -> str:
        index = interface_index(ancillary)
        if index and index not in self._names:
            with contextlib.suppress(OSError):  # it has gone already
                self._names[index] = socket.if_indextoname(index)
        return self._names.get(index, "")

    def close(self) -> None:
        """Close the sockets."""
        self._waiting.close()
        for link in self._sockets.values():
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
        link.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        link.bind(where)
    except OSError as error:
        raise LaneError(
            f"cannot listen for beats at {address}: {error.strerror}; is another agent running, or is it another robot's?"
        ) from error
    return link


def _arrival_ns(ancillary: Iterable[tuple[int, int, bytes]]) -> int:
    for level, kind, content in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
            seconds, ns = _ARRIVAL.unpack_from(content)
            return int(seconds) * 1_000_000_000 + int(ns)
    return 0


def _ways(links: Sequence[socket.socket], peer: Robot) -> tuple[tuple[socket.socket, tuple[str, int]], ...]:
    """Link i of ours speaks to address i of theirs; the last link also serves what is left over on the other side."""
    count = max(len(links), len(peer.beats))
    return tuple(
        (links[min(i, len(links) - 1)], split_address(peer.beats[min(i, len(peer.beats) - 1)], "beat address"))
        for i in range(count)
    )
