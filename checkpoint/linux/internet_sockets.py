"""What the kernel tells of sockets of UDP when it is asked by netlink: which were shut down, which nothing else tells.

Source: sock_diag(7), linux/inet_diag.h; inet_sk_diag_fill() in net/ipv4/inet_diag.c.
"""

from __future__ import annotations

import errno
import socket
import struct
from typing import Final

from checkpoint.linux.unix_sockets import (
    NETLINK_SOCK_DIAG,
    NLM_F_DUMP,
    NLM_F_REQUEST,
    SOCK_DIAG_BY_FAMILY,
    answers,
    attributes,
)

_HEADER: Final = struct.Struct("<IHHII")
_REQUEST: Final = struct.Struct("<BBBxI48x")
"""Family, protocol, extensions, states; any socket."""
_ANSWER_SIZE: Final = 72
_INODE_AT: Final = 68
_ANY_STATE: Final = 0xFFFFFFFF
_SHUTDOWN: Final = 8
_WITHOUT: Final[set[tuple[int, int]]] = set()
"""What this kernel does not tell of: asked again it would look for the module each time (request_module), for milliseconds."""


def shut_down(family: int, protocol: int) -> dict[int, int]:
    """Sockets of a protocol, of our network namespace, that were shut down: 1 what they read, 2 what they send, by inode number.

    Those that are bound to no port are not listed; nor is any where the kernel does not tell (CONFIG_INET_UDP_DIAG).
    """
    found: dict[int, int] = {}
    if (family, protocol) in _WITHOUT:
        return found
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG) as asked:
            request = _REQUEST.pack(family, protocol, 0, _ANY_STATE)
            size = _HEADER.size + len(request)
            asked.send(_HEADER.pack(size, SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST | NLM_F_DUMP, 1, 0) + request)
            if _is_unknown(asked.recv(_HEADER.size + 4, socket.MSG_PEEK)):
                _WITHOUT.add((family, protocol))
            for answer in answers(asked):
                if how := int.from_bytes(dict(attributes(answer[_ANSWER_SIZE:])).get(_SHUTDOWN, b""), "little"):
                    found[int.from_bytes(answer[_INODE_AT : _INODE_AT + 4], "little")] = how
    except OSError:
        return {}
    return found


def _is_unknown(answer: bytes) -> bool:
    """Whether an answer begins with the end of a list, and that with the word that there is none."""
    _, kind, *_ = _HEADER.unpack_from(answer)
    return kind != SOCK_DIAG_BY_FAMILY and int.from_bytes(answer[_HEADER.size :], "little", signed=True) == -errno.ENOENT
