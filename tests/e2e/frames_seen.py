"""Writes down the frames that pass an interface: `python -m tests.e2e.frames_seen INTERFACE SECONDS [both]`.

In the network namespace of the interface; "both": those that leave by it, too.

One line for each part of a frame: ns since 1970 as the kernel stamped it, rank of the sender, medium, round, destination.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Iterator
from typing import Final

from msgspec import Struct

from failover.core.frames.frame import HEADER, MAGIC

ALL_PROTOCOLS: Final = 3
UDP: Final = 17
IPV4: Final = 0x0800
ETHERNET_SIZE: Final = 14
UDP_SIZE: Final = 8
STAMPS: Final = 35
OUTGOING: Final = 4
_STAMP: Final = struct.Struct("@ll")


class Seen(Struct, frozen=True):
    """One part of a frame."""

    at_ns: int
    rank: int
    medium: int
    round: int
    to: str

    @classmethod
    def read(cls, line: str) -> Seen:
        """The inverse of what this program writes."""
        at_ns, rank, medium, round_, to = line.split()
        return cls(int(at_ns), int(rank), int(medium), int(round_), to)


def frames(interface: str, span_s: float, *, both: bool) -> Iterator[Seen]:
    """The parts of frames that the interface gets for so long; ``both``: and sends."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS)) as tap:
        tap.setsockopt(socket.SOL_SOCKET, STAMPS, 1)
        tap.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        tap.bind((interface, ALL_PROTOCOLS))
        tap.settimeout(0.2)
        ends = time.monotonic() + span_s
        while time.monotonic() < ends:
            try:
                packet, ancillary, _, address = tap.recvmsg(2_048, 128)
            except TimeoutError:
                continue
            seen = _frame(packet, ancillary)
            if seen is not None and (both or address[2] != OUTGOING):
                yield seen


def _frame(packet: bytes, ancillary: list[tuple[int, int, bytes]]) -> Seen | None:
    ip = packet[ETHERNET_SIZE:]
    if int.from_bytes(packet[12:14], "big") != IPV4 or len(ip) < 20 or ip[9] != UDP:
        return None
    frame = ip[(ip[0] & 15) * 4 + UDP_SIZE :]
    if not frame.startswith(MAGIC) or len(frame) < HEADER.size:
        return None
    header = HEADER.unpack_from(frame)
    stamp = next(content for level, kind, content in ancillary if (level, kind) == (socket.SOL_SOCKET, STAMPS))
    seconds, ns = _STAMP.unpack_from(stamp)
    return Seen(seconds * 1_000_000_000 + ns, header[3], header[4], header[10], socket.inet_ntoa(ip[16:20]))


if __name__ == "__main__":
    for one in frames(sys.argv[1], float(sys.argv[2]), both=sys.argv[3:] == ["both"]):
        print(one.at_ns, one.rank, one.medium, one.round, one.to, flush=True)
