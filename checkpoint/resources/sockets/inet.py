"""Restore sockets of TCP and UDP: listeners, sockets for datagrams with their groups, and unconnected ones.

The restore binds a socket to the same address again. Waiting datagrams are restored where their sender's address is this
machine's own; others are lost, as the network may lose them. Connections that are not accepted yet are lost, too: the client gets
a reset. `checkpoint.resources.sockets.tcp` handles TCP connections.

Facts besides those of every socket: ``state`` of tcp(7), `CLOSED` for UDP; ``address`` and ``peer``: [host, port] or [host, port,
flow, scope], empty if there is none; ``backlog``; ``waiting``: connections not accepted yet; ``sources``: addresses from which
the data in the queue came; ``groups``: a list of [interface, group, filter as MCAST_MSFILTER takes it]; ``shutdown`` of a socket
for datagrams: 1 for reading, 2 for sending; ``lost``: data waits in a raw or ICMP socket; ``failed``: an error waits; ``corks``:
UDP_CORK is set; ``unfinished``: a datagram was begun, and is not sent yet; ``foreign``: the machine does not have its address
(any more).

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
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.kernel_listings import Group, Listings
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import queued_datagrams, sockets
from checkpoint.resources.sockets.inet_addresses import in_words, is_ours, level_of, size_of, sockaddr, unpacked
from checkpoint.resources.sockets.peer_credentials import Disguise
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "internet_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "TCP listeners",
        "bound and listening again, with their options; connections that were not accepted yet are reset",
    ),
    preserved(
        Area.SOCKETS,
        "UDP and UDP-Lite sockets",
        "with their groups and options; datagrams from other machines that wait are lost, as the network may lose them",
    ),
    preserved(
        Area.SOCKETS,
        "raw sockets, and sockets for ICMP echoes",
        "with address, groups, filters and options; packets that wait are lost, as the network may lose them",
    ),
    refused(
        Area.SOCKETS,
        "a UDP socket with an unfinished datagram (UDP_CORK)",
        f"wait: {AS_SOON_AS} the datagram is sent",
        "begun and not sent yet (UDP_CORK)",
    ),
    refused(
        Area.THERE,
        "a missing address or interface to which a socket is bound",
        "bind to all addresses (0.0.0.0, ::), or give the address to the machine",
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
_SEGMENT: Final = 536
"""TCP_MSS_DEFAULT: what a socket tells that has not been connected, and whose program has chosen nothing."""
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


def is_of_tcp(facts: Mapping[str, Fact]) -> bool:
    """Whether this is a socket of TCP: raw ones, and those of other families, may have a protocol of the same number."""
    form = (facts.get("type"), facts.get("protocol"))
    return facts.get("family") in FAMILIES and form == (socket.SOCK_STREAM, socket.IPPROTO_TCP)


def observe(held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None) -> dict[str, Fact]:
    """Its state, its addresses and what waits in it.

    Args:
        noted: see `sockets.queue_of`.

    Raises:
        OSError: it cannot be looked into.
    """
    facts = sockets.general_facts(held, looked, opened)
    state, waiting, backlog = CLOSED, 0, 0
    if is_of_tcp(facts):
        state, _, _, segment, _, waiting, backlog = _TCP_INFO.unpack(
            looked.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
        )
        facts["options"] = [*_list(facts["options"]), *_segment(looked, state, segment)]
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
        "corks": may_queue
        and (corks := any(tuple(option[:2]) == sockets.UDP_CORK for option in map(_list, _list(facts["options"])))),
        "unfinished": may_queue and corks and bool(sockets.unsent(looked)),
        "failed": may_queue and bool(sockets.readiness(looked) & select.POLLERR),
        "lost": is_datagram and not may_queue and bool(sockets.readiness(looked)),
    }


def may_tell_segment(facts: Mapping[str, Fact]) -> bool:
    """Whether a socket of TCP tells the size of segments that its program wants; a connection tells the one that it has."""
    return is_of_tcp(facts) and facts["state"] in (CLOSED, LISTENING)


def _segment(looked: socket.socket, state: int, current: int) -> list[Fact]:
    """TCP_MAXSEG as an option where the program has chosen it.

    Args:
        current: the size in use, 0 of a listener.

    Source: do_tcp_getsockopt() in net/ipv4/tcp.c.
    """
    if state not in (CLOSED, LISTENING):
        return []
    place = (socket.IPPROTO_TCP, socket.TCP_MAXSEG)
    value = looked.getsockopt(*place, 4)
    is_chosen = int.from_bytes(value, "little") != (current or _SEGMENT)
    return [[*place, value]] if is_chosen else []


def _list(fact: Fact) -> list[Fact]:
    assert isinstance(fact, list)
    return fact


def _shutdown(held: OpenFile, looked: socket.socket, opened: Opened) -> int:
    """The directions in which a datagram socket is shut down. Of one without a port only poll(2) tells, and not about sending."""
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


def _peer(held: OpenFile, looked: socket.socket, listings: Listings) -> list[Fact]:
    """The address with which it is, or was, connected."""
    with contextlib.suppress(OSError):
        return list(looked.getpeername())
    if looked.type == socket.SOCK_STREAM:
        with contextlib.suppress(OSError):  # a connection that has ended tells it this way alone
            size = 28 if looked.family == socket.AF_INET6 else 16
            return unpacked(looked.getsockopt(socket.SOL_SOCKET, SO_PEERNAME, size))
    elif looked.type == socket.SOCK_RAW or looked.proto in PINGS:  # no port, and so no peer for getpeername(2)
        table = "raw" if looked.type == socket.SOCK_RAW else "icmp"
        return listings.peer(held.pid, table, looked.family, held.first.inode)
    return []


def _groups(looked: socket.socket, known: Sequence[Group]) -> Iterator[list[Fact]]:
    """The known multicast groups that a socket has joined."""
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
    if seen["unfinished"]:
        return f"{held.name} is a UDP socket with a datagram that was begun and not sent yet (UDP_CORK): {AS_SOON_AS} it is sent"
    return sockets.refuse_filter(held) or other_holders.refuse(held, name)


def findings(held: Iterable[Resource], surroundings: Surroundings) -> Iterator[Finding]:
    """Connections and datagrams that are lost."""
    for one in held:
        if one.kind == KIND and one.facts.get("failed"):
            text = f"an error, and the data that waits in {one.name}, are lost when the program comes back"
            yield Finding(KIND, one.name, NOTED, text)
        if one.kind == KIND and one.facts.get("lost"):
            yield Finding(
                KIND,
                one.name,
                NOTED,
                f"the data that waits in {one.name}, a raw or ICMP socket, is lost when the program comes back",
            )
        if one.kind == KIND and number_of(one.facts["waiting"]):
            count = number_of(one.facts["waiting"])
            text = f"{count} connections that {one.name} has not accepted yet are reset"
            yield sockets.ends(KIND, one.name, text, surroundings)


def mismatches(held: Resource) -> Iterator[str]:
    """Why its address could not be had here."""
    address = held.facts["address"]
    assert isinstance(address, list)
    may_be_foreign = held.facts.get("foreign") or sockets.has_option(held, socket.IPPROTO_IP, IP_FREEBIND)
    if address and not may_be_foreign and not is_ours(address):
        yield (
            f"{held.name} is bound to {in_words(address)}, and this machine does not have that address: give it to one of its "
            "interfaces, or let the program bind to all (0.0.0.0 or ::)"
        )
    for interface, group, _ in _joined(held):
        if interface not in (name for _, name in socket.if_nameindex()):
            yield f"{held.name} has joined the group {group} at interface {interface}, which is missing here: rename or add it"


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
        queued_datagrams.send_again(table, one, held, made)
    for one in held:
        number, peer = made[number_of(one.facts["socket"])], one.facts["peer"]
        assert isinstance(peer, list)
        if peer:
            what = f"{one.name} is not connected to {in_words(peer)}, where no route leads from here"
            table.attempt(what, "connect", number, table.place(sockaddr(peer)), size_of(peer))
        sockets.shut_down(table, one, number)
        sockets.set_flags(table, one, number)
    return made


def _shares_its_port(one: Resource, held: Sequence[Resource]) -> bool:
    """Whether another one is bound to the same address, which this one did not mind when it was bound, but would now."""
    if not one.facts["address"] or sockets.has_option(one, socket.SOL_SOCKET, socket.SO_REUSEPORT):
        return False
    return any(other is not one and all(other.facts[fact] == one.facts[fact] for fact in ("address", "type")) for other in held)


def _place(table: CallTable, one: Resource, made: int) -> None:
    """Bind it, let it listen, join its groups."""
    address = one.facts["address"]
    assert isinstance(address, list)
    shares = number_of(one.facts["state"]) == LISTENING and not sockets.has_option(one, socket.SOL_SOCKET, socket.SO_REUSEADDR)
    if shares:  # its port with connections of the program that are there already
        _allow(table, made, socket.SO_REUSEADDR, 1)
    is_free = bool(one.facts.get("foreign")) and not sockets.has_option(one, socket.IPPROTO_IP, IP_FREEBIND)
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
