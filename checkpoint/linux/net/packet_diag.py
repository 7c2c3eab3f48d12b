"""Read memberships and rings of packet sockets by netlink, the only interface that reports them.

Source: sock_diag(7), linux/packet_diag.h.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from typing import Final

from msgspec import Struct

from checkpoint.linux.net import sock_diag

_REQUEST: Final = struct.Struct("<BBHIIII")
_ANSWER: Final = struct.Struct("<BBHI8x")
_MEMBERSHIP: Final = struct.Struct("<IIHH32s")
_SHOW: Final = 1 | 2 | 4
"""Interface, memberships, rings."""
_MEMBERSHIPS: Final = 1
_RINGS: Final = {2: 5, 3: 13}
"""PACKET_DIAG_RX_RING and TX_RING, and the options that make them: PACKET_RX_RING and PACKET_TX_RING."""


class Membership(Struct, frozen=True):
    """Packets that a packet socket receives besides those for this machine.

    Attributes:
        count: how often it was asked for.
        type: PACKET_MR_MULTICAST, PROMISC, ALLMULTI or UNICAST.
    """

    interface: int
    count: int
    type: int
    address: bytes


class PacketSocket(Struct, frozen=True):
    """One packet socket.

    Attributes:
        rings: by the option that makes one, its argument: struct tpacket_req3.
    """

    memberships: tuple[Membership, ...]
    rings: Mapping[int, bytes]


def packet_sockets() -> Mapping[int, PacketSocket]:
    """All of our network namespace, by inode number.

    Raises:
        OSError: the kernel does not tell (CONFIG_PACKET_DIAG).
    """
    found = {}
    for answer in sock_diag.listed(_REQUEST.pack(socket.AF_PACKET, 0, 0, 0, _SHOW, 0xFFFFFFFF, 0xFFFFFFFF)):
        told = dict(sock_diag.attributes(answer[_ANSWER.size :]))
        packed = told.get(_MEMBERSHIPS, b"")
        memberships = tuple(
            Membership(interface, count, kind, address[:size])
            for interface, count, kind, size, address in _MEMBERSHIP.iter_unpack(packed)
        )
        found[_ANSWER.unpack_from(answer)[3]] = PacketSocket(
            memberships, {option: told[ring] for ring, option in _RINGS.items() if ring in told}
        )
    return found
