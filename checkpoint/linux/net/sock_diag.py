"""Query the kernel about sockets by netlink, and decode its answers. Source: sock_diag(7), netlink(7), rtnetlink(7)."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator
from typing import Final

NETLINK_SOCK_DIAG: Final = 4
SOCK_DIAG_BY_FAMILY: Final = 20
NLM_F_REQUEST: Final = 1
NLM_F_ACK: Final = 4
NLM_F_DUMP: Final = 0x300
NLM_F_DUMP_INTR: Final = 0x10
"""In an answer: the listed objects have changed in the middle of the list."""
TRIES: Final = 5
ROOM: Final = 1 << 18
"""Bytes of one part of a list; the kernel fills 32 KiB at most."""
HEADER: Final = struct.Struct("<IHHII")
_ATTRIBUTE: Final = struct.Struct("<HH")


class UnknownError(OSError):
    """This kernel has no list of such sockets, and has just looked for the module that would make it."""


class ChangedError(OSError):
    """The listed objects changed in the middle of the list, every time."""


def opened() -> socket.socket:
    """A socket through which to ask."""
    return socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG)


def message(request: bytes, order: int = SOCK_DIAG_BY_FAMILY, flags: int = 0) -> bytes:
    """A request with its header."""
    return HEADER.pack(HEADER.size + len(request), order, NLM_F_REQUEST | flags, 1, 0) + request


def listed(request: bytes) -> list[bytes]:
    """Every answer to a request for a list, without its header; a list that was interrupted is asked for again.

    Raises:
        OSError: the kernel does not tell.
        UnknownError: and is not to be asked again.
        ChangedError: no list was whole.
    """
    for _ in range(TRIES):
        answers, is_whole = _list(request)
        if is_whole:
            return answers
    raise ChangedError(errno.EINTR, f"the kernel's list of sockets changed {TRIES} times while it was read")


def _list(request: bytes) -> tuple[list[bytes], bool]:
    """The answers of one list, and whether it is of one instant as far as the kernel can tell."""
    answers: list[bytes] = []
    is_whole = True
    with opened() as asked:
        asked.send(message(request, flags=NLM_F_DUMP))
        while True:
            packed = asked.recv(ROOM)
            place = 0
            while place < len(packed):
                size, kind, flags, *_ = HEADER.unpack_from(packed, place)
                is_whole = is_whole and not flags & NLM_F_DUMP_INTR
                if kind != SOCK_DIAG_BY_FAMILY:  # the list's end, or an error
                    _require_known(packed[place:])
                    return answers, is_whole
                answers.append(packed[place + HEADER.size : place + size])
                place += -(-size // 4) * 4


def _require_known(ending: bytes) -> None:
    if int.from_bytes(ending[HEADER.size : HEADER.size + 4], "little", signed=True) == -errno.ENOENT:
        raise UnknownError(errno.ENOENT, "the kernel has no list of such sockets")


def attributes(packed: bytes) -> Iterator[tuple[int, bytes]]:
    """The attributes of an answer: their number and content."""
    place = 0
    while place + _ATTRIBUTE.size <= len(packed):
        size, kind = _ATTRIBUTE.unpack_from(packed, place)
        if size < _ATTRIBUTE.size:
            return
        yield kind, packed[place + _ATTRIBUTE.size : place + size]
        place += -(-size // 4) * 4
