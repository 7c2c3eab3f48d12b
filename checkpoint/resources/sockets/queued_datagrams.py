"""Send datagrams again that wait in UDP sockets, each from its original address, as far as this machine has it."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from typing import Final

from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import sockets
from checkpoint.resources.sockets.inet_addresses import in_words, size_of, sockaddr

_MAPPED: Final = "::ffff:"
"""Before an address of IPv4 where a socket of IPv6 tells or takes it."""
_ALL: Final = ("0.0.0.0", "::")


def send_again(table: CallTable, one: Resource, held: Sequence[Resource], made: Mapping[int, int]) -> None:
    """Send the datagrams that waited, each from the address that it came from, if that is this machine's."""
    messages, sources, address = one.facts["queue"], one.facts["sources"], one.facts["address"]
    assert isinstance(messages, list) and isinstance(sources, list) and isinstance(address, list)
    if not address:
        return
    for message, source in zip(messages, sources, strict=True):
        assert isinstance(message, bytes) and isinstance(source, list)
        sender = next((each for each in held if _has_sent(each, source, one)), None)
        if sender is None and not _is_free(source, number_of(one.facts["protocol"])):
            continue
        target = _reachable(address, source, one if sender is None else sender)
        lent = made[number_of(sender.facts["socket"])] if sender is not None else _sender(table, one, source)
        arguments = (
            lent,
            table.place(message),
            len(message),
            socket.MSG_DONTWAIT,
            table.place(sockaddr(target)),
            size_of(target),
        )
        corks = sender is not None and sockets.has_option(sender, *sockets.UDP_CORK)
        if corks:
            _cork(table, lent, 0)
        table.attempt(f"a datagram that waited in {one.name} is lost", "sendto", *arguments)
        if corks:
            _cork(table, lent, 1)
        if sender is None:
            table.close(lent)


def _has_sent(held: Resource, source: Sequence[Fact], receiver: Resource) -> bool:
    """Whether this one sent datagrams from an address: it is bound to that, or to its port at every address."""
    address = held.facts["address"]
    assert isinstance(address, list)
    if not address or address[1] != source[1] or held.facts["protocol"] != receiver.facts["protocol"]:
        return False
    hosts = [str(end[0]).removeprefix(_MAPPED) for end in (address, source)]
    if hosts[0] not in _ALL:
        return hosts[0] == hosts[1]
    speaks_four = held.facts["family"] == socket.AF_INET or not sockets.has_option(held, *sockets.V6ONLY)
    return speaks_four if ":" not in hosts[1] else held.facts["family"] == socket.AF_INET6


def _reachable(address: list[Fact], source: Sequence[Fact], sender: Resource) -> list[Fact]:
    """Where a sender sends to what is bound to an address: itself, if that is all of this machine's.

    Args:
        source: the sender's address, as the receiver tells it.
    """
    host, is_four = str(address[0]), ":" not in str(source[0]).removeprefix(_MAPPED)
    if host in _ALL:
        host = "127.0.0.1" if is_four else "::1"
    host = host.removeprefix(_MAPPED)
    if ":" not in host:
        return [f"{_MAPPED}{host}", address[1], 0, 0] if sender.facts["family"] == socket.AF_INET6 else [host, address[1]]
    return [host, *address[1:]]


def _cork(table: CallTable, sender: int, is_on: int) -> None:
    table.call("let a datagram go", "setsockopt", sender, *sockets.UDP_CORK, table.place(is_on.to_bytes(4, "little")), 4)


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
    lost = f"the data that waits in {one.name} came from {in_words(source)}, and has no sender now"
    table.attempt(lost, "bind", made, table.place(sockaddr(source)), size_of(source))
    return made
