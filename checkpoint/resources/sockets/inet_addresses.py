"""Convert internet addresses between facts ([host, port], for IPv6 [host, port, flow, scope]) and the kernel's form."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence

from checkpoint.model import Fact
from checkpoint.resources.restore_context import number_of


def in_words(address: Sequence[Fact]) -> str:
    return f"{address[0]!s} port {address[1]!s}"


def sockaddr(address: Sequence[Fact]) -> bytes:
    """An address as bind(2) takes it, 128 bytes."""
    host, port = str(address[0]), number_of(address[1])
    if ":" not in host:
        return struct.pack("<H", socket.AF_INET) + (struct.pack(">H", port) + socket.inet_aton(host)).ljust(126, b"\0")
    scope = number_of(address[3]) if len(address) > 3 else 0
    flow = number_of(address[2]) if len(address) > 2 else 0
    packed = struct.pack(">HI", port, flow) + socket.inet_pton(socket.AF_INET6, host.partition("%")[0])
    return struct.pack("<H", socket.AF_INET6) + (packed + struct.pack("<I", scope)).ljust(126, b"\0")


def size_of(address: Sequence[Fact]) -> int:
    return 28 if ":" in str(address[0]) else 16


def unpacked(packed: bytes) -> list[Fact]:
    """An address that the kernel wrote."""
    family, port = struct.unpack_from("<H", packed)[0], struct.unpack_from(">H", packed, 2)[0]
    if family == socket.AF_INET:
        return [socket.inet_ntoa(packed[4:8]), port]
    flow, scope = struct.unpack_from(">I", packed, 4)[0], struct.unpack_from("<I", packed, 24)[0]
    return [socket.inet_ntop(socket.AF_INET6, packed[8:24]), port, flow, scope]


def level_of(group: str) -> int:
    """The level by which a multicast group is joined; it does not depend on the socket's family."""
    return socket.IPPROTO_IPV6 if ":" in group else socket.IPPROTO_IP


def is_ours(address: Sequence[Fact]) -> bool:
    """Whether a socket can be bound to the address on this machine, at some port."""
    family = socket.AF_INET6 if ":" in str(address[0]) else socket.AF_INET
    if family == socket.AF_INET and socket.inet_aton(str(address[0]))[0] in range(224, 240):
        return True
    with socket.socket(family, socket.SOCK_DGRAM) as tried:
        try:
            tried.bind((str(address[0]), 0, *address[2:]))
        except OSError:
            return False
    return True
