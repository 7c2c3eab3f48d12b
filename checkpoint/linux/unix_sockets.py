"""What the kernel tells of unix sockets when it is asked by netlink: their peers above all, which nothing else tells.

Source: sock_diag(7), linux/unix_diag.h.
"""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

NETLINK_SOCK_DIAG: Final = 4
SOCK_DIAG_BY_FAMILY: Final = 20
NLM_F_REQUEST: Final = 1
NLM_F_DUMP: Final = 0x300
ROOM: Final = 1 << 18
"""Bytes of one part of a list; the kernel fills 32 KiB at most."""
SIOCUNIXFILE: Final = 0x89E0
_HEADER: Final = struct.Struct("<IHHII")
_REQUEST: Final = struct.Struct("<BBHIIIII")
_ANSWER: Final = struct.Struct("<BBBxIII")
_ATTRIBUTE: Final = struct.Struct("<HH")
_SHOW: Final = 1 | 4 | 8 | 16
"""Name, peer, who waits to be accepted, lengths."""
_NO_COOKIE: Final = 0xFFFFFFFF
_ANY_STATE: Final = 0xFFFFFFFF
_NAME, _PEER, _WAITING, _LENGTHS, _SHUTDOWN = 0, 2, 3, 4, 6

ESTABLISHED: Final = 1
CLOSED: Final = 7
LISTENING: Final = 10


@dataclass(frozen=True, slots=True)
class UnixSocket:
    """One unix socket.

    Attributes:
        state: `ESTABLISHED`, `CLOSED` or `LISTENING`.
        name: a path, or a zero byte and an abstract name; b"" when it has none.
        peer: inode number of the socket that it is connected to; 0 when there is none (any more).
        backlog: of one that listens.
        clients: whose connections wait to be accepted, in their order: inode numbers of sockets, 0 for one that has gone. The
            kernel tells nothing else of such a connection.
        shutdown: 1 what it reads, 2 what it sends.
    """

    type: int
    state: int
    name: bytes
    peer: int
    backlog: int
    clients: tuple[int, ...]
    shutdown: int


def unix_socket(inode: int) -> UnixSocket | None:
    """What a unix socket of our network namespace is; None where the kernel does not tell."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG) as asked:
        request = _REQUEST.pack(socket.AF_UNIX, 0, 0, _ANY_STATE, inode, _SHOW, _NO_COOKIE, _NO_COOKIE)
        asked.send(_HEADER.pack(_HEADER.size + len(request), SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, 1, 0) + request)
        return _parsed(asked.recv(1 << 16))
    return None


def answers(asked: socket.socket) -> Iterator[bytes]:
    """Every message of a list that was asked for, without its header."""
    while True:
        packed = asked.recv(ROOM)
        while packed:
            size, kind, *_ = _HEADER.unpack_from(packed)
            if kind != SOCK_DIAG_BY_FAMILY:  # the list's end, or an error
                return
            yield packed[_HEADER.size : size]
            packed = packed[-(-size // 4) * 4 :]


def _parsed(answer: bytes) -> UnixSocket | None:
    size, kind, *_ = _HEADER.unpack_from(answer)
    if kind != SOCK_DIAG_BY_FAMILY:
        return None
    _, socket_type, state, _, _, _ = _ANSWER.unpack_from(answer, _HEADER.size)
    found = dict(attributes(answer[_HEADER.size + _ANSWER.size : size]))
    lengths = struct.unpack("<II", found[_LENGTHS]) if _LENGTHS in found else (0, 0)
    return UnixSocket(
        type=socket_type,
        state=state,
        name=found.get(_NAME, b""),
        peer=int.from_bytes(found.get(_PEER, b""), "little"),
        backlog=lengths[1] if state == LISTENING else 0,
        clients=tuple(number for (number,) in struct.iter_unpack("<I", found.get(_WAITING, b""))),
        shutdown=int.from_bytes(found.get(_SHUTDOWN, b""), "little"),
    )


def attributes(packed: bytes) -> Iterator[tuple[int, bytes]]:
    """The attributes of an answer: their number and content. Source: netlink(7), rtnetlink(7)."""
    place = 0
    while place + _ATTRIBUTE.size <= len(packed):
        size, kind = _ATTRIBUTE.unpack_from(packed, place)
        if size < _ATTRIBUTE.size:
            return
        yield kind, packed[place + _ATTRIBUTE.size : place + size]
        place += -(-size // 4) * 4


def bound_file(looked: socket.socket) -> int | None:
    """An O_PATH descriptor for the file that a socket is bound to, whatever name that has by now.

    Source: unix_open_file() in net/unix/af_unix.c (Linux 4.13); it takes CAP_NET_ADMIN.

    Returns:
        None where it has none, or we may not.
    """
    with contextlib.suppress(OSError):
        return fcntl.ioctl(looked.fileno(), SIOCUNIXFILE)
    return None
