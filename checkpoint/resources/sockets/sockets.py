"""Facts that all sockets have in common: their family and kind, options, and data that waits to be read.

Facts of every socket: ``descriptors``; ``flags`` of fcntl(2); ``socket``: its inode number, by which others refer to it;
``family``, ``type`` and ``protocol`` of socket(2); ``user``: uid and gid of its creator, as fstat(2) reports them; ``options``: a
list of [level, number, value] of those that are not as in a fresh socket; ``filter``, where there is one: the classic BPF program
that filters incoming data, and ``filter_locked``; ``queue``: data that waits to be read, a list of messages, for a stream the
pieces in which it was found.

A waiting datagram of no bytes is lost by the second capture after it came: it cannot be read twice.

Source: socket(7), ip(7), ipv6(7), tcp(7), udp(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import select
import socket
import stat
import struct
import termios
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, refused
from checkpoint.engine import NOTED, REFUSED, Finding
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.sentences import AS_SOON_AS

CAPABILITIES: Final = (
    refused(
        Area.SOCKETS,
        "a socket with a filter of extended BPF (SO_ATTACH_BPF)",
        "use a classic filter (SO_ATTACH_FILTER), which is preserved",
        "with a filter of extended BPF",
    ),
)

QUEUE_LIMIT: Final = 4 << 20
"""Bytes that wait in one socket and are carried."""
MESSAGES_MAX: Final = 65536
MUCH: Final = 1 << 15
"""Bytes that wait and may not find room again in a buffer of the usual size: the smallest is larger (wmem_default)."""
_MESSAGE_HEAD: Final = struct.Struct("<QI4xQQQQi4x")
_CONTROL_HEAD: Final = struct.Struct("<Qii")
"""struct msghdr and struct cmsghdr."""
PIECE_SIZE: Final = 1 << 18
"""Bytes that are looked at in one go: more than any datagram has."""
RIGHTS_SPACE: Final = socket.CMSG_SPACE(253 * 4)
"""Room for as many descriptors as one message may carry (SCM_MAX_FD)."""
OPTION_SIZE: Final = 64
"""Bytes of the longest option that is kept."""

SO_ATTACH_FILTER: Final = 26
"""To get it back, too: then the length is counted in instructions of eight bytes."""
SO_LOCK_FILTER: Final = 44
UNTOLD: Final = b"?"
"""In place of a filter: it is of extended BPF, which the kernel does not tell."""
SO_PEEK_OFF: Final = 42
_USUAL: Final = (2, 5, 6, 9, 10, 11, 12, 13, 15, 16, 18, 20, 21, 25, 29, 34, 35, 36, 37, 40, SO_PEEK_OFF, 46, 47, 60, 69)
"""SO_REUSEADDR, DONTROUTE, BROADCAST, KEEPALIVE, OOBINLINE, NO_CHECK, PRIORITY, LINGER, REUSEPORT, PASSCRED, RCVLOWAT, RCVTIMEO,
SNDTIMEO, BINDTODEVICE, TIMESTAMP, PASSSEC, TIMESTAMPNS, MARK, TIMESTAMPING, RXQ_OVFL, PEEK_OFF, BUSY_POLL, MAX_PACING_RATE,
ZEROCOPY, PREFER_BUSY_POLL."""
_GENERAL: Final = (1, *_USUAL, 43, 45, 61, 63, 64, 65, 74, 75, 76, 82, 83)
"""SO_DEBUG, NOFCS, SELECT_ERR_QUEUE, TXTIME, TIMESTAMP_NEW, TIMESTAMPNS_NEW, TIMESTAMPING_NEW, TXREHASH, RCVMARK, PASSPIDFD,
RCVPRIORITY, PASSRIGHTS besides."""
_BUFFERS: Final = {socket.SO_SNDBUF: 1, socket.SO_RCVBUF: 2}
"""Which bit of SO_BUF_LOCK says that the program has set it; else the kernel chooses. It doubles what it is told."""
SO_BUF_LOCK: Final = 72
_FORCED: Final = {socket.SO_SNDBUF: 32, socket.SO_RCVBUF: 33}
"""SO_SNDBUFFORCE and SO_RCVBUFFORCE."""
_OF_IP: Final = (6, 7, 18, 23, 25, 26)
"""IP_RECVOPTS, RETOPTS, PASSSEC, CHECKSUM, RECVFRAGSIZE, RECVERR_RFC4884: data that come with a datagram."""
_IP: Final = (1, 2, 4, 8, 10, 11, 12, 13, 15, 19, 20, 21, 24, 32, 33, 34, 49, 50, 51, *_OF_IP)
"""IP_TOS, TTL, OPTIONS, PKTINFO, MTU_DISCOVER, RECVERR, RECVTTL, RECVTOS, FREEBIND, TRANSPARENT, ORIGDSTADDR, MINTTL,
BIND_ADDRESS_NO_PORT, MULTICAST_IF, MULTICAST_TTL, MULTICAST_LOOP, MULTICAST_ALL, UNICAST_IF, LOCAL_PORT_RANGE."""
_OF_IPV6: Final = (2, 3, 4, 5, 8, 11, 30, 31, 33, 77)
"""IPV6_2292PKTINFO, 2292HOPOPTS, 2292DSTOPTS, 2292RTHDR, 2292HOPLIMIT, FLOWINFO, ROUTER_ALERT_ISOLATE, RECVERR_RFC4884,
FLOWINFO_SEND, RECVFRAGSIZE: the same there."""
_IPV6: Final = (
    *(16, 17, 18, 19, 23, 25, 26, 29, 49, 51, 53, 54, 56, 57, 58, 59, 60, 62, 66, 67, 70, 72, 73, 74, 75, 76, 78),
    *_OF_IPV6,
)
"""IPV6_UNICAST_HOPS, MULTICAST_IF, MULTICAST_HOPS, MULTICAST_LOOP, MTU_DISCOVER, RECVERR, V6ONLY, MULTICAST_ALL, RECVPKTINFO,
RECVHOPLIMIT, RECVHOPOPTS, HOPOPTS, RECVRTHDR, RTHDR, RECVDSTOPTS, DSTOPTS, RECVPATHMTU, DONTFRAG, RECVTCLASS, TCLASS,
AUTOFLOWLABEL, ADDR_PREFERENCES, MINHOPCOUNT, ORIGDSTADDR, TRANSPARENT, UNICAST_IF, FREEBIND."""
_OF_DATAGRAMS: Final = tuple(
    (level, number)
    for level, numbers in (
        (socket.SOL_SOCKET, (43, 61, 63, 64, 65)),
        (socket.IPPROTO_IP, (32, 33, *_OF_IP)),
        (socket.IPPROTO_IPV6, (17, 18, *_OF_IPV6)),
    )
    for number in numbers
)
"""Options that a stream shows and cannot be given, whereby and how far it would send to groups; and those that mean nothing to
it: a program may have a thousand streams, and stands still while they are asked."""
_TCP: Final = (1, 3, 4, 5, 6, 7, 8, 9, 10, 13, 16, 18, 23, 25, 27, 30, 34, 36, 37, 44, 45, 46)
"""TCP_NODELAY, CORK, KEEPIDLE, KEEPINTVL, KEEPCNT, SYNCNT, LINGER2, DEFER_ACCEPT, WINDOW_CLAMP, CONGESTION, THIN_LINEAR_TIMEOUTS,
USER_TIMEOUT, FASTOPEN, NOTSENT_LOWAT, SAVE_SYN, FASTOPEN_CONNECT, FASTOPEN_NO_COOKIE, INQ, TX_DELAY, RTO_MAX_MS, RTO_MIN_US,
DELACK_MAX_US."""
_UDP: Final = (1, 100, 101, 102, 103, 104)
"""UDP_CORK, ENCAP, NO_CHECK6_TX, NO_CHECK6_RX, SEGMENT, GRO."""
_UDPLITE: Final = 136
_SOL_RAW: Final = 255
_NETLINK: Final = (3, 4, 5, 8, 10, 11, 12)
"""NETLINK_PKTINFO, BROADCAST_ERROR, NO_ENOBUFS, LISTEN_ALL_NSID, CAP_ACK, EXT_ACK, GET_STRICT_CHK."""
_PACKET: Final = (7, 8, 9, 10, 12, 14, 15, 17, 19, 20, 23)
"""PACKET_COPY_THRESH, AUXDATA, ORIGDEV, VERSION, RESERVE, LOSS, VNET_HDR, TIMESTAMP, TX_HAS_OFF, QDISC_BYPASS,
IGNORE_OUTGOING."""
_OF_FAMILY: Final = {socket.AF_NETLINK: (270, _NETLINK), socket.AF_PACKET: (263, _PACKET)}
"""SOL_NETLINK and SOL_PACKET."""

_JUST_NOW: Final = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS)
"""Why no socket can be made, which says nothing of the next time."""

_getsockopt = ctypes.CDLL(None, use_errno=True).getsockopt


class Form(Struct, frozen=True):
    """The arguments of socket(2)."""

    family: int
    type: int
    protocol: int


class Queue(Struct, frozen=True):
    """The messages that wait to be read.

    Attributes:
        passed: of each message the descriptors of the program that are on their way in it, `UNKNOWN` for what it has not open.
        sources: of each message its sender's address, as recvmsg(2) tells it.
        too_long: more than `QUEUE_LIMIT` bytes.
        urgent: an out-of-band byte waits, too.
        reset: nothing waits, but that its peer has gone without reading everything (ECONNRESET): a look would take that away.
    """

    messages: tuple[bytes, ...] = ()
    sources: tuple[object, ...] = ()
    passed: tuple[tuple[int, ...], ...] = ()
    too_long: bool = False
    urgent: bool = False
    reset: bool = False


NOTHING: Final = Queue()
UNKNOWN: Final = -1

Identify = Callable[[int], int]
"""Given a descriptor of ours that was on its way to the program: which of its own is the same, else `UNKNOWN`."""

Noted = Callable[[int, int], AbstractContextManager[None]]
"""Given a descriptor of the program and its socket's SO_PEEK_OFF: writes both down for the body, and for the next keeper if we
die in it."""


def is_socket(one: Descriptor) -> bool:
    """Whether a descriptor is a socket."""
    return stat.S_ISSOCK(one.mode) and one.target.startswith("socket:")


class _Plain(socket.socket):
    """A socket whose family and type are told as plain numbers: to make enumerations of them takes longer than to ask."""

    family = socket.SocketType.family  # type: ignore[assignment]
    type = socket.SocketType.type  # type: ignore[assignment]


@contextlib.contextmanager
def looked_into(pid: int, number: int) -> Iterator[socket.socket]:
    """A socket of another process, for the body; options set on it are set there, too.

    Raises:
        OSError: it was closed meanwhile.
    """
    with copy_of(pid, number) as descriptor:
        lent = _Plain(fileno=descriptor)
        try:
            yield lent
        finally:
            lent.detach()


def general_facts(held: OpenFile, looked: socket.socket, opened: Opened) -> dict[str, Fact]:
    """Family, kind and options."""
    recalled = opened.recalled.get(held.first.number)
    if recalled and held.lent is None:
        return dict(recalled.settings)
    form = Form(looked.family, looked.type, looked.proto)
    about = os.fstat(looked.fileno())  # its descriptor's own stat is the same for all sockets
    facts: dict[str, Fact] = {
        "socket": held.first.inode,
        "family": int(form.family),
        "type": int(form.type),
        "protocol": form.protocol,
        "user": [about.st_uid, about.st_gid],
        "options": list(_options(looked, form)),
    }
    if sieve := _filter(looked):
        facts |= {"filter": sieve, "filter_locked": bool(looked.getsockopt(socket.SOL_SOCKET, SO_LOCK_FILTER))}
    return facts


def _filter(looked: socket.socket) -> bytes:
    """The classic BPF program that sifts what comes; b"" for none, `UNTOLD` for one of extended BPF.

    Source: sk_get_filter() in net/core/filter.c.
    """
    count = ctypes.c_uint32(0)
    if _getsockopt(looked.fileno(), socket.SOL_SOCKET, SO_ATTACH_FILTER, None, ctypes.byref(count)):
        return UNTOLD if ctypes.get_errno() == errno.EACCES else b""
    if not count.value:
        return b""
    found = ctypes.create_string_buffer(count.value * 8)
    if _getsockopt(looked.fileno(), socket.SOL_SOCKET, SO_ATTACH_FILTER, found, ctypes.byref(count)):
        return UNTOLD
    return found.raw


def refuse_filter(held: OpenFile) -> str | None:
    """Why a socket's filter cannot be kept."""
    if held.observed.get("filter") != UNTOLD:
        return None
    return f"{held.name} is a socket with a filter of extended BPF, which the kernel does not tell: use a classic one"


def ends(kind: str, name: str, what: str, surroundings: Surroundings, more: str = "") -> Finding:
    """The finding that a restore ends a connection with others; it refuses a capture where the operator wants that.

    Args:
        more: the effect on the program.
    """
    if surroundings.terms.refuses_connections:
        cure = f"{AS_SOON_AS} the program has closed the connection"
        return Finding(kind, name, REFUSED, f'{what} by a restore, which connections = "refuse" rules out: {cure}')
    return Finding(kind, name, NOTED, f"{what} when the program comes back{more}")


def _options(looked: socket.socket, form: Form) -> Iterator[list[Fact]]:
    """The program stands still meanwhile: some sixty questions to each socket."""
    ask = looked.getsockopt
    chosen = _option(looked, socket.SOL_SOCKET, SO_BUF_LOCK)
    locks = None if chosen is None else chosen[0]
    for (level, number), usual in _fresh_options(form).items():
        try:
            value = ask(level, number, OPTION_SIZE)
        except OSError:
            continue
        if level == socket.SOL_SOCKET and number in _BUFFERS and locks is not None:
            is_chosen = bool(locks & _BUFFERS[number])  # the kernel sizes it by itself, and a program may choose what is usual
        else:
            is_chosen = value != usual
        if is_chosen:
            yield [level, number, value]


def fresh_options(form: Form) -> Mapping[tuple[int, int], bytes]:
    """By level and number, what such a socket answers that was just made."""
    return _fresh_options(form)


@lru_cache(maxsize=32)
def _fresh_options(form: Form) -> Mapping[tuple[int, int], bytes]:
    """Options of a socket that was just made, as far as it has them; none of one that we may not make.

    Raises:
        OSError: it cannot be made just now.
    """
    levels = [(socket.SOL_SOCKET, (*_GENERAL, *_BUFFERS))]
    if form.family in _OF_FAMILY:
        levels.append(_OF_FAMILY[socket.AddressFamily(form.family)])
    if form.family in (socket.AF_INET, socket.AF_INET6):
        levels.append((socket.IPPROTO_IP, _IP))
        levels += _of_protocol(form)
    if form.family == socket.AF_INET6:
        levels.append((socket.IPPROTO_IPV6, _IPV6))
    is_ping = form.type == socket.SOCK_DGRAM and form.protocol in (socket.IPPROTO_ICMP, socket.IPPROTO_ICMPV6)
    try:
        fresh = socket.socket(form.family, form.type, 0 if is_ping else form.protocol)  # which group of users may, we may not
    except OSError as error:
        if error.errno in _JUST_NOW:  # or it would seem for ever to have no options
            raise
        return {}
    with fresh:
        found = {(level, number): _option(fresh, level, number) for level, numbers in levels for number in numbers}
    left_out = _OF_DATAGRAMS if form.type == socket.SOCK_STREAM else ()
    return {place: value for place, value in found.items() if value is not None and place not in left_out}


def _of_protocol(form: Form) -> list[tuple[int, tuple[int, ...]]]:
    """Levels and options besides those of the family."""
    if form.type == socket.SOCK_RAW:
        own = {
            socket.IPPROTO_ICMP: (_SOL_RAW, (1,)),
            socket.IPPROTO_ICMPV6: (socket.IPPROTO_ICMPV6, (1,)),
        }  # which types it hears
        levels: list[tuple[int, tuple[int, ...]]] = [(socket.IPPROTO_IP, (3, 5, 22))]  # IP_HDRINCL, ROUTER_ALERT, NODEFRAG
        if form.family == socket.AF_INET6:
            levels.append((socket.IPPROTO_IPV6, (7, 36)))  # IPV6_CHECKSUM, HDRINCL
        return [*levels, *([own[form.protocol]] if form.protocol in own else [])]
    own_numbers = {socket.IPPROTO_TCP: _TCP, socket.IPPROTO_UDP: _UDP, _UDPLITE: (*_UDP, 10, 11)}  # which part has a checksum
    return [(form.protocol, own_numbers.get(form.protocol, ()))]


def _option(looked: socket.socket, level: int, number: int) -> bytes | None:
    try:
        return looked.getsockopt(level, number, OPTION_SIZE)
    except OSError:
        return None


def queue_of(looked: socket.socket, number: int, noted: Noted | None, identify: Identify = lambda _: UNKNOWN) -> Queue:
    """The messages that wait to be read; they stay there.

    Only where several messages wait must the kernel be told to look behind the first (SO_PEEK_OFF). That is told to the program's
    own socket: never while the program runs, for it would look there, too.

    Args:
        number: its descriptor in the program.
        noted: None of a program that runs: then nothing is found behind the first message.

    Raises:
        OSError: this socket cannot be looked into, or an error waits in it, which our look would take away.
    """
    ready = readiness(looked)
    if looked.family == socket.AF_UNIX and looked.type != socket.SOCK_DGRAM and ready & select.POLLERR:
        if _unread(looked):
            raise OSError(errno.EBUSY, "an error waits in it behind what the program has not read yet")
        return Queue(reset=True)
    if looked.type != socket.SOCK_STREAM and ready & select.POLLERR:
        if looked.family == socket.AF_UNIX:
            raise OSError(errno.EBUSY, "an error waits in it, which the program has not been told yet")
        return NOTHING  # datagrams of UDP may be lost, the error may not
    if ready & select.POLLPRI:
        return Queue(urgent=True)
    if not ready & select.POLLIN:
        return NOTHING
    before = looked.getsockopt(socket.SOL_SOCKET, SO_PEEK_OFF)
    if before < 0 and (noted is None or looked.type != socket.SOCK_DGRAM):
        first = _peeked(looked, 1, identify)
        if noted is None or _is_all(looked, first):
            return first
    if noted is None:
        return NOTHING
    with noted(number, before):
        looked.setsockopt(socket.SOL_SOCKET, SO_PEEK_OFF, 0)
        try:
            return _peeked(looked, MESSAGES_MAX, identify)
        finally:
            set_peek_offset(looked, before)


def set_peek_offset(looked: socket.socket, offset: int) -> None:
    """Set where MSG_PEEK begins to look, -1 for the first message each time."""
    looked.setsockopt(socket.SOL_SOCKET, SO_PEEK_OFF, offset)


def readiness(looked: socket.socket) -> int:
    """The events of poll(2) for reading it."""
    poll = select.poll()
    poll.register(looked, select.POLLIN | select.POLLPRI)
    return next((events for _, events in poll.poll(0)), 0)


def _is_all(looked: socket.socket, first: Queue) -> bool:
    """Whether nothing waits behind the first message, which is no datagram. Source: unix(7), SIOCINQ."""
    return _unread(looked) <= sum(map(len, first.messages))


def _unread(looked: socket.socket) -> int:
    return int.from_bytes(fcntl.ioctl(looked.fileno(), termios.FIONREAD, bytes(4)), "little")


def unsent(looked: socket.socket) -> int:
    """How much of what it sent has not left it yet, or was not read by a unix socket's peer, in bytes of the kernel's memory.

    Source: unix(7), udp(7), SIOCOUTQ.
    """
    return int.from_bytes(fcntl.ioctl(looked.fileno(), termios.TIOCOUTQ, bytes(4)), "little")


def _peeked(looked: socket.socket, count: int, identify: Identify) -> Queue:
    """At most so many messages, or pieces of a stream."""
    messages: list[bytes] = []
    sources: list[object] = []
    passed: list[tuple[int, ...]] = []
    size = 0
    is_datagram = looked.type == socket.SOCK_DGRAM
    while size <= QUEUE_LIMIT and len(messages) < count:
        try:
            content, ancillary, _, source = looked.recvmsg(PIECE_SIZE, RIGHTS_SPACE, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            break
        passed.append(tuple(_identified(ancillary, identify)))
        if not content and not is_datagram:  # its peer has shut it down
            break
        messages.append(content)
        sources.append(source)
        size += len(content)
    return Queue(tuple(messages), tuple(sources), tuple(passed[: len(messages)]), size > QUEUE_LIMIT)


def _identified(ancillary: Iterable[tuple[int, int, bytes]], identify: Identify) -> Iterator[int]:
    """Which of the program's descriptors came with a message; ours are closed."""
    for level, kind, carried in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            for (descriptor,) in struct.iter_unpack("<i", carried[: len(carried) // 4 * 4]):
                try:
                    yield identify(descriptor)
                finally:
                    os.close(descriptor)


# --- Restore -----------------------------------------------------------------------------------------------------------


def fresh(table: CallTable, held: Resource) -> int:
    """A socket of the same kind."""
    form = [number_of(held.facts[name]) for name in ("family", "type", "protocol")]
    return table.obtain(f"make the socket of {held.name}", "socket", form[0], form[1] | socket.SOCK_CLOEXEC, form[2])


def make(table: CallTable, held: Resource) -> int:
    """A fresh socket of the same kind, with its options."""
    made = fresh(table, held)
    set_options(table, held, made)
    return made


UDP_CORK: Final = (socket.IPPROTO_UDP, 1)
V6ONLY: Final = (socket.IPPROTO_IPV6, socket.IPV6_V6ONLY)


def set_options(table: CallTable, held: Resource, made: int, *, is_bound: bool = False) -> None:
    """Set the options that are not as in a fresh socket. One that cannot be set here becomes a note.

    Args:
        is_bound: it has its address already, and so what must come before that.
    """
    user = held.facts.get("user")
    if isinstance(user, list) and user:
        table.attempt(f"{held.name} is another user's socket", "fchown", made, number_of(user[0]), number_of(user[1]))
    for level, number, value in options_of(held):
        if is_bound and (level, number) == V6ONLY:
            continue
        if level == socket.SOL_SOCKET and number in _BUFFERS:
            _set_buffer(table, made, number, int.from_bytes(value, "little"))
        else:
            lost = f"option {number} of level {level} of {held.name} is not kept"
            table.attempt(lost, "setsockopt", made, level, number, table.place(value), len(value))
    _set_filter(table, held, made)


def options_of(held: Resource) -> Iterator[tuple[int, int, bytes]]:
    """Level, number and value of each option that is not as in a fresh socket."""
    options = held.facts["options"]
    assert isinstance(options, list)
    for one in options:
        assert isinstance(one, list) and isinstance(one[2], bytes)
        yield number_of(one[0]), number_of(one[1]), one[2]


def has_option(held: Resource, level: int, number: int) -> bool:
    """Whether an option is not as in a fresh socket."""
    return any((its_level, its_number) == (level, number) for its_level, its_number, _ in options_of(held))


def _set_filter(table: CallTable, held: Resource, made: int) -> None:
    sieve = held.facts.get("filter")
    if not isinstance(sieve, bytes):
        return
    program = table.place(struct.pack("<H6xQ", len(sieve) // 8, table.place(sieve)))
    table.call(f"attach the filter of {held.name}", "setsockopt", made, socket.SOL_SOCKET, SO_ATTACH_FILTER, program, 16)
    if held.facts.get("filter_locked"):
        place = table.place(struct.pack("<i", 1))
        table.call(f"lock the filter of {held.name}", "setsockopt", made, socket.SOL_SOCKET, SO_LOCK_FILTER, place, 4)


def _set_buffer(table: CallTable, made: int, number: int, size: int) -> None:
    """Set the size of a buffer, in bytes as the kernel tells it, beyond its limit where we may."""
    value = (size // 2).to_bytes(4, "little")
    for option in (number, _FORCED[number]):
        table.attempt("", "setsockopt", made, socket.SOL_SOCKET, option, table.place(value), len(value))


class Way(Struct, frozen=True):
    """How a message gets to where it waited.

    Attributes:
        number: the descriptor through which it is sent.
        address: where to; b"" to where that is connected.
        sender: whose descriptor that is, if it is the program's.
    """

    number: int
    address: bytes = b""
    sender: Resource | None = None


def fill(table: CallTable, held: Resource, ways: Sequence[Way]) -> None:
    """Send what waited in a socket.

    A full buffer may be fuller than one that is filled again in other pieces: it is made large meanwhile.

    Args:
        ways: one for each message.
    """
    messages, passed = held.facts["queue"], held.facts.get("passed", [])
    assert isinstance(messages, list) and isinstance(passed, list)
    is_much = sum(len(message) for message in messages if isinstance(message, bytes)) > MUCH
    enlarged = {way.number: way.sender for way in ways if is_much}
    for number in enlarged:
        _set_buffer(table, number, socket.SO_SNDBUF, 4 * QUEUE_LIMIT)
    for index, (message, way) in enumerate(zip(messages, ways, strict=True)):
        rights = passed[index] if passed else []
        assert isinstance(message, bytes) and isinstance(rights, list)
        _send(table, f"fill {held.name} with its waiting messages", way, message, [number_of(one) for one in rights])
    for number, sending in enlarged.items():
        if sending is not None:
            _set_send_buffer_back(table, sending, number)


def _send(table: CallTable, what: str, way: Way, message: bytes, passed: Sequence[int]) -> None:
    """Send one message, with descriptors if there are any. Source: sendmsg(2), cmsg(3)."""
    size, flags = len(message), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
    address = (table.place(way.address) if way.address else 0, len(way.address))
    if not passed:
        table.call(what, "sendto", way.number, table.place(message), size, flags, *address, least=size, most=size)
        return
    rights = struct.pack(f"<{len(passed)}i", *passed)
    control = _CONTROL_HEAD.pack(_CONTROL_HEAD.size + len(rights), socket.SOL_SOCKET, socket.SCM_RIGHTS) + rights
    piece = table.place(struct.pack("<QQ", table.place(message), size))
    head = _MESSAGE_HEAD.pack(*address, piece, 1, table.place(control), len(control), 0)
    table.call(what, "sendmsg", way.number, table.place(head), flags, least=size, most=size)


def _set_send_buffer_back(table: CallTable, held: Resource, made: int) -> None:
    """Give a socket's send buffer the size that the program had chosen, or else the kernel's own."""
    chosen = [value for level, number, value in options_of(held) if (level, number) == (socket.SOL_SOCKET, socket.SO_SNDBUF)]
    family, kind, protocol = (number_of(held.facts[name]) for name in ("family", "type", "protocol"))
    usual = _fresh_options(Form(family, kind, protocol))[socket.SOL_SOCKET, socket.SO_SNDBUF]
    _set_buffer(table, made, socket.SO_SNDBUF, int.from_bytes((chosen or [usual])[0], "little"))
    if not chosen:
        free = bytes(4)
        table.attempt("", "setsockopt", made, socket.SOL_SOCKET, SO_BUF_LOCK, table.place(free), len(free))


SHUTDOWN_HOW: Final = {1: socket.SHUT_RD, 2: socket.SHUT_WR, 3: socket.SHUT_RDWR}
"""The argument of shutdown(2), by the state that the kernel tells afterwards."""


def shut_down(table: CallTable, held: Resource, made: int) -> None:
    """Shut down what was: a socket for datagrams that is not connected is, though the kernel says that it is not."""
    if how := number_of(held.facts.get("shutdown", 0)):
        table.attempt("", "shutdown", made, SHUTDOWN_HOW[how])


def set_flags(table: CallTable, held: Resource, made: int) -> None:
    """Whether it waits."""
    flags = number_of(held.facts["flags"]) & (os.O_NONBLOCK | os.O_ASYNC)
    if flags:
        table.call(f"set the flags of {held.name}", "fcntl", made, fcntl.F_SETFL, flags)
