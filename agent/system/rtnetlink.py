"""Reads this machine's network interfaces and addresses, and their changes, from the kernel: a small part of rtnetlink(7).

It shows the network namespace of the agent; /sys/class/net can show another one. Source: rtnetlink(7), netlink(7),
linux/if_link.h, linux/rtnetlink.h.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct

NLMSG_ERROR: Final = 2
NLMSG_DONE: Final = 3
NLM_F_REQUEST: Final = 0x1
NLM_F_DUMP: Final = 0x300
RTM_NEWLINK: Final = 16
RTM_GETLINK: Final = 18
RTM_NEWADDR: Final = 20
RTM_GETADDR: Final = 22
RTMGRP_LINK: Final = 0x1
RTMGRP_IPV4_IFADDR: Final = 0x10
RTMGRP_IPV6_IFADDR: Final = 0x100

IFLA_IFNAME: Final = 3
IFLA_LINK: Final = 5
IFLA_MASTER: Final = 10
IFLA_LINKINFO: Final = 18
IFLA_CARRIER: Final = 33
IFLA_INFO_KIND: Final = 1
IFA_ADDRESS: Final = 1
IFA_LOCAL: Final = 2
IFF_UP: Final = 0x1

_HEADER: Final = struct.Struct("=IHHII")
_LINK: Final = struct.Struct("=BxHiII")
_ADDRESS: Final = struct.Struct("=BBBBI")
_ATTRIBUTE: Final = struct.Struct("=HH")

IP_PKTINFO: Final = 8
IPV6_SIZE: Final = 16
ANCILLARY_SIZE: Final = 128
"""Bytes: room for one in6_pktinfo, one timespec, and their heads."""

IP_FREEBIND: Final = 15
IPV6_FREEBIND: Final = 78

PIECE_SIZE: Final = 1 << 16
"""Bytes of one read: the kernel sends at most 32 KiB at a time in a dump."""

PIECES_A_TURN: Final = 256

PATIENCE_S: Final = 2.0
"""The kernel answers at once, or something is very wrong."""

ATTRIBUTE_KIND: Final = 0x3FFF
"""The rest of an attribute's type are flags."""


class KernelLink(Struct, frozen=True):
    """One interface.

    Attributes:
        hardware: ARPHRD_*, see linux/if_arp.h.
        kind: "veth", "bridge", "vlan", "wireguard" …; "" for a device's own.
        lower, master: index of the interface that it stands on, or belongs to; 0 for none.
        carrier: something is connected at the other end, and the operator wants it up.
    """

    index: int
    name: str
    hardware: int
    kind: str = ""
    lower: int = 0
    master: int = 0
    carrier: bool = False


def links() -> tuple[KernelLink, ...]:
    """Every interface of this network namespace.

    Raises:
        OSError: the kernel does not answer.
    """
    return tuple(_link(body) for kind, body in _dump(RTM_GETLINK, _LINK.pack(0, 0, 0, 0, 0)) if kind == RTM_NEWLINK)


def addresses() -> dict[str, int]:
    """Every address of this network namespace, as text, and the index of its interface.

    Raises:
        OSError: the kernel does not answer.
    """
    found = (_address(body) for kind, body in _dump(RTM_GETADDR, _ADDRESS.pack(0, 0, 0, 0, 0)) if kind == RTM_NEWADDR)
    return {text: index for text, index in found if text}


def changes() -> socket.socket:
    """A socket that becomes readable whenever an interface or an address changes; read it with `drain`.

    Raises:
        OSError: there is none to be had.
    """
    listener = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, 0)
    try:
        listener.bind((0, RTMGRP_LINK | RTMGRP_IPV4_IFADDR | RTMGRP_IPV6_IFADDR))
    except OSError:
        listener.close()
        raise
    return listener


def allow_absent(listener: socket.socket) -> None:
    """Let a socket be bound to an address that no interface has yet: a cable may be plugged in later. Source: ip(7), ipv6(7)."""
    if listener.family == socket.AF_INET6:
        listener.setsockopt(socket.IPPROTO_IPV6, IPV6_FREEBIND, 1)
    else:
        listener.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)


def tell_interfaces(listener: socket.socket) -> None:
    """From now on `interface_index` finds, in the data beside a datagram, by which interface it came. Source: ip(7), ipv6(7)."""
    if listener.family == socket.AF_INET6:
        listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
    else:
        listener.setsockopt(socket.IPPROTO_IP, IP_PKTINFO, 1)


def interface_index(ancillary: Iterable[tuple[int, int, bytes]]) -> int:
    """By which interface a datagram came; 0 if the kernel did not say."""
    for level, kind, content in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, IP_PKTINFO):
            return int(struct.unpack_from("=i", content)[0])
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO):
            return int(struct.unpack_from("=i", content, IPV6_SIZE)[0])
    return 0


def drain(listener: socket.socket) -> None:
    """Take all that has come. The caller reads the state anew, so a message that was lost (ENOBUFS) loses nothing."""
    for _ in range(PIECES_A_TURN):
        try:
            listener.recv(PIECE_SIZE)
        except BlockingIOError:
            return
        except OSError:
            continue


def _dump(kind: int, body: bytes) -> Iterator[tuple[int, bytes]]:
    """The answers to one question: (type, content after the netlink header) each."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, 0) as asking:
        asking.settimeout(PATIENCE_S)
        asking.sendto(_HEADER.pack(_HEADER.size + len(body), kind, NLM_F_REQUEST | NLM_F_DUMP, 1, 0) + body, (0, 0))
        while True:
            for answer, content in _messages(asking.recv(PIECE_SIZE)):
                if answer == NLMSG_DONE:
                    return
                if answer == NLMSG_ERROR:
                    number = -struct.unpack_from("=i", content)[0]
                    raise OSError(number, f"rtnetlink refused request {kind}")
                yield answer, content


def _messages(piece: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + _HEADER.size <= len(piece):
        size, kind, *_ = _HEADER.unpack_from(piece, at)
        if size < _HEADER.size:
            return
        yield kind, piece[at + _HEADER.size : at + size]
        at += size + 3 & ~3


def _attributes(content: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = 0
    while at + _ATTRIBUTE.size <= len(content):
        size, kind = _ATTRIBUTE.unpack_from(content, at)
        if size < _ATTRIBUTE.size:
            break
        found[kind & ATTRIBUTE_KIND] = content[at + _ATTRIBUTE.size : at + size]
        at += size + 3 & ~3
    return found


def _link(body: bytes) -> KernelLink:
    _, hardware, index, flags, _ = _LINK.unpack_from(body)
    said = _attributes(body[_LINK.size :])
    kind = _attributes(said.get(IFLA_LINKINFO, b"")).get(IFLA_INFO_KIND, b"")
    return KernelLink(
        index,
        _text(said.get(IFLA_IFNAME, b"")),
        hardware,
        _text(kind),
        _number(said.get(IFLA_LINK, b"")),
        _number(said.get(IFLA_MASTER, b"")),
        bool(flags & IFF_UP) and said.get(IFLA_CARRIER, b"\1") != b"\0",
    )


def _address(body: bytes) -> tuple[str, int]:
    *_, index = _ADDRESS.unpack_from(body)
    said = _attributes(body[_ADDRESS.size :])
    packed = said.get(IFA_LOCAL, said.get(IFA_ADDRESS, b""))
    family = {4: socket.AF_INET, 16: socket.AF_INET6}.get(len(packed))
    return (socket.inet_ntop(family, packed) if family is not None else ""), index


def _text(content: bytes) -> str:
    return content.split(b"\0")[0].decode(errors="replace")


def _number(content: bytes) -> int:
    return int(struct.unpack("=I", content)[0]) if len(content) == 4 else 0
