"""Limits how many connections to the port of the replication link each address may hold: ZeroMQ itself takes any number.

A connection that does not prove its owner within some seconds ends anyway
(`agent.worker.network.replication_link.HANDSHAKE_LIMIT_MS`). Until then it takes a descriptor and some 30 KB of the worker
process. Addresses of the team have places of their own, which no other address can take.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
from collections import Counter
from collections.abc import Iterable
from typing import Final

ADDRESS_MAX: Final = 16
"""Connections of one address, for each robot that is there. A robot holds one, and two while it begins anew."""

OTHERS_MAX: Final = 64
"""Connections of all addresses together that are not the team's."""

KNOWN_MAX: Final = 256
"""Addresses from which members have come, besides those of the team file: a member may have as many as it likes."""


class Arrivals:
    """The connections to one port, by descriptor. Lives in one loop.

    Attributes:
        turned_away: connections that were ended because there were too many.
        last: the address of the last one.
    """

    def __init__(self, port: int, team: Iterable[str]) -> None:
        """
        Args:
            team: the hosts of the other members, one for each of them; names are known by address once their member has come.
        """
        self._port = port
        self.expect(team)
        self._addresses: dict[int, str] = {}
        self._held: Counter[str] = Counter()
        self.turned_away = 0
        self.last = ""

    def expect(self, team: Iterable[str]) -> None:
        """From now on these are the hosts of the other members."""
        self._room = Counter(map(plain, team))

    def is_of_member(self, address: str) -> None:
        """A member has proved itself from there."""
        address = plain(address)
        if address not in self._room and len(self._room) < KNOWN_MAX:
            self._room[address] = 1

    def accepted(self, descriptor: int) -> None:
        """A connection was accepted under this descriptor of our process; end it if it is one too many."""
        self.ended(descriptor)
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as connection:
            if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.getsockname()[1] != self._port:
                return  # it has ended, and its number is another file's
            address = plain(connection.getpeername()[0])
            if self._has_room(address):
                self._addresses[descriptor] = address
                self._held[address] += 1
                return
            self.turned_away, self.last = self.turned_away + 1, address
            connection.shutdown(socket.SHUT_RDWR)

    def ended(self, descriptor: int) -> None:
        """The connection of this descriptor is closed."""
        address = self._addresses.pop(descriptor, "")
        if address:
            self._held[address] -= 1
            if not self._held[address]:
                del self._held[address]

    def trouble(self) -> str:
        """How many connections were turned away, in a sentence; "" if none were."""
        if not self.turned_away:
            return ""
        return (
            f"{self.turned_away} connections to port {self._port} were turned away, last from {self.last}: more than "
            f"{ADDRESS_MAX} of one address or {OTHERS_MAX} of addresses that are not the team's, at a time; "
            "find the machine that connects"
        )

    def _has_room(self, address: str) -> bool:
        if self._held.get(address, 0) >= ADDRESS_MAX * self._room.get(address, 1):
            return False
        others = sum(count for one, count in self._held.items() if one not in self._room)
        return address in self._room or others < OTHERS_MAX


def plain(address: str) -> str:
    """An address as text, in one way: of IPv4 that comes over IPv6 too."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(getattr(found, "ipv4_mapped", None) or found)
