"""What the kernel tells of unix sockets when it is asked by netlink: their peers above all, which nothing else tells.

Source: sock_diag(7), linux/unix_diag.h.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

NETLINK_SOCK_DIAG: Final = 4
SOCK_DIAG_BY_FAMILY: Final = 20
NLM_F_REQUEST: Final = 1
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
        waiting: how many connections wait to be accepted.
        shutdown: 1 what it reads, 2 what it sends.
    """

    type: int
    state: int
    name: bytes
    peer: int
    backlog: int
    waiting: int
    shutdown: int


def unix_socket(inode: int) -> UnixSocket | None:
    """What a unix socket of our network namespace is; None where the kernel does not tell."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG) as asked:
        request = _REQUEST.pack(socket.AF_UNIX, 0, 0, _ANY_STATE, inode, _SHOW, _NO_COOKIE, _NO_COOKIE)
        asked.send(_HEADER.pack(_HEADER.size + len(request), SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, 1, 0) + request)
        return _parsed(asked.recv(1 << 16))
    return None


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
        waiting=len(found.get(_WAITING, b"")) // 4,
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
