"""Sends and receives team frames: plain UDP datagrams, one socket per link, never queued behind other traffic.

Nothing here blocks, and no state of the network raises an error: a datagram that cannot leave is a heartbeat that a peer misses,
and heartbeats exist to show exactly that. `failover.core.frames.frame` authenticates them. The kernel drops a datagram that does
not begin as a frame before it takes room in a socket's buffer or wakes this process.
Source: Documentation/networking/filter.rst.
"""

from __future__ import annotations

import array
import contextlib
import ctypes
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from agent.errors import LaneError
from agent.system.rtnetlink import ANCILLARY_SIZE, allow_absent, interface_index, tell_interfaces
from failover.config.team import Robot, for_lookup, split_address
from failover.core.frames.frame import FRAME_SIZE_MAX, MAGIC, MAGIC_BEFORE

FRAME_LIMIT: Final = 1_472
"""Bytes of one datagram: an Ethernet frame's worth, so that no beat is lost with half a fragment."""

TURN_LIMIT: Final = 128
"""Datagrams taken in one turn, so that a flood cannot keep the loop from its own beats."""

RECEIVE_BUFFER: Final = 256 << 10
"""Bytes: two hundred beats may wait while the loop persists nothing and sleeps."""

EXPEDITED: Final = 0xB8
"""IP type of service: DSCP EF, so that switches and the wireless card send beats first. Source: RFC 3246, RFC 8325."""


SO_ATTACH_FILTER: Final = 26
UDP_HEADER_SIZE: Final = 8
"""A filter of a UDP socket sees the datagram from its header on."""

_INSTRUCTION: Final = struct.Struct("=HBBI")
_LOAD_LENGTH, _LOAD_HALF, _IS_ABOVE, _IS_EQUAL, _RETURN = 0x80, 0x28, 0x25, 0x15, 0x06
"""BPF_LD|BPF_W|BPF_LEN, BPF_LD|BPF_H|BPF_ABS, BPF_JMP|BPF_JGT|BPF_K, BPF_JMP|BPF_JEQ|BPF_K, BPF_RET|BPF_K: linux/bpf_common.h."""

SO_MEMINFO: Final = 55
_DROPS: Final = 8
"""Index of SK_MEMINFO_DROPS: what the filter refused, and what found no room. Source: linux/sock_diag.h."""

SO_TIMESTAMPNS: Final = 35
_ARRIVAL: Final = struct.Struct("@ll")
"""Source: socket(7), SO_TIMESTAMP; asm-generic/socket.h; a struct timespec."""

TOLD_MAX: Final = 256
"""Pairs of interface and address of this robot whose names are remembered as the kernel tells them."""


class BeatLane:
    """This robot's beat sockets and everybody's beat addresses."""

    def __init__(self, me: Robot, peers: Mapping[str, Robot]) -> None:
        """Bind one socket to each of this robot's beat addresses; one that no interface has yet works once an interface has it.

        Raises:
            LaneError: an address cannot be had.
        """
        self._sockets = {link.fileno(): link for link in map(_bound, me.beats)}
        self._waiting = select.epoll()
        for fileno in self._sockets:
            self._waiting.register(fileno, select.EPOLLIN)
        self._only = [(fileno, select.EPOLLIN) for fileno in self._sockets] if len(self._sockets) == 1 else []
        self._names: dict[int, str] = {}
        self._told: dict[bytes, str] = {}
        self._ways = {name: _ways(tuple(self._sockets.values()), robot) for name, robot in peers.items()}
        self.unsent = 0

    def fileno(self) -> int:
        """Readable while datagrams wait."""
        return self._waiting.fileno()

    def send(self, peer: str, frame: bytes) -> None:
        """One datagram to the peer over every link."""
        for link, address in self._ways.get(peer, ()):
            try:
                link.sendto(frame, address)
            except OSError:
                self.unsent += 1  # no route, no buffer, link down: the peer's silence is the message

    def receive(self) -> Iterator[tuple[bytes, str, int, tuple[str, int, *tuple[int, ...]]]]:
        """The datagrams that wait, at most `TURN_LIMIT`: each with its interface ("": not told), when it came, and whence.

        Which one the kernel chose is not known by the address: where one link is gone, its packets may come over another. The
        instant is by this machine's calendar, in nanoseconds since 1970; 0: not told.
        """
        taken = 0
        ready = self._only or self._waiting.poll(0)  # this is asked where one waits: of one socket it is clear where
        while ready and taken < TURN_LIMIT:
            for fileno, _ in ready:
                taken += 1
                try:
                    frame, ancillary, _, sender = self._sockets[fileno].recvmsg(FRAME_LIMIT + 1, ANCILLARY_SIZE)
                except OSError:
                    continue  # none, or an ICMP error of an earlier datagram; the next call has the next datagram
                yield frame, *self._circumstances(ancillary), sender
            ready = self._waiting.poll(0)  # to be told that none waits is cheaper than a call that fails

    def dropped(self) -> int:
        """Datagrams that the kernel dropped since these sockets were bound: no beats, or beats without room."""
        return sum(map(_drops, self._sockets.values()))

    def _circumstances(self, ancillary: Iterable[tuple[int, int, bytes]]) -> tuple[str, int]:
        """The interface, and the instant by the calendar."""
        link, wall_ns = "", 0
        for one in ancillary:
            level, kind, content = one
            if kind == SO_TIMESTAMPNS and level == socket.SOL_SOCKET:
                seconds, ns = _ARRIVAL.unpack_from(content)
                wall_ns = seconds * 1_000_000_000 + ns
            elif content in self._told:
                link = self._told[content]
            else:
                link = self._interface(one)
        return link, wall_ns

    def _interface(self, told: tuple[int, int, bytes]) -> str:
        """The name of the interface that the kernel tells; remembered by what it says, and by the interface's number."""
        index = interface_index((told,))
        if index and index not in self._names:
            with contextlib.suppress(OSError):  # it has gone already
                self._names[index] = socket.if_indextoname(index)
        name = self._names.get(index, "")
        if name and len(self._told) < TOLD_MAX:
            self._told[told[2]] = name
        return name

    def close(self) -> None:
        """Close the sockets."""
        self._waiting.close()
        for link in self._sockets.values():
            link.close()


def _bound(address: str) -> socket.socket:
    host, port = split_address(address, "beat address")
    try:
        found = socket.getaddrinfo(for_lookup(host), port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, where = found[0]
        link = socket.socket(family, kind | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, protocol)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        with contextlib.suppress(OSError):
            link.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, EXPEDITED)
        allow_absent(link)
        tell_interfaces(link)
        link.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        with contextlib.suppress(OSError):  # an emulated kernel has no filters; the receiver refuses the same, more dearly
            _let_only_frames_in(link)
        link.bind(where)
    except OSError as error:
        raise LaneError(
            f"cannot listen for beats at {address}: {error.strerror}; is another agent running, or is it another robot's?"
        ) from error
    return link


def _let_only_frames_in(link: socket.socket) -> None:
    """Have the kernel drop what is longer than a part of a frame, or does not begin like one.

    The beats of older releases are let in, so that a robot that sends them counts as one that is not understood.
    """
    program = b"".join(
        _INSTRUCTION.pack(*instruction)
        for instruction in (
            (_LOAD_LENGTH, 0, 0, 0),
            (_IS_ABOVE, 4, 0, UDP_HEADER_SIZE + FRAME_SIZE_MAX),
            (_LOAD_HALF, 0, 0, UDP_HEADER_SIZE),  # of a datagram that has none: dropped
            (_IS_EQUAL, 1, 0, int.from_bytes(MAGIC, "big")),
            (_IS_EQUAL, 0, 1, int.from_bytes(MAGIC_BEFORE, "big")),
            (_RETURN, 0, 0, 0xFFFF_FFFF),
            (_RETURN, 0, 0, 0),
        )
    )
    held = ctypes.create_string_buffer(program, len(program))
    count = len(program) // _INSTRUCTION.size
    link.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("@HP", count, ctypes.addressof(held)))


def _drops(link: socket.socket) -> int:
    counts = array.array("I")
    try:
        counts.frombytes(link.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, counts.itemsize * (_DROPS + 1)))
    except OSError:
        return 0
    return counts[_DROPS] if len(counts) > _DROPS else 0


def _ways(links: Sequence[socket.socket], peer: Robot) -> tuple[tuple[socket.socket, tuple[str, int]], ...]:
    """Link i of ours speaks to address i of theirs; the last link also serves what is left over on the other side."""
    count = max(len(links), len(peer.beats))
    return tuple(
        (links[min(i, len(links) - 1)], split_address(peer.beats[min(i, len(peer.beats) - 1)], "beat address"))
        for i in range(count)
    )
