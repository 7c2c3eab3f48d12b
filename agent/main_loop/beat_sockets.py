"""Sends and receives team frames: plain UDP datagrams, one socket per link, never queued behind other traffic.

Frames to one robot leave by the socket of a link and arrive at such a socket. Frames that are cast leave by it, too; they arrive
at one socket for the team's multicast group and one for broadcasts, for each port that this robot listens at.

Nothing here blocks, and no state of the network raises an error: a datagram that cannot leave is a heartbeat that a peer misses,
and heartbeats exist to show exactly that. `failover.core.frames.frame` authenticates them. The kernel drops a datagram that does
not begin as a frame before it takes room in a socket's buffer or wakes this process.
Source: Documentation/networking/filter.rst.
"""

from __future__ import annotations

import array
import contextlib
import ctypes
import errno
import select
import socket
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from agent.errors import LaneError
from agent.system.rtnetlink import ANCILLARY_SIZE, allow_absent, interface_index, tell_interfaces
from failover.config.team import Robot, for_lookup, split_address
from failover.core.frames.frame import FRAME_SIZE_MAX, MAGIC, MAGIC_BEFORE
from failover.core.frames.media import Cast
from failover.core.wire.codec import team_tag

FRAME_LIMIT: Final = 1_472
"""Bytes of one datagram: an Ethernet frame's worth, so that no beat is lost with half a fragment."""

TURN_LIMIT: Final = 128
"""Datagrams taken in one turn, so that a flood cannot keep the loop from its own beats."""

RECEIVE_BUFFER: Final = 256 << 10
"""Bytes: two hundred beats may wait while the loop persists nothing and sleeps."""

EXPEDITED: Final = 0xB8
"""IP type of service: DSCP EF, so that switches and the wireless card send beats first. Source: RFC 3246, RFC 8325."""


IP_MULTICAST_ALL: Final = 49
"""Off: a group's datagrams come by the interfaces that this socket joined it at, and no others. Source: ip(7)."""

BROADCAST: Final = "255.255.255.255"
"""Leaves by the interface of the address that the sending socket is bound to. Source: ip_route_output_key_hash_rcu in Linux."""

ALREADY_JOINED: Final = errno.EADDRINUSE

REFUSALS: Final = frozenset({errno.EPERM, errno.EACCES, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOPROTOOPT})
"""What tells that this kind of datagram may not leave, as against a link that is down."""

_MEMBERSHIP: Final = struct.Struct("=4s4si")
"""struct ip_mreqn: group, any address, index of the interface."""

_NETWORK_HEADER: Final = 0x1_0000_0000 - 0x10_0000
"""SKF_NET_OFF: from here on a filter counts from the IP header, whose byte 12 begins the sender's address: linux/filter.h."""

_SENDER_AT: Final = _NETWORK_HEADER + 12

NOT_CAST: Final = -1

SO_ATTACH_FILTER: Final = 26
UDP_HEADER_SIZE: Final = 8
"""A filter of a UDP socket sees the datagram from its header on."""

_INSTRUCTION: Final = struct.Struct("=HBBI")
_LOAD_LENGTH, _LOAD_HALF, _LOAD_WORD, _IS_ABOVE, _IS_EQUAL, _RETURN = 0x80, 0x28, 0x20, 0x25, 0x15, 0x06
"""BPF_LD|BPF_W|BPF_LEN, BPF_LD|BPF_H|BPF_ABS, BPF_LD|BPF_W|BPF_ABS, BPF_JMP|BPF_JGT|BPF_K, BPF_JMP|BPF_JEQ|BPF_K,
BPF_RET|BPF_K: linux/bpf_common.h."""

SO_MEMINFO: Final = 55
_DROPS: Final = 8
"""Index of SK_MEMINFO_DROPS: what the filter refused, and what found no room. Source: linux/sock_diag.h."""

SO_TIMESTAMPNS: Final = 35
_ARRIVAL: Final = struct.Struct("@ll")
"""Source: socket(7), SO_TIMESTAMP; asm-generic/socket.h; a struct timespec."""

TOLD_MAX: Final = 256
"""Pairs of interface and address of this robot whose names are remembered as the kernel tells them."""


class BeatLane:
    """This robot's beat sockets and everybody's beat addresses. Its links are numbered as its beat addresses: their *places*.

    Attributes:
        unsent: datagrams that could not leave.
    """

    def __init__(self, me: Robot, peers: Mapping[str, Robot], team: str = "") -> None:
        """Bind one socket to each of this robot's beat addresses; one that no interface has yet works once an interface has it.

        Raises:
            LaneError: an address cannot be had.
        """
        self._links = tuple(map(_bound, me.beats))
        self._sockets = {link.fileno(): link for link in self._links}
        self._waiting = select.epoll()
        for fileno in self._sockets:
            self._waiting.register(fileno, select.EPOLLIN)
        self._likely = min(self._sockets)
        self._names: dict[int, str] = {}
        self._told: dict[bytes, str] = {}
        self.know(peers)
        self._group = group_of(team)
        self._ports = tuple(int(link.getsockname()[1]) for link in self._links)
        self._collecting: dict[tuple[Cast, int], socket.socket] = {}
        self._collects: set[int] = set()
        self._uncounted: set[int] = set()
        self._casts: dict[str, int] = {}
        self._joined: dict[int, int] = {}
        self.unsent = 0

    def know(self, peers: Mapping[str, Robot]) -> None:
        """From now on these are the others."""
        self._ways = {name: _ways(self._links, robot) for name, robot in peers.items()}

    def fileno(self) -> int:
        """Readable while datagrams wait."""
        return self._waiting.fileno()

    def unicast(self, peer: str, place: int, datagrams: Sequence[bytes]) -> None:
        """Datagrams to the peer over one link."""
        for at, link, address, _ in self._ways.get(peer, ()):
            if at == place:
                for datagram in datagrams:
                    try:
                        link.sendto(datagram, address)
                    except OSError:
                        self.unsent += 1  # no route, no buffer, link down: the peer's silence is the message

    def ways(self, peer: str) -> tuple[tuple[int, int], ...]:
        """(our link, its link) of each way to the peer."""
        return tuple((place, theirs) for place, _, _, theirs in self._ways.get(peer, ()))

    # --- Casting ---

    def reached(self, place: int) -> tuple[str, ...]:
        """The members that could hear what is cast over this link: they listen at its port, over IPv4."""
        if self._links[place].family != socket.AF_INET:
            return ()
        port = self._ports[place]
        return tuple(
            name
            for name, ways in self._ways.items()
            if any(at == place and address[1] == port and _is_ipv4(address[0]) for at, _, address, _ in ways)
        )

    def open_to_casts(self, place: int, index: int) -> str:
        """Let what is cast at that interface come, and set the link up to cast; "" or why that cannot be.

        May be called again: an interface that went and came back is another one.
        """
        link, port = self._links[place], self._ports[place]
        everywhere = bytes(4)
        try:
            for cast, host in ((Cast.MULTICAST, self._group), (Cast.BROADCAST, BROADCAST)):
                if (cast, port) not in self._collecting:
                    self._collect(cast, host, port)
            self._join(self._collecting[Cast.MULTICAST, port], place, index)
            link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _MEMBERSHIP.pack(everywhere, everywhere, index))
            link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._casts[socket.if_indextoname(index)] = place
        except OSError as error:
            return f"the kernel refused to open the link to multicast: {error.strerror}"
        return ""

    def _join(self, collecting: socket.socket, place: int, index: int) -> None:
        """Join the group at that interface; leave it at the one that the link had before: a socket may be in 20 groups.

        Source: /proc/sys/net/ipv4/igmp_max_memberships; an interface that has gone is still known by its number to be left.
        """
        group, everywhere = socket.inet_aton(self._group), bytes(4)
        before = self._joined.pop(place, index)
        if before != index and before not in self._joined.values():
            with contextlib.suppress(OSError):
                collecting.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, _MEMBERSHIP.pack(group, everywhere, before))
        try:
            collecting.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, _MEMBERSHIP.pack(group, everywhere, index))
        except OSError as error:
            if error.errno != ALREADY_JOINED:
                raise
        self._joined[place] = index

    def _collect(self, cast: Cast, host: str, port: int) -> None:
        """Open the socket at which this kind of datagram comes. What this robot cast itself is dropped by the kernel."""
        collecting = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            collecting.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            collecting.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # other agents of this machine hear the same
            collecting.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
            tell_interfaces(collecting)
            collecting.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            ours = [link.getsockname()[0] for link in self._links if link.family == socket.AF_INET]
            with contextlib.suppress(OSError):
                _let_only_frames_in(collecting, ours)
            collecting.bind((host, port))
        except OSError:
            collecting.close()
            raise
        self._collecting[cast, port] = self._sockets[collecting.fileno()] = collecting
        self._collects.add(collecting.fileno())
        if cast is Cast.BROADCAST:
            self._uncounted.add(collecting.fileno())  # each of our own broadcasts comes back, and is dropped
        self._waiting.register(collecting.fileno(), select.EPOLLIN)

    def cast(self, place: int, cast: Cast, datagrams: Sequence[bytes]) -> str:
        """Datagrams to all over one link; "", or why this kind may not leave by it."""
        link, address = self._links[place], (self._group if cast is Cast.MULTICAST else BROADCAST, self._ports[place])
        for datagram in datagrams:
            try:
                link.sendto(datagram, address)
            except OSError as error:
                self.unsent += 1
                if error.errno in REFUSALS:
                    return f"the kernel refused a {cast}: {error.strerror}"
        return ""

    def receive(self) -> Iterator[tuple[bytes, str, int, tuple[str, int, *tuple[int, ...]], int]]:
        """The datagrams that wait, at most `TURN_LIMIT`: each with its interface ("": not told), when it came, and whence.

        The last is the place of the link by which it came, if it was cast; else `NOT_CAST`.

        Which one the kernel chose is not known by the address: where one link is gone, its packets may come over another. The
        instant is by this machine's calendar, in nanoseconds since 1970; 0: not told.
        """
        taken, told, guess = 0, self._told, 1
        ready = [(self._likely, select.EPOLLIN)]  # this is asked where one waits, and one knows nearly always where
        while ready and taken < TURN_LIMIT:
            for fileno, _ in ready[: TURN_LIMIT - taken]:
                taken += 1
                try:
                    frame, ancillary, _, sender = self._sockets[fileno].recvmsg(FRAME_LIMIT + 1, ANCILLARY_SIZE)
                except OSError:
                    taken, guess = taken - guess, 0  # a wrong guess is no datagram
                    continue  # none, or an ICMP error of an earlier datagram; the next call has the next datagram
                self._likely = fileno
                link, wall_ns = "", 0
                for one in ancillary:
                    level, kind, content = one
                    if kind == SO_TIMESTAMPNS and level == socket.SOL_SOCKET:
                        seconds, ns = _ARRIVAL.unpack_from(content)
                        wall_ns = seconds * 1_000_000_000 + ns
                    else:
                        link = told[content] if content in told else self._interface(one)
                place = self._casts.get(link, NOT_CAST) if fileno in self._collects else NOT_CAST
                yield frame, link, wall_ns, sender, place
            ready = self._waiting.poll(0)  # to be told that none waits is cheaper than a call that fails

    def dropped(self) -> int:
        """Datagrams that the kernel dropped since these sockets were bound: no beats, or beats without room; broadcasts apart."""
        return sum(_drops(link) for fileno, link in self._sockets.items() if fileno not in self._uncounted)

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


def group_of(team: str) -> str:
    """The multicast group of a team: two teams on one network seldom share one, and frames of another team are refused anyway.

    Source: RFC 2365 (239.0.0.0/8 is for use inside of an organisation).
    """
    first, second = team_tag(team)[:2]
    return f"239.77.{first}.{second}"


def _is_ipv4(host: str) -> bool:
    try:
        socket.inet_pton(socket.AF_INET, host)
    except OSError:
        return False
    return True


def _let_only_frames_in(link: socket.socket, ours: Sequence[str] = ()) -> None:
    """Have the kernel drop what is longer than a part of a frame, or does not begin like one, or comes from an address of ours.

    The beats of older releases are let in, so that a robot that sends them counts as one that is not understood.
    """
    own = [int.from_bytes(socket.inet_aton(host), "big") for host in ours]
    to_refusal = range(len(own), 0, -1)  # from each comparison with one of them to the last instruction, over six others
    program = b"".join(
        _INSTRUCTION.pack(*instruction)
        for instruction in (
            *([(_LOAD_WORD, 0, 0, _SENDER_AT)] if own else []),
            *[(_IS_EQUAL, 5 + away, 0, host) for away, host in zip(to_refusal, own, strict=True)],
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


def _ways(links: Sequence[socket.socket], peer: Robot) -> tuple[tuple[int, socket.socket, tuple[str, int], int], ...]:
    """(place, link, address, place of the address): link i of ours speaks to address i of theirs.

    The last link also serves what is left over on the other side.
    """
    count = max(len(links), len(peer.beats))
    ours, theirs = len(links) - 1, len(peer.beats) - 1
    return tuple(
        (min(i, ours), links[min(i, ours)], split_address(peer.beats[min(i, theirs)], "beat address"), min(i, theirs))
        for i in range(count)
    )
