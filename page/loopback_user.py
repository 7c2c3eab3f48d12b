"""Whose program is at the other end of a TCP connection on this machine: the kernel tells, and no password is needed.

Source: proc_pid_net(5), the kernel's Documentation/networking/proc_net_tcp.rst: addresses are in the processor's byte order.
"""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from typing import Final

TABLES: Final = {socket.AF_INET: Path("/proc/self/net/tcp"), socket.AF_INET6: Path("/proc/self/net/tcp6")}

LOCAL: Final = 1
REMOTE: Final = 2
STATE: Final = 3
UID: Final = 7
"""Columns of the table."""

ESTABLISHED: Final = "01"
"""The only state in which the row has a user: of a socket that its program has closed the kernel writes user 0."""


def uid_of(client: tuple[str, int], server: tuple[str, int]) -> int | None:
    """The user whose socket it is; None where the connection is not open, or not from this machine.

    Args:
        client, server: address and port of both ends.
    """
    family = socket.AF_INET6 if ":" in client[0] else socket.AF_INET
    try:
        wanted = [_spelled(family, *end) for end in (client, server)]
        lines = TABLES[family].read_text().splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        cells = line.split()
        if [cells[LOCAL], cells[REMOTE]] == wanted and cells[STATE] == ESTABLISHED:
            return int(cells[UID])
    return None


def _spelled(family: socket.AddressFamily, host: str, port: int) -> str:
    """An end of a connection as the kernel's table has it."""
    packed = socket.inet_pton(family, host)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return "".join(f"{word:08X}" for word in words) + f":{port:04X}"
