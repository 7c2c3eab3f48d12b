"""Silence TCP connections: the kernel drops all packets to and from them.

While a connection moves, no machine may answer in its place: neither a kernel that has no such socket any more (it would reset
the peer's), nor one whose program was ended with the connection open. The peer receives nothing and sends again, as after a lost
packet.

Each connection has a table of its own in nf_tables, named by its two ends, so that any process that takes the connection over
finds it. The table ceases to have an effect by itself after `SILENCE_S`, and the next one removes it.

Source: linux/netfilter/nf_tables.h, linux/netfilter/nfnetlink.h; nf_tables_newrule() in net/netfilter/nf_tables_api.c.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from ipaddress import ip_address
from typing import Final

from msgspec import Struct

PREFIX: Final = "failover_"
NS_PER_S: Final = 1_000_000_000
SILENCE_S: Final = 924
"""How long a peer that hears nothing goes on sending again before it gives up. Source: tcp_retries2 in tcp(7)."""
ANSWER_S: Final = 10.0
"""How long the kernel may take to obey."""

NETLINK_NETFILTER: Final = 12
_FAMILY_INET: Final = 1
_SUBSYSTEM: Final = 10
_BATCH_BEGIN: Final = 0x10
_BATCH_END: Final = 0x11
_NEW_TABLE: Final = _SUBSYSTEM << 8
_DELETE_TABLE: Final = _SUBSYSTEM << 8 | 2
_GET_TABLE: Final = _SUBSYSTEM << 8 | 1
_NEW_CHAIN: Final = _SUBSYSTEM << 8 | 3
_NEW_RULE: Final = _SUBSYSTEM << 8 | 6
_ERROR: Final = 2
_REQUEST: Final = 1
_ACKNOWLEDGE: Final = 4
_CREATE: Final = 0x400
_DUMP: Final = 0x300
SO_SNDBUFFORCE: Final = 32
_APPEND: Final = 0x800
_NESTED: Final = 0x8000
_HEADER: Final = struct.Struct("<IHHII")
_GENERAL: Final = struct.Struct(">BBH")
"""struct nlmsghdr and struct nfgenmsg."""

_USER_DATA: Final = 6
"""NFTA_TABLE_USERDATA: bytes that the kernel keeps for us; `_UNTIL`, nanoseconds of the clock of the day."""
_UNTIL: Final = struct.Struct("<Q")

_BEFORE_ALL: Final = -300
"""NF_IP_PRI_RAW: before connections are tracked."""
_INPUT: Final = 1
_OUTPUT: Final = 3
_ACCEPT: Final = 1
_DROP: Final = 0
_REGISTER: Final = 1
_META_NFPROTO: Final = 15
_META_L4PROTO: Final = 16
_META_TIME_NS: Final = 30
_NETWORK: Final = 1
_TRANSPORT: Final = 2
_EQUAL: Final = 0
_LESS: Final = 2
_TO_NETWORK_ORDER: Final = 1
_LAYOUTS: Final = {4: (2, 12, 16), 6: (10, 8, 24)}
"""By version of IP: NFPROTO_*, and where the source's and the destination's address stand in the header."""

End = tuple[str, int]
"""Address and port."""
_Message = tuple[int, int, bytes]
"""Kind, flags, and what follows the header."""


class Connection(Struct, frozen=True):
    """The two ends of a TCP connection, as its packets name them: IPv4 where both are.

    Attributes:
        ours: the end whose packets are dropped on their way out.
    """

    ours: End
    peer: End

    @classmethod
    def between(cls, ours: Sequence[object], peer: Sequence[object]) -> Connection:
        """The connection of two addresses as getsockname(2) and getpeername(2) tell them."""
        return cls(*((_plain(str(end[0])), int(str(end[1]))) for end in (ours, peer)))

    @property
    def table(self) -> str:
        """How its table is called."""
        return f"{PREFIX}{hashlib.blake2s(repr((self.ours, self.peer)).encode(), digest_size=12).hexdigest()}"


def _plain(host: str) -> str:
    return host.partition("%")[0].removeprefix("::ffff:")


def impose(connections: Iterable[Connection]) -> None:
    """Silence them, all at once; those that are silent already are for as long again.

    Raises:
        OSError: we may not (CAP_NET_ADMIN), or this kernel has no nf_tables.
    """
    now_ns = time.time_ns()
    until_ns = now_ns + SILENCE_S * NS_PER_S
    spent = [message for table, end_ns in _tables() if end_ns <= now_ns for message in _removal(table)]
    _transact(spent + [message for one in connections for message in (*_removal(one.table), *_rules(one, until_ns))])


def lift(connections: Iterable[Connection]) -> None:
    """Let them be heard again; those that are not silent stay as they are.

    Raises:
        OSError: we may not, or this kernel has no nf_tables.
    """
    _transact([message for one in connections for message in _removal(one.table)])


def _removal(table: str) -> list[_Message]:
    """Whether it is there or not: it is made, which changes one that is there in nothing, and then taken away."""
    return [_message(_NEW_TABLE, _CREATE, _text(1, table)), _message(_DELETE_TABLE, 0, _text(1, table))]


def _tables() -> Iterator[tuple[str, int]]:
    """All tables of connections on this machine, and until when each has an effect."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, NETLINK_NETFILTER) as asked:
        asked.settimeout(ANSWER_S)
        question = _GENERAL.pack(_FAMILY_INET, 0, 0)
        asked.send(_HEADER.pack(_HEADER.size + len(question), _GET_TABLE, _REQUEST | _DUMP, 1, 0) + question)
        while True:
            for kind, content in _answers(asked.recv(1 << 16)):
                if kind != _NEW_TABLE:
                    return
                found = dict(_attributes(content[_GENERAL.size :]))
                name, until = found.get(1, b"").rstrip(b"\0").decode(), found.get(_USER_DATA, b"")
                if name.startswith(PREFIX) and len(until) == _UNTIL.size:
                    yield name, _UNTIL.unpack(until)[0]


def _answers(told: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + _HEADER.size <= len(told):
        size, kind, *_ = _HEADER.unpack_from(told, place)
        yield kind, told[place + _HEADER.size : place + size]
        place += max(-(-size // 4) * 4, _HEADER.size)


def _attributes(content: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + 4 <= len(content):
        size, kind = struct.unpack_from("<HH", content, place)
        yield kind, content[place + 4 : place + size]
        place += max(-(-size // 4) * 4, 4)


def _rules(one: Connection, until_ns: int) -> list[_Message]:
    """The table of a connection: it drops packets in both directions."""
    table = one.table
    messages = [_message(_NEW_TABLE, _CREATE, _text(1, table) + _attribute(_USER_DATA, _UNTIL.pack(until_ns)))]
    for name, hook, source, target in (("input", _INPUT, one.peer, one.ours), ("output", _OUTPUT, one.ours, one.peer)):
        place = _nested(4, _number(1, hook) + _number(2, _BEFORE_ALL & 0xFFFFFFFF))
        chain = _text(1, table) + _text(3, name) + place + _number(5, _ACCEPT) + _text(7, "filter")
        messages.append(_message(_NEW_CHAIN, _CREATE, chain))
        rule = _text(1, table) + _text(2, name) + _nested(4, _dropping(source, target, until_ns))
        messages.append(_message(_NEW_RULE, _CREATE | _APPEND, rule))
    return messages


def _dropping(source: End, target: End, until_ns: int) -> bytes:
    """The expressions of a rule: a packet of TCP from here to there, until then, is dropped."""
    addresses = [ip_address(end[0]) for end in (source, target)]
    protocol, *places = _LAYOUTS[addresses[0].version]
    matched = _meta(_META_NFPROTO) + _compared(_EQUAL, bytes([protocol]))
    matched += _meta(_META_L4PROTO) + _compared(_EQUAL, bytes([socket.IPPROTO_TCP]))
    for place, address in zip(places, addresses, strict=True):
        matched += _loaded(_NETWORK, place, len(address.packed)) + _compared(_EQUAL, address.packed)
    ports = struct.pack(">HH", source[1], target[1])
    matched += _loaded(_TRANSPORT, 0, len(ports)) + _compared(_EQUAL, ports)
    ordered = _number(1, _REGISTER) + _number(2, _REGISTER) + _number(3, _TO_NETWORK_ORDER) + _number(4, 8) + _number(5, 8)
    matched += _meta(_META_TIME_NS) + _expression("byteorder", ordered) + _compared(_LESS, struct.pack(">Q", until_ns))
    verdict = _nested(2, _nested(2, _number(1, _DROP)))
    return matched + _expression("immediate", _number(1, 0) + verdict)


def _meta(key: int) -> bytes:
    return _expression("meta", _number(1, _REGISTER) + _number(2, key))


def _loaded(base: int, offset: int, size: int) -> bytes:
    return _expression("payload", _number(1, _REGISTER) + _number(2, base) + _number(3, offset) + _number(4, size))


def _compared(operation: int, value: bytes) -> bytes:
    return _expression("cmp", _number(1, _REGISTER) + _number(2, operation) + _nested(3, _attribute(1, value)))


def _expression(name: str, content: bytes) -> bytes:
    return _nested(1, _text(1, name) + _nested(2, content))


def _attribute(kind: int, content: bytes) -> bytes:
    return struct.pack("<HH", 4 + len(content), kind) + content + bytes(-len(content) % 4)


def _nested(kind: int, content: bytes) -> bytes:
    return _attribute(kind | _NESTED, content)


def _text(kind: int, text: str) -> bytes:
    return _attribute(kind, text.encode() + b"\0")


def _number(kind: int, value: int) -> bytes:
    return _attribute(kind, struct.pack(">I", value))


def _message(kind: int, flags: int, attributes: bytes) -> _Message:
    return kind, _REQUEST | flags, _GENERAL.pack(_FAMILY_INET, 0, 0) + attributes


def _transact(messages: Sequence[_Message]) -> None:
    """Have the kernel obey all of them, or none; it tells of the last one, and of each that it does not obey.

    Of hundreds it could not tell: its answers have to fit in our buffer before we read the first (ENOBUFS, and all was obeyed).

    Raises:
        OSError: none.
    """
    if not messages:
        return
    mark = _GENERAL.pack(0, 0, _SUBSYSTEM)
    *others, (last, flags, content) = messages
    told = (last, flags | _ACKNOWLEDGE, content)
    batch = [(_BATCH_BEGIN, _REQUEST, mark), *others, told, (_BATCH_END, _REQUEST, mark)]
    packed = b"".join(
        _HEADER.pack(_HEADER.size + len(content), kind, flags, number, 0) + content
        for number, (kind, flags, content) in enumerate(batch)
    )
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, NETLINK_NETFILTER) as asked:
        asked.settimeout(ANSWER_S)
        with contextlib.suppress(PermissionError):  # it suffices for some hundred connections as it is
            asked.setsockopt(socket.SOL_SOCKET, SO_SNDBUFFORCE, len(packed))
        asked.send(packed)
        while not _is_acknowledged(asked.recv(1 << 16)):
            pass


def _is_acknowledged(answer: bytes) -> bool:
    """Whether the last message was obeyed, and so all.

    Raises:
        OSError: one was not, so none will be.
    """
    is_told = False
    for kind, content in _answers(answer):
        if kind == _ERROR:
            code = -int.from_bytes(content[:4], "little", signed=True)
            if code:
                raise OSError(code, f"nf_tables: {os.strerror(code)}")
            is_told = True
    return is_told
