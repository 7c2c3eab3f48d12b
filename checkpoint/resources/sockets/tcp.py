"""Restore TCP connections: those between the program's own sockets; every other one ends, and the program sees a reset.

The other end of a connection to another program has continued since the capture. It has received data, or has sent some, that the
restored program does not know. So the program finds the same as after a crash of its peer: ECONNRESET, EPOLLHUP and EPOLLERR;
data that waited to be read is gone. Where the peer had ended its side and all of it was read, the program reads the end of file
again. A connection that was being opened (SYN_SENT) is opened anew.

A connection with both ends in the program is made again between the same addresses, where those are available, with the data that
waits at both ends. It is made like any other, without TCP_REPAIR: this needs no right, and no capture can leave a socket in
repair.

With the operator's permission a program takes connections along when it moves: `checkpoint.resources.sockets.tcp_handover`. Facts
of such connections are `TAKEN`, `LEFT` and `MAY_MOVE`.

Facts besides those of `checkpoint.resources.sockets.inet`: ``local``: both addresses are one machine's; ``queue``: data that
waits to be read in a local one, one message; ``unread``: bytes that wait; ``urgent``: an out-of-band byte waits; ``encrypted``:
the kernel encrypts; ``deaf``: its program wants to read no more of it; ``sent`` and ``received``: bytes that went over it;
``unsent``: bytes still to be sent; ``ends``: the state of its end that poll(2) reports, `READ_ENDED` and `FAILED`.

Source: tcp(7), tcp_ioctl() and tcp_poll() in net/ipv4/tcp.c; linux/tcp.h for struct tcp_info.
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import termios
from collections.abc import Iterable, Iterator, Mapping, Sequence
from ipaddress import ip_address
from typing import Final

from checkpoint.capability import Area, by_rule, preserved, refused
from checkpoint.engine import GOES_ALONG, NOTED, REFUSED, RESET_NOTE, Finding
from checkpoint.linux.net import tcp_repair, time_wait
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.kernel_listings import Listings
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import inet, sockets
from checkpoint.resources.sockets.inet import CLOSED, LISTENING
from checkpoint.resources.sockets.inet_addresses import in_words, is_ours, size_of, sockaddr
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "tcp_connections"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "TCP connections of the program with itself",
        "with the data in them, between the same addresses, if their ports are free",
        "the TCP connection",
    ),
    by_rule(
        Area.SOCKETS,
        "TCP connections with others",
        "reset: the program sees the same as after a crash of its peer (ECONNRESET, EPOLLHUP, EPOLLERR). After an "
        "end of file it reads the end of file again; a connection that it is just opening is opened anew",
        "If they are not opened anew",
    ),
    refused(
        Area.SOCKETS,
        "a TCP connection of the program with itself that is full",
        f"wait: {AS_SOON_AS} the data has arrived, or was read",
        "have not arrived at its other end",
        "in which more than {} MiB wait",
        "in which an out-of-band byte waits (MSG_OOB)",
    ),
    refused(
        Area.SOCKETS,
        "a TCP connection of the program with itself that the kernel encrypts (kTLS)",
        "let the program's library encrypt it",
        "which the kernel encrypts (TCP_ULP)",
    ),
)

ESTABLISHED: Final = 1
SYN_SENT: Final = 2
FIN_WAIT_1: Final = 4
FIN_WAIT_2: Final = 5
CLOSE_WAIT: Final = 8
LAST_ACK: Final = 9
CLOSING: Final = 11
_WE_ENDED: Final = (CLOSED, FIN_WAIT_1, FIN_WAIT_2, LAST_ACK, CLOSING)
_PEER_SPEAKS: Final = (ESTABLISHED, FIN_WAIT_1, FIN_WAIT_2)
_PEER_ENDED: Final = (CLOSE_WAIT, LAST_ACK, CLOSING)

PEERS_TOLD: Final = 3
"""Peers that one sentence names, of those whose connections are reset."""

TAKEN: Final = "carried"
"""All facts of a connection that another machine needs to take it up."""
MAY_MOVE: Final = "may_move"
"""Present of one that is taken along where the program is handed over."""
LEFT: Final = "left"
"""Why one is not taken along that was to be."""

ON_ITS_WAY: Final = "it was on its way in a unix socket; once received, it is taken along"
"""Reason about a connection that a message carries (SCM_RIGHTS), and that the program has no descriptor of."""

READ_ENDED: Final = 1
FAILED: Final = 2

_TCP_INFO_SIZE: Final = 216
_RECEIVED: Final = struct.Struct("<Q")
_RECEIVED_AT: Final = 128
_UNSENT_AT: Final = 144
_SENT_AT: Final = 200
"""tcpi_bytes_received; tcpi_notsent_bytes; tcpi_bytes_sent and tcpi_bytes_retrans (Linux 4.19)."""

_RESET_AT_CLOSE: Final = struct.pack("<ii", 1, 0)
"""SO_LINGER: no time is left for bytes that are underway, so the connection is reset."""
_ROOM: Final = 1 << 16


def observe(held: OpenFile, looked: socket.socket, facts: Mapping[str, Fact], listings: Listings) -> dict[str, Fact]:
    """The other facts of a TCP socket that is neither fresh nor listens.

    Args:
        facts: as `inet.observe` found them.

    Raises:
        OSError: it cannot be looked into.
    """
    told = looked.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_SIZE)
    peer = facts["peer"]
    if facts["state"] == SYN_SENT:  # which getpeername(2) does not tell yet
        peer = listings.peer(held.pid, "tcp", looked.family, held.first.inode)
    is_local = _is_local(facts["address"], peer)
    unread = (
        int.from_bytes(fcntl.ioctl(looked.fileno(), termios.FIONREAD, bytes(4)), "little") if facts["state"] != SYN_SENT else 0
    )
    sent, again = struct.unpack_from("<QQ", told.ljust(_TCP_INFO_SIZE, b"\0"), _SENT_AT)
    return {
        "peer": peer,
        "local": is_local,
        "queue": [_peek(looked, unread)] if is_local and 0 < unread <= sockets.QUEUE_LIMIT else [],
        "unread": unread,
        "deaf": facts["state"] in _PEER_SPEAKS and bool(ends_of(looked) & READ_ENDED),
        "urgent": is_local and bool(sockets.readiness(looked) & select.POLLPRI),
        "encrypted": is_local and tcp_repair.is_encrypted(looked),
        "sent": sent - again,
        "received": _RECEIVED.unpack_from(told, _RECEIVED_AT)[0],
        "unsent": int.from_bytes(told[_UNSENT_AT : _UNSENT_AT + 4], "little"),
    }


def ends_of(looked: socket.socket) -> int:
    """Whether nothing more can be read, and whether an error waits to be told: neither is used up by being asked for."""
    poll = select.poll()
    poll.register(looked, select.POLLRDHUP)
    found = dict(poll.poll(0)).get(looked.fileno(), 0)
    return bool(found & select.POLLRDHUP) * READ_ENDED | bool(found & select.POLLERR) * FAILED


def _is_local(address: Fact, peer: Fact) -> bool:
    """Whether both ends are this machine's as far as the addresses alone tell, which mean the same on every machine."""
    if not (isinstance(address, list) and isinstance(peer, list) and address and peer):
        return False
    hosts = [str(end[0]).partition("%")[0] for end in (address, peer)]
    return hosts[0] == hosts[1] or all(ip_address(host.removeprefix("::ffff:")).is_loopback for host in hosts)


def _peek(looked: socket.socket, size: int) -> bytes:
    return looked.recv(size, socket.MSG_PEEK | socket.MSG_DONTWAIT)


def is_connection(facts: Mapping[str, Fact]) -> bool:
    """Whether a TCP socket is or was connected, or is on its way there."""
    if not inet.is_of_tcp(facts) or facts["state"] == LISTENING:
        return False
    return facts["state"] != CLOSED or bool(facts.get("ends"))


def is_carriable(facts: Mapping[str, Fact]) -> bool:
    """Whether it is a connection that lives, and may be taken along."""
    return is_connection(facts) and facts["state"] in tcp_repair.LIVING and bool(facts["peer"])


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The connection as it was observed."""
    if not is_connection(held.observed):
        return None
    facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed}
    if surroundings.connections and is_carriable(held.observed):
        facts |= {MAY_MOVE: True} if held.lent is None else {LEFT: ON_ITS_WAY}
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a connection can neither come back nor end."""
    if not is_connection(held.observed):
        return None
    return sockets.refuse_filter(held) or other_holders.refuse(held, "a TCP connection")


def findings(held: Sequence[Resource], surroundings: Surroundings, *, standing: bool) -> Iterator[Finding]:
    """Findings about all connections together: which cannot be made again yet, and which end.

    Args:
        standing: the program stood still, so that the facts of two ends were true at the same time.
    """
    others = pairs(held)
    for one in held:
        if one.kind != KIND:
            continue
        other = others.get(_number(one, "socket"))
        if other is not None:
            reasons = _refuse_end(one, other) if standing else ()
            yield from (Finding(KIND, one.name, REFUSED, reason) for reason in reasons)
        elif TAKEN not in one.facts and (text := note(one)):
            if MAY_MOVE in one.facts and LEFT not in one.facts:
                yield Finding(KIND, one.name, NOTED, f"{text} {GOES_ALONG}")
            else:
                yield sockets.ends(KIND, one.name, text, surroundings)


def _refuse_end(one: Resource, other: Resource) -> Iterator[str]:
    """Why a connection of the program with itself cannot be made again."""
    what = f"{one.name} is a TCP connection of the program with itself"
    if one.facts.get("urgent"):
        yield f"{what}, in which an out-of-band byte waits (MSG_OOB): {AS_SOON_AS} the program has read that"
    if one.facts.get("encrypted"):
        yield f"{what}, which the kernel encrypts (TCP_ULP): have the program's library do so"
    if one.facts["state"] == CLOSED:
        return
    underway = _number(one, "unsent") + _number(one, "sent") - _number(other, "received") + (other.facts["state"] in _PEER_ENDED)
    if underway > 0:
        yield f"{what}, {underway} bytes of which have not arrived at its other end: {AS_SOON_AS} they have arrived"
    if _number(one, "unread") > sockets.QUEUE_LIMIT:
        yield f"{what}, in which more than {sockets.QUEUE_LIMIT >> 20} MiB wait: {AS_SOON_AS} the program has read them"


def note(held: Resource) -> str | None:
    """The end of a connection with another program, as a sentence; None of one that had ended, or is asked for anew."""
    if held.facts["state"] in (CLOSED, SYN_SENT) and not _number(held, "unread"):
        return None
    why = f" ({reason})" if isinstance(reason := held.facts.get(LEFT), str) else ""
    return f"the TCP connection {named(held)} is {'ended' if _reads_the_end(held) else 'reset'}{why}"


def named(held: Resource) -> str:
    """A connection, for a sentence: its descriptor, and the address of its peer."""
    peer = held.facts["peer"]
    return f"{held.name} with {in_words(peer)}" if isinstance(peer, list) and peer else held.name


def notes(held: Sequence[Resource]) -> tuple[str, ...]:
    """The connections that a restore loses, one sentence each."""
    others = pairs(held)
    ending = (one for one in held if one.kind == KIND and TAKEN not in one.facts and _number(one, "socket") not in others)
    return tuple(text for one in ending if (text := note(one)))


def established(held: Iterable[Resource]) -> int:
    """How many of these are connections that are open."""
    return sum(one.kind == KIND and one.facts["state"] == ESTABLISHED for one in held)


def summary(held: Sequence[Resource]) -> tuple[str, ...]:
    """The connections that a restore of a whole program resets, as a sentence for its status: their peers, and what to do.

    Args:
        held: the resources of all its processes.
    """
    others = pairs(held)
    ended = {
        _number(one, "socket"): one
        for one in held
        if one.kind == KIND and TAKEN not in one.facts and _number(one, "socket") not in others and note(one)
    }
    if not ended:
        return ()
    ports = {_plain(one.facts["address"])[1] for one in held if one.kind == inet.KIND and one.facts["state"] == LISTENING}
    accepted = [one for one in ended.values() if _plain(one.facts["address"])[1] in ports]
    peers = [in_words(peer) for one in ended.values() if isinstance(peer := one.facts["peer"], list) and peer]
    named = list(dict.fromkeys(peers))
    more = f" and {len(named) - PEERS_TOLD} more" if len(named) > PEERS_TOLD else ""
    figure = f"{len(ended)} TCP connection{'s' * (len(ended) > 1)}"
    with_whom = f" with {', '.join(named[:PEERS_TOLD])}{more}" if named else ""
    to_ports = ", ".join(map(str, sorted({_plain(one.facts["address"])[1] for one in accepted})))
    opened = f"; others had opened {len(accepted)} of them, to its port {to_ports}" if accepted else ""
    return (
        f"{RESET_NOTE}: {figure}{with_whom}{opened}. If they are not opened anew, let an after_resume command see to that, or "
        "protect it and its peers as one component (docs/recipes.md)",
    )


def pairs(held: Iterable[Resource]) -> dict[int, Resource]:
    """The other end of each connection that has one among these, by the socket's number; this machine has their addresses."""
    local = [one for one in held if one.kind == KIND and one.facts["local"] and not number_of(one.facts.get("ends", 0)) & FAILED]
    by_ends = {(_plain(one.facts["address"]), _plain(one.facts["peer"])): one for one in local}
    found = {}
    for (address, peer), one in by_ends.items():
        other = by_ends.get((peer, address))
        if other is not None and other is not one and all(is_ours(_address(one, end)) for end in ("address", "peer")):
            found[_number(one, "socket")] = other
    return found


def _plain(address: Fact) -> tuple[str, int]:
    """Host and port: a connection may have one end of IPv6 and one of IPv4."""
    if not isinstance(address, list) or not address:
        return "", 0
    return str(address[0]).removeprefix("::ffff:"), number_of(address[1])


def _number(held: Resource, name: str) -> int:
    return number_of(held.facts[name])


def _reads_the_end(held: Resource) -> bool:
    """Whether all was read that its peer had to say before it ended."""
    return held.facts["state"] in _PEER_ENDED and not held.facts["unread"]


# --- Restore -----------------------------------------------------------------------------------------------------------


def prepare(table: CallTable, held: Sequence[Resource], first: int) -> dict[int, int]:
    """Make all of them at numbers from ``first`` on, before any listens: the descriptor of each, by the socket's number."""
    return _Work(table, held, first).run() if held else {}


class _Work:
    """One restore of connections.

    Attributes:
        next: the number to which the next one is moved.
    """

    def __init__(self, table: CallTable, held: Sequence[Resource], first: int) -> None:
        self._table = table
        self._held = held
        self._others = pairs(held)
        self._made: dict[int, int] = {}
        self._next = first

    def run(self) -> dict[int, int]:
        """Make them all."""
        for one in self._held:
            if _number(one, "socket") in self._made:
                continue
            other = self._others.get(_number(one, "socket"))
            if other is not None:
                self._join(one, other)
            elif one.facts["state"] == SYN_SENT or TAKEN in one.facts:
                self._keep(one, sockets.make(self._table, one))
            else:
                self._end(one)
        return self._made

    def _keep(self, one: Resource, made: int) -> None:
        """Move a descriptor above all that are wanted."""
        self._table.duplicate(made, self._next, os.O_CLOEXEC)
        self._table.close(made)
        self._made[_number(one, "socket")] = self._next
        self._next += 1

    def _join(self, one: Resource, other: Resource) -> None:
        """Connect two ends with each other, by a listener in place of the one that it was accepted from."""
        table, room = self._table, max(len(_queue(one)), len(_queue(other)))
        time_wait.remove([_plain(one.facts[name]) for name in ("address", "peer")])
        lent, connecting = self._socket(one, room), self._socket(other, room)
        place = self._bind(one, lent)
        self._bind(other, connecting)
        table.call(f"let {one.name} be connected", "listen", lent, 1)
        target = _address(other, "peer")
        if one.facts["family"] == other.facts["family"]:  # wherever it listens, if it could not be where it was
            size = table.place(size_of(target).to_bytes(4, "little"))
            table.call(f"ask where {one.name} is", "getsockname", lent, place, size)
        else:
            place = table.place(sockaddr(target))
        table.call(f"connect {other.name}", "connect", connecting, place, size_of(target))
        accepted = table.obtain(f"accept the connection of {one.name}", "accept4", lent, 0, 0, socket.SOCK_CLOEXEC)
        table.close(lent)
        self._keep(one, accepted)
        self._keep(other, connecting)

    def _bind(self, one: Resource, made: int) -> int:
        """Give it the address that it had, if that is free: where that lies in the vessel."""
        address = _address(one, "address")
        place = self._table.place(sockaddr(address))
        lost = f"{one.name} was at {in_words(address)}, which is taken here"
        self._table.attempt(lost, "bind", made, place, size_of(address))
        return place

    def _socket(self, one: Resource, room: int) -> int:
        """A socket with room for what waits, whose port may have been in use a moment ago."""
        table = self._table
        form = (_number(one, "family"), _number(one, "type") | socket.SOCK_CLOEXEC, _number(one, "protocol"))
        made = table.obtain(f"make the socket of {one.name}", "socket", *form)
        _set(table, made, socket.SO_REUSEADDR, 1)
        for level, option, value in sockets.options_of(one):
            if (level, option) == sockets.V6ONLY:
                table.attempt("", "setsockopt", made, level, option, table.place(value), len(value))
        if room:
            for number, forced in ((socket.SO_SNDBUF, 32), (socket.SO_RCVBUF, 33)):
                for way in (number, forced):
                    _set(table, made, way, 2 * room + _ROOM)
        return made

    def _end(self, one: Resource) -> None:
        """A connection with a listener of our own, which then ends it."""
        table, is_six = self._table, _number(one, "family") == socket.AF_INET6
        host: list[Fact] = ["::ffff:127.0.0.1" if is_six else "127.0.0.1", 0]
        form = (_number(one, "family"), socket.SOCK_STREAM | socket.SOCK_CLOEXEC, _number(one, "protocol"))
        lent = table.obtain(f"make a listener for {one.name}", "socket", *form)
        address, size = table.place(sockaddr(host)), table.place(size_of(host).to_bytes(4, "little"))
        table.call(f"bind a listener for {one.name}", "bind", lent, address, size_of(host))
        table.call(f"listen for {one.name}", "listen", lent, 1)
        table.call(f"ask for the port of {one.name}", "getsockname", lent, address, size)
        made = table.obtain(f"make the socket of {one.name}", "socket", *form)
        table.call(f"connect {one.name}", "connect", made, address, size_of(host))
        accepted = table.obtain(f"accept the connection of {one.name}", "accept4", lent, 0, 0, socket.SOCK_CLOEXEC)
        table.close(lent)
        if not (_reads_the_end(one) or _has_told(one)):
            place = table.place(_RESET_AT_CLOSE)
            table.call(f"reset {one.name}", "setsockopt", accepted, socket.SOL_SOCKET, socket.SO_LINGER, place, 8)
        table.close(accepted)
        polled = table.place(struct.pack("<ihh", made, select.POLLRDHUP, 0))
        table.call(f"wait for the end of {one.name}", "ppoll", polled, 1, 0, 0, 0)
        if _has_told(one):
            table.call(f"shut {one.name} down", "shutdown", made, socket.SHUT_RDWR)
        self._keep(one, made)


def _has_told(one: Resource) -> bool:
    """Whether it had ended before, and the program has seen why: then nothing is left but the end of file."""
    return one.facts["state"] == CLOSED and not _number(one, "ends") & FAILED


def _address(one: Resource, name: str) -> list[Fact]:
    address = one.facts[name]
    assert isinstance(address, list)
    return address


def _queue(one: Resource) -> bytes:
    messages = one.facts["queue"]
    assert isinstance(messages, list)
    return b"".join(message for message in messages if isinstance(message, bytes))


def _set(table: CallTable, made: int, option: int, value: int) -> None:
    table.attempt("", "setsockopt", made, socket.SOL_SOCKET, option, table.place(value.to_bytes(4, "little")), 4)


def settle(table: CallTable, held: Sequence[Resource], made: Mapping[int, int]) -> None:
    """Once the listeners listen: set options, send waiting bytes, and end sides that had ended."""
    others = pairs(held)
    for one in held:
        number, other = made[_number(one, "socket")], others.get(_number(one, "socket"))
        if TAKEN in one.facts:
            continue
        if one.facts["state"] == SYN_SENT:
            _ask_again(table, one, number)
        elif other is not None:
            _set(table, number, socket.SO_REUSEADDR, 0)
            _set(table, number, sockets.SO_BUF_LOCK, 0)
            sockets.set_options(table, one, number, is_bound=True)
            if _queue(one):
                sockets.fill(table, one, [sockets.Way(made[_number(other, "socket")], sender=other)])
    for one in held:
        number = made[_number(one, "socket")]
        if _number(one, "socket") in others and one.facts["state"] in _WE_ENDED:
            table.call(f"end the side of {one.name}", "shutdown", number, socket.SHUT_WR)
        if _number(one, "socket") in others and one.facts.get("deaf"):
            table.call(f"have {one.name} read the end", "shutdown", number, socket.SHUT_RD)
        sockets.set_flags(table, one, number)


def _ask_again(table: CallTable, one: Resource, number: int) -> None:
    """Ask for the connection without waiting for it: the program does, or it was told that it need not."""
    peer = one.facts["peer"]
    if isinstance(peer, list) and peer:
        table.call(f"let {one.name} not wait", "fcntl", number, fcntl.F_SETFL, os.O_NONBLOCK)
        table.attempt("", "connect", number, table.place(sockaddr(peer)), size_of(peer))
        table.call(f"let {one.name} wait", "fcntl", number, fcntl.F_SETFL, 0)
