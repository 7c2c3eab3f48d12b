"""Remove kernel state of ended TCP connections that prevents a connection between the same addresses from being made.

The kernel keeps this state for a minute (TIME_WAIT), or as long as the peer does not answer, for example because the connection
is silent (`checkpoint.linux.net.packet_drop`).

Source: sock_diag(7), linux/inet_diag.h; tcp_diag_destroy() in net/ipv4/tcp_diag.c.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Sequence
from ipaddress import ip_address
from typing import Final

from checkpoint.linux.net import sock_diag
from checkpoint.linux.net.sock_diag import HEADER, SOCK_DIAG_BY_FAMILY

SOCK_DESTROY: Final = 21
TIME_WAIT: Final = 6
_REQUEST: Final = struct.Struct("<BBBxI")
_ENDS: Final = struct.Struct(">HH16s16s")
_REST: Final = struct.Struct("<III")
"""Interface and cookie of struct inet_diag_sockid: any."""
_STATE_AT: Final = HEADER.size + 1
_INODE_AT: Final = HEADER.size + 68
"""idiag_inode: 0 of a socket that no process has open."""
_ANY_STATE: Final = 0xFFFFFFFF
_NO_COOKIE: Final = 0xFFFFFFFF

End = tuple[str, int]
"""Address and port."""


def remove(ends: Sequence[End]) -> None:
    """Have the kernel forget what remains of an ended connection, at both its ends, where we may (CAP_NET_ADMIN).

    A connection that lives is left alone.
    """
    for address, peer in (ends, ends[::-1]):
        with contextlib.suppress(OSError), sock_diag.opened() as asked:
            if _answer(asked, SOCK_DIAG_BY_FAMILY, address, peer)[_STATE_AT : _STATE_AT + 1] == bytes([TIME_WAIT]):
                _answer(asked, SOCK_DESTROY, address, peer)


def remove_orphan(ends: Sequence[End]) -> None:
    """Have the kernel forget our end of a connection that no process has open any more, in any state (CAP_NET_ADMIN).

    The kernel may want to reset the peer's: the connection is silent.
    """
    address, peer = ends
    with contextlib.suppress(OSError), sock_diag.opened() as asked:
        told = _answer(asked, SOCK_DIAG_BY_FAMILY, address, peer)
        if told[_INODE_AT : _INODE_AT + 4] == bytes(4):
            _answer(asked, SOCK_DESTROY, address, peer)


def _answer(asked: socket.socket, order: int, address: End, peer: End) -> bytes:
    """The kernel's answer about one connection: a struct inet_diag_msg, or b"" for an error or a mere acknowledgement."""
    hosts = [ip_address(end[0].partition("%")[0]) for end in (address, peer)]
    family = socket.AF_INET if hosts[0].version == 4 else socket.AF_INET6
    request = _REQUEST.pack(family, socket.IPPROTO_TCP, 0, _ANY_STATE)
    request += _ENDS.pack(address[1], peer[1], *(host.packed.ljust(16, b"\0") for host in hosts))
    request += _REST.pack(0, _NO_COOKIE, _NO_COOKIE)
    asked.send(sock_diag.message(request, order, sock_diag.NLM_F_ACK if order == SOCK_DESTROY else 0))
    told = asked.recv(1 << 16)
    return told if HEADER.unpack_from(told)[1] == SOCK_DIAG_BY_FAMILY else b""
