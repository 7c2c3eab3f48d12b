"""Read the state of unix sockets by netlink: above all their peers, which no other interface reports.

Source: sock_diag(7), linux/unix_diag.h.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
from typing import Final

from msgspec import Struct

from checkpoint.linux.net import sock_diag

SIOCUNIXFILE: Final = 0x89E0
_REQUEST: Final = struct.Struct("<BBHIIIII")
_ANSWER: Final = struct.Struct("<BBBxIII")
_SHOW: Final = 1 | 2 | 4 | 8 | 16
"""Name, file, peer, sockets that wait to be accepted, lengths."""
_NO_COOKIE: Final = 0xFFFFFFFF
_ANY_STATE: Final = 0xFFFFFFFF
_NAME, _FILE, _PEER, _WAITING, _LENGTHS, _SHUTDOWN = 0, 1, 2, 3, 4, 6
_MINOR_BITS: Final = 20
"""Bits of the minor number in a device number of the kernel. Source: linux/kdev_t.h."""

ESTABLISHED: Final = 1
LISTENING: Final = 10


class BoundFile(Struct, frozen=True):
    """The file that a socket was bound to, as any user may ask for it: it has this number still when it has no name.

    Attributes:
        number: the lower 32 bits of its inode's.
        device: of its file system, as stat(2) tells it of most: btrfs and some overlays tell another one.
    """

    number: int
    device: int

    def may_be(self, inode: int) -> bool:
        """Whether an inode of its file system has its number, as far as that is known."""
        return inode & 0xFFFFFFFF == self.number


class UnixSocket(Struct, frozen=True):
    """One unix socket.

    Attributes:
        state: `ESTABLISHED`, `LISTENING`, or 7: neither.
        name: a path, or a zero byte and an abstract name; b"" when it has none.
        peer: inode number of the socket that it is connected to; 0 when there is none (any more).
        backlog: of one that listens.
        clients: whose connections wait to be accepted, in their order: inode numbers of sockets, 0 for one that has gone. The
            kernel tells nothing else of such a connection.
        shutdown: 1 what it reads, 2 what it sends.
        file: that it is bound to, for an accepted one its listener's; None without one.
    """

    type: int
    state: int
    name: bytes
    peer: int
    backlog: int
    clients: tuple[int, ...]
    shutdown: int
    file: BoundFile | None = None


def answer_about(inode: int) -> bytes:
    """The kernel's answer about one unix socket of our network namespace, for `parsed`; b"" where it does not tell."""
    with contextlib.suppress(OSError), sock_diag.opened() as asked:
        asked.send(sock_diag.message(_REQUEST.pack(socket.AF_UNIX, 0, 0, _ANY_STATE, inode, _SHOW, _NO_COOKIE, _NO_COOKIE)))
        packed = asked.recv(1 << 16)
        size, kind, *_ = sock_diag.HEADER.unpack_from(packed)
        if kind == sock_diag.SOCK_DIAG_BY_FAMILY:
            return packed[sock_diag.HEADER.size : size]
    return b""


def answers() -> dict[int, bytes]:
    """The same of all of them, by inode number; none where the kernel does not tell."""
    request = _REQUEST.pack(socket.AF_UNIX, 0, 0, _ANY_STATE, 0, _SHOW, _NO_COOKIE, _NO_COOKIE)
    with contextlib.suppress(OSError):
        return {_ANSWER.unpack_from(answer)[3]: answer for answer in sock_diag.listed(request)}
    return {}


def parsed(answer: bytes) -> UnixSocket | None:
    """The content of an answer; None for none."""
    if not answer:
        return None
    _, socket_type, state, _, _, _ = _ANSWER.unpack_from(answer)
    found = dict(sock_diag.attributes(answer[_ANSWER.size :]))
    lengths = struct.unpack("<II", found[_LENGTHS]) if _LENGTHS in found else (0, 0)
    return UnixSocket(
        type=socket_type,
        state=state,
        name=found.get(_NAME, b""),
        peer=int.from_bytes(found.get(_PEER, b""), "little"),
        backlog=lengths[1] if state == LISTENING else 0,
        clients=tuple(number for (number,) in struct.iter_unpack("<I", found.get(_WAITING, b""))),
        shutdown=int.from_bytes(found.get(_SHUTDOWN, b""), "little"),
        file=_file_of(found.get(_FILE, b"")),
    )


def _file_of(told: bytes) -> BoundFile | None:
    if not told:
        return None
    number, device = struct.unpack("<II", told)
    return BoundFile(number, os.makedev(device >> _MINOR_BITS, device & ((1 << _MINOR_BITS) - 1)))


def bound_file(looked: socket.socket) -> int | None:
    """An O_PATH descriptor for the file that a socket is bound to, also if the file has another name by now.

    Source: unix_open_file() in net/unix/af_unix.c (Linux 4.13); it takes CAP_NET_ADMIN.

    Returns:
        None where it has none, or we may not.
    """
    with contextlib.suppress(OSError):
        return fcntl.ioctl(looked.fileno(), SIOCUNIXFILE)
    return None
