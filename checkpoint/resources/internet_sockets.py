"""Sockets of TCP and UDP: listeners, sockets for datagrams with their groups, and those that are not connected yet.

A socket is bound to the same address again. Datagrams that wait come back where their sender's address is this machine's own;
others are lost, as the network may lose them. So are connections that nobody has accepted yet: who asked for one is
reset. Connections of TCP are in ``tcp_connections``.

Facts besides those of every socket: ``state`` of tcp(7), `CLOSED` for UDP; ``address`` and ``peer``: [host, port] or [host,
port, flow, scope], empty if there is none; ``backlog``; ``waiting``: connections not accepted yet; ``sources``: addresses from
which what is in the queue came; ``groups``: a list of [interface, group, filter as MCAST_MSFILTER takes it]; ``shutdown`` of a
socket for datagrams: 1 what it reads, 2 what it sends; ``lost``: something waits in one that is raw or of ICMP; ``failed``: an
error does; ``foreign``: the machine does not have its address (any more).

Source: tcp(7), udp(7), ip(7); linux/in.h for group_filter.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.engine import NOTED, Finding
from checkpoint.linux.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import Opened, OpenFile, Surroundings, elsewhere, sockets
from checkpoint.resources.listings import Group, Listings
from checkpoint.resources.rebuilding import number_of
from checkpoint.resources.unix_makers import Disguise

KIND: Final = "internet_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS, "TCP listeners", "bound and listening again, with their options; connections not accepted yet are reset"
    ),
    preserved(
        Area.SOCKETS,
        "UDP and UDP-Lite sockets",
        "with their groups and options; datagrams from other machines that wait are lost, as the network may lose them",
    ),
    preserved(
        Area.SOCKETS,
        "raw sockets, and those for ICMP echoes",
        "with address, groups, filters and options; what waits in them is lost, as the network may lose it",
    ),
    refused(
        Area.THERE,
        "an address or an interface that a socket is bound to is missing",
        "bind to all addresses (0.0.0.0, ::), or give it to the machine",
        "this machine does not have that address",
        "has joined the group",
    ),
)

FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)
UDPLITE: Final = 136
DATAGRAMS: Final = (socket.IPPROTO_UDP, UDPLITE)
PINGS: Final = (socket.IPPROTO_ICMP, socket.IPPROTO_ICMPV6)

CLOSED: Final = 7
LISTENING: Final = 10
_TCP_INFO: Final = struct.Struct("<B7x4I2I")
MCAST_JOIN_GROUP: Final = 42
MCAST_MSFILTER: Final = 48
IP_FREEBIND: Final = 15
SHUT_DOWN_WHOLE: Final = 3
SO_PEERNAME: Final = 28
EXCLUDE: Final = 0
_FILTER: Final = struct.Struct("<I4x128sII")
"""struct group_filter without its sources: interface, group, mode, number of sources."""
SOURCES_MAX: Final = 64
ADDRESS_SIZE: Final = 128
"""Bytes of struct sockaddr_storage."""

_libc = ctypes.CDLL(None, use_errno=True)


def is_kept(family: int, kind: int, protocol: int) -> bool:
    """Whether a socket of this form is of this kind: TCP, datagrams, echoes of ICMP, or raw."""
    if family not in FAMILIES:
        return False
    if kind == socket.SOCK_DGRAM:
        return protocol in (*DATAGRAMS, *PINGS)
    return kind == socket.SOCK_RAW or protocol == socket.IPPROTO_TCP


def observe(held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None) -> dict[str, Fact]:
    """Its state, its addresses and what waits in it.

    Args:
        noted: see `sockets.queue_of`.

    Raises:
        OSError: it cannot be looked into.
    """
    facts = sockets.general_facts(held, looked, opened)
    state, waiting, backlog = CLOSED, 0, 0
    if looked.proto == socket.IPPROTO_TCP:
        state, *_, waiting, backlog = _TCP_INFO.unpack(looked.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size))
    is_datagram = looked.type != socket.SOCK_STREAM
    may_queue = looked.type == socket.SOCK_DGRAM and looked.proto in DATAGRAMS
    queue = sockets.queue_of(looked, held.first.number, noted) if may_queue else sockets.NOTHING
    return facts | {
        "state": state,
        "address": _bound(looked.getsockname()),
        "peer": _peer(held, looked, opened.listings),
        "backlog": backlog if state == LISTENING else 0,
        "waiting": waiting if state == LISTENING else 0,
        "queue": list(queue.messages),
        "sources": [list(source) for source in queue.sources if isinstance(source, tuple)],
        "groups": list(_groups(looked, opened.listings.groups(held.pid, looked.family))) if is_datagram else [],
        "shutdown": _shutdown(held, looked, opened) if is_datagram else 0,
        "failed": may_queue and bool(sockets.readiness(looked) & select.POLLERR),
        "lost": is_datagram and not may_queue and bool(sockets.readiness(looked)),
    }


def _shutdown(held: OpenFile, looked: socket.socket, opened: Opened) -> int:
    """What of a socket for datagrams was shut down; only poll(2) tells of one that is bound to no port, and not that it sends."""
    poll = select.poll()
    poll.register(looked, select.POLLRDHUP)
    seen = dict(poll.poll(0)).get(looked.fileno(), 0)
    is_listed = looked.proto in DATAGRAMS and looked.getsockname()[1]
    listed = opened.listings.shut_down(int(looked.family), looked.proto) if is_listed else {}
    told = listed.get(held.first.inode, 0)
    return told | (SHUT_DOWN_WHOLE if seen & select.POLLHUP else bool(seen & select.POLLRDHUP))


def _bound(address: Sequence[Fact]) -> list[Fact]:
    """An address that the socket was bound to; empty if it was not."""
    return list(address) if address[1] else []


def in_words(address: Sequence[Fact]) -> str:
    return f"{address[0]!s} port {address[1]!s}"


def _peer(held: OpenFile, looked: socket.socket, listings: Listings) -> list[Fact]:
    """Whom it is, or was, connected with."""
    with contextlib.suppress(OSError):
        return list(looked.getpeername())
    if looked.proto == socket.IPPROTO_TCP:
        with contextlib.suppress(OSError):  # a connection that has ended tells it this way alone
            size = 28 if looked.family == socket.AF_INET6 else 16
            return _unpacked(looked.getsockopt(socket.SOL_SOCKET, SO_PEERNAME, size))
    elif looked.type == socket.SOCK_RAW or looked.proto in PINGS:  # no port, and so no peer for getpeername(2)
        table = "raw" if looked.type == socket.SOCK_RAW else "icmp"
        return listings.peer(held.pid, table, looked.family, held.first.inode)
    return []


def _unpacked(packed: bytes) -> list[Fact]:
    """An address that the kernel wrote."""
    family, port = struct.unpack_from("<H", packed)[0], struct.unpack_from(">H", packed, 2)[0]
    if family == socket.AF_INET:
        return [socket.inet_ntoa(packed[4:8]), port]
    flow, scope = struct.unpack_from(">I", packed, 4)[0], struct.unpack_from("<I", packed, 24)[0]
    return [socket.inet_ntop(socket.AF_INET6, packed[8:24]), port, flow, scope]


def _groups(looked: socket.socket, known: Sequence[Group]) -> Iterator[list[Fact]]:
    """Those of the known multicast groups that a socket has joined."""
    for interface, group in known:
        level = level_of(group)
        packed = bytearray(
            _FILTER.pack(interface, sockaddr([group, 0, 0, 0]), 0, SOURCES_MAX) + bytes(ADDRESS_SIZE * SOURCES_MAX)
        )
        size = ctypes.c_uint32(len(packed))
        buffer = (ctypes.c_char * len(packed)).from_buffer(packed)
        if _libc.getsockopt(looked.fileno(), level, MCAST_MSFILTER, buffer, ctypes.byref(size)) == 0:
            count = _FILTER.unpack_from(packed)[3]
            with contextlib.suppress(OSError):  # the interface has just gone
                yield [socket.if_indextoname(interface), group, bytes(packed[: _FILTER.size + ADDRESS_SIZE * count])]


def level_of(group: str) -> int:
    """By which a multicast group is joined, whatever the socket's family."""
    return socket.IPPROTO_IPV6 if ":" in group else socket.IPPROTO_IP


def sockaddr(address: Sequence[Fact]) -> bytes:
    """An address as bind(2) takes it, 128 bytes."""
    host, port = str(address[0]), number_of(address[1])
    if ":" not in host:
        return struct.pack("<H", socket.AF_INET) + (struct.pack(">H", port) + socket.inet_aton(host)).ljust(126, b"\0")
    scope = number_of(address[3]) if len(address) > 3 else 0
    flow = number_of(address[2]) if len(address) > 2 else 0
    packed = struct.pack(">HI", port, flow) + socket.inet_pton(socket.AF_INET6, host.partition("%")[0])
    return struct.pack("<H", socket.AF_INET6) + (packed + struct.pack("<I", scope)).ljust(126, b"\0")


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The socket as it was observed."""
    if not _is_mine(held):
        return None
    facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed}
    address = held.observed["address"]
    assert isinstance(address, list)
    return Resource(KIND, held.name, facts | {"foreign": bool(address) and not is_ours(address)})


def _is_mine(held: OpenFile) -> bool:
    seen = held.observed
    form = [seen.get(name) for name in ("family", "type", "protocol")]
    return all(isinstance(part, int) for part in form) and is_kept(*map(number_of, form))


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a socket of TCP or UDP cannot be kept."""
    if not _is_mine(held):
        return None
    seen = held.observed
    kinds = {int(socket.SOCK_STREAM): "a TCP socket", int(socket.SOCK_DGRAM): "a UDP socket"}
    name = kinds.get(number_of(seen["type"]), "a raw socket")
    return sockets.refuse_filter(held) or elsewhere.refuse(held, name)


def findings(held: Iterable[Resource]) -> Iterator[Finding]:
    """Connections and datagrams that are lost."""
    for one in held:
        if one.kind == KIND and one.facts.get("failed"):
            text = f"an error, and what else waits in {one.name}, is lost when the program comes back"
            yield Finding(KIND, one.name, NOTED, text)
        if one.kind == KIND and one.facts.get("lost"):
            yield Finding(
                KIND, one.name, NOTED, f"what waits in {one.name}, a raw or ICMP socket, is lost when the program comes back"
            )
        if one.kind == KIND and number_of(one.facts["waiting"]):
            count = number_of(one.facts["waiting"])
            text = f"{count} connections that {one.name} has not accepted yet are reset when the program comes back"
            yield Finding(KIND, one.name, NOTED, text)


def mismatches(held: Resource) -> Iterator[str]:
    """Why its address could not be had here."""
    address = held.facts["address"]
    assert isinstance(address, list)
    may_be_foreign = held.facts.get("foreign") or _has_option(held, socket.IPPROTO_IP, IP_FREEBIND)
    if address and not may_be_foreign and not is_ours(address):
        yield (
            f"{held.name} is bound to {in_words(address)}, and this machine does not have that address: give it to one of its "
            "interfaces, or let the program bind to all (0.0.0.0 or ::)"
        )
    for interface, group, _ in _joined(held):
        if interface not in (name for _, name in socket.if_nameindex()):
            yield f"{held.name} has joined the group {group} at interface {interface}, which is missing here: rename or add it"


def _has_option(held: Resource, level: int, number: int) -> bool:
    return any((its_level, its_number) == (level, number) for its_level, its_number, _ in sockets.options_of(held))


def is_ours(address: Sequence[Fact]) -> bool:
    """Whether a socket can be bound to the address on this machine, at some port."""
    family = socket.AF_INET6 if ":" in str(address[0]) else socket.AF_INET
    if family == socket.AF_INET and socket.inet_aton(str(address[0]))[0] in range(224, 240):
        return True
    with socket.socket(family, socket.SOCK_DGRAM) as tried:
        try:
            tried.bind((str(address[0]), 0, *address[2:]))
        except OSError:
            return False
    return True


def _joined(held: Resource) -> Iterator[tuple[str, str, bytes]]:
    groups = held.facts["groups"]
    assert isinstance(groups, list)
    for one in groups:
        assert isinstance(one, list) and isinstance(one[2], bytes)
        yield str(one[0]), str(one[1]), one[2]


# --- Restore -----------------------------------------------------------------------------------------------------------


def prepare(table: CallTable, held: Sequence[Resource], first: int, disguise: Disguise) -> dict[int, int]:
    """Make all of them at numbers from ``first`` on: the descriptor of each, by the socket's number in the snapshot."""
    made: dict[int, int] = {}
    for one in held:
        if one.facts["type"] == socket.SOCK_DGRAM and one.facts["protocol"] in PINGS:  # the right to that is a group's
            with disguise.as_program(table):
                opened = sockets.make(table, one)
        else:
            opened = sockets.make(table, one)
        place = first + len(made)
        made[number_of(one.facts["socket"])] = place
        table.duplicate(opened, place, os.O_CLOEXEC)
        table.close(opened)
    shared = [made[number_of(one.facts["socket"])] for one in held if _shares_its_port(one, held)]
    for number in shared:
        _allow(table, number, socket.SO_REUSEPORT, 1)
    for one in held:
        _place(table, one, made[number_of(one.facts["socket"])])
    for number in shared:
        _allow(table, number, socket.SO_REUSEPORT, 0)
    for one in held:
        _send_again(table, one, held, made)
    for one in held:
        number, peer = made[number_of(one.facts["socket"])], one.facts["peer"]
        assert isinstance(peer, list)
        if peer:
            what = f"{one.name} is not connected to {in_words(peer)}, where no way leads from here"
            table.attempt(what, "connect", number, table.place(sockaddr(peer)), size_of(peer))
        sockets.shut_down(table, one, number)
        sockets.set_flags(table, one, number)
    return made


def size_of(address: Sequence[Fact]) -> int:
    return 28 if ":" in str(address[0]) else 16


def _shares_its_port(one: Resource, held: Sequence[Resource]) -> bool:
    """Whether another one is bound to the same address, which this one did not mind when it was bound, but would now."""
    if not one.facts["address"] or _has_option(one, socket.SOL_SOCKET, socket.SO_REUSEPORT):
        return False
    return any(other is not one and all(other.facts[fact] == one.facts[fact] for fact in ("address", "type")) for other in held)


def _place(table: CallTable, one: Resource, made: int) -> None:
    """Bind it, let it listen, join its groups."""
    address = one.facts["address"]
    assert isinstance(address, list)
    shares = number_of(one.facts["state"]) == LISTENING and not _has_option(one, socket.SOL_SOCKET, socket.SO_REUSEADDR)
    if shares:  # its port with connections of the program that are there already
        _allow(table, made, socket.SO_REUSEADDR, 1)
    is_free = bool(one.facts.get("foreign")) and not _has_option(one, socket.IPPROTO_IP, IP_FREEBIND)
    if is_free:  # it had the option when it was bound, or the machine had the address
        _allow(table, made, IP_FREEBIND, 1, socket.IPPROTO_IP)
    if address:
        what = f"bind {one.name} to {in_words(address)}"
        table.call(what, "bind", made, table.place(sockaddr(address)), size_of(address))
    if is_free:
        _allow(table, made, IP_FREEBIND, 0, socket.IPPROTO_IP)
    if number_of(one.facts["state"]) == LISTENING:
        table.call(f"listen at {one.name}", "listen", made, number_of(one.facts["backlog"]))
    if shares:
        _allow(table, made, socket.SO_REUSEADDR, 0)
    for interface, group, packed in _joined(one):
        index = socket.if_nametoindex(interface)
        request = struct.pack("<I4x", index) + sockaddr([group, 0, 0, 0])
        what = f"let {one.name} join the group {group} at {interface}"
        table.call(what, "setsockopt", made, level_of(group), MCAST_JOIN_GROUP, table.place(request), len(request))
        _, _, mode, count = _FILTER.unpack_from(packed)
        if mode != EXCLUDE or count:
            request = struct.pack("<I", index) + packed[4:]
            table.call(what, "setsockopt", made, level_of(group), MCAST_MSFILTER, table.place(request), len(request))


def _allow(table: CallTable, made: int, option: int, value: int, level: int = socket.SOL_SOCKET) -> None:
    """Set SO_REUSEADDR, SO_REUSEPORT or IP_FREEBIND for the while that it takes to bind."""
    place = table.place(value.to_bytes(4, "little"))
    table.call("let a socket be bound", "setsockopt", made, level, option, place, 4)


def _send_again(table: CallTable, one: Resource, held: Sequence[Resource], made: Mapping[int, int]) -> None:
    """Send the datagrams that waited, each from the address that it came from, if that is this machine's."""
    messages, sources, address = one.facts["queue"], one.facts["sources"], one.facts["address"]
    assert isinstance(messages, list) and isinstance(sources, list) and isinstance(address, list)
    if not address:
        return
    target = _reachable(address)
    ours = {
        tuple(bound): made[number_of(each.facts["socket"])]
        for each in held
        if isinstance(bound := each.facts["address"], list) and bound
    }
    for message, source in zip(messages, sources, strict=True):
        assert isinstance(message, bytes) and isinstance(source, list)
        sender = ours.get(tuple(source))
        if sender is None and not _is_free(source, number_of(one.facts["protocol"])):
            continue
        lent = sender if sender is not None else _sender(table, one, source)
        arguments = (
            lent,
            table.place(message),
            len(message),
            socket.MSG_DONTWAIT,
            table.place(sockaddr(target)),
            size_of(target),
        )
        table.attempt(f"a datagram that waited in {one.name} is lost", "sendto", *arguments)
        if sender is None:
            table.close(lent)


def _reachable(address: list[Fact]) -> list[Fact]:
    """Where to send to what is bound to an address: itself, if that is all of this machine's."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(str(address[0]), address[0])
    return [host, *address[1:]]


def _is_free(source: Sequence[Fact], protocol: int) -> bool:
    family = socket.AF_INET6 if ":" in str(source[0]) else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM, protocol) as tried:
        try:
            tried.bind(tuple(source))
        except (OSError, OverflowError):
            return False
    return True


def _sender(table: CallTable, one: Resource, source: list[Fact]) -> int:
    family = socket.AF_INET6 if ":" in str(source[0]) else socket.AF_INET
    form = (family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC, number_of(one.facts["protocol"]))
    made = table.obtain(f"make a sender for {one.name}", "socket", *form)
    table.call(f"bind a sender for {one.name}", "bind", made, table.place(sockaddr(source)), size_of(source))
    return made
