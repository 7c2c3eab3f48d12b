"""Read the state of UDP sockets by netlink: it alone tells which directions were shut down.

Source: sock_diag(7), linux/inet_diag.h; inet_sk_diag_fill() in net/ipv4/inet_diag.c.
"""

from __future__ import annotations

import struct
from typing import Final

from checkpoint.errors import CaptureError
from checkpoint.linux.net import sock_diag

_REQUEST: Final = struct.Struct("<BBBxI48x")
"""Family, protocol, extensions, states; any socket."""
_ANSWER_SIZE: Final = 72
_INODE_AT: Final = 68
_ANY_STATE: Final = 0xFFFFFFFF
_SHUTDOWN: Final = 8
_WITHOUT: Final[set[tuple[int, int]]] = set()
"""Kinds that this kernel does not tell of: each further question would make it look for a module (request_module), for ms."""


def shut_down(family: int, protocol: int) -> dict[int, int]:
    """Sockets of a protocol, of our network namespace, that were shut down: 1 what they read, 2 what they send, by inode number.

    Those that are bound to no port are not listed; nor is any where the kernel does not tell (CONFIG_INET_UDP_DIAG).

    Raises:
        CaptureError: the list changed each time while it was read.
    """
    found: dict[int, int] = {}
    if (family, protocol) in _WITHOUT:
        return found
    try:
        for answer in sock_diag.listed(_REQUEST.pack(family, protocol, 0, _ANY_STATE)):
            if how := int.from_bytes(dict(sock_diag.attributes(answer[_ANSWER_SIZE:])).get(_SHUTDOWN, b""), "little"):
                found[int.from_bytes(answer[_INODE_AT : _INODE_AT + 4], "little")] = how
    except sock_diag.UnknownError:
        _WITHOUT.add((family, protocol))
    except sock_diag.ChangedError as error:
        raise CaptureError(f"cannot tell which sockets were shut down: {error.strerror}; capture it again") from error
    except OSError:
        return {}
    return found
