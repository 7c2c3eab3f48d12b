"""Restore unix sockets: pairs with both ends in the program, its connections with itself, listeners, sockets for datagrams.

Waiting data is restored, in the same messages, from the same names; so are connections that wait to be accepted. A socket for
datagrams that was connected to a name outside (``/dev/log``) is connected to that name again.
`checkpoint.resources.sockets.unix_rebuild` says how they are made again.

A connection with another process cannot be made again: the other end stays behind. The program finds what it finds when that
process has died: what it had received, then the end of file; EPIPE where it sends; ECONNRESET where its connection was not
accepted yet. A socket for datagrams whose peer has no name, or is not there, finds ECONNREFUSED once, then ENOTCONN.

Facts besides those of every socket, of `checkpoint.resources.sockets.unix_names` and of
`checkpoint.resources.sockets.peer_credentials`: ``state`` of `checkpoint.linux.net.unix_diag`; ``name``; ``peer``: inode number
of its other end, 0 when that is gone; ``peer_name``; ``backlog``; ``shutdown``; ``clients``: the sockets whose connections wait
to be accepted, inode numbers in their order; ``passed``: for each message in the queue the descriptors that came with it, as
numbers of the program's own, or of ``travelling``; no list if none has any; ``too_long``: the queue is; ``urgent``: an
out-of-band byte waits; ``reset``: its peer has gone without reading all, and the program has not been told yet (ECONNRESET);
``sources``: for each message in the queue the name of its sender; no list if none has any; ``not_accepted``: for a socket whose
own connection waits, how much of what it sent is unread, -1 for any other.

Source: unix(7).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from checkpoint.capability import Area, by_rule, preserved, refused
from checkpoint.engine import REFUSED, Finding
from checkpoint.errors import CaptureError
from checkpoint.linux.net.unix_diag import ESTABLISHED, UnixSocket, parsed
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import peer_credentials, scm_rights, sockets, unix_names
from checkpoint.resources.sockets.unix_names import NOT_WAITING
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "unix_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "unix sockets that only the program has",
        "pairs and connections with the data in them, descriptors on their way included",
    ),
    preserved(
        Area.SOCKETS,
        "unix listeners, and unix sockets for datagrams",
        "bound to their names again, or connected to the same names again",
    ),
    by_rule(
        Area.SOCKETS,
        "unix sockets connected to another process (D-Bus, X, a logger’s stream)",
        "the program sees the same as if its peer had died: the bytes that it had received, then the end of file; EPIPE where it "
        "sends. It may exit, unless it connects again; failover check says so beforehand. A socket for datagrams (/dev/log) is "
        "connected to the same name again. Connections that wait at a listener of the program end",
        "the unix socket {} with {} ends",
        "as if its peer had died",
        "do so",
    ),
    refused(
        Area.SOCKETS,
        'a connection with others, of TCP or of a unix socket, where the operator wants that (`connections = "refuse"`)',
        f"wait: {AS_SOON_AS} the program has closed the connection",
    ),
    refused(
        Area.SOCKETS,
        "a unix socket with descriptors on their way between several processes, with an out-of-band byte, or with over 4 "
        "MiB of data that waits",
        f"wait: {AS_SOON_AS} the program has taken them",
        "in which an out-of-band byte waits (MSG_OOB): {}",
        "with descriptors on their way",
        "MiB wait: {}",
    ),
    refused(
        Area.SOCKETS,
        "a unix listener where a connection waits of a process of the program that has sent data already, or of a client that "
        "has gone",
        f"wait: {AS_SOON_AS} the program has accepted the connection",
        "waits to be accepted",
    ),
)

BOTH_DIRECTIONS: Final = 3
_ACCEPTED: Final = f"{AS_SOON_AS} the program has accepted it"
_EXITING: Final = (
    ("dbus", "clients of libdbus and GDBus do so by default"),
    ("/bus", "clients of libdbus and GDBus do so by default"),
    (".X11-unix", "clients of Xlib do so"),
    ("wayland-", "most clients of Wayland do so"),
)
"""The known behaviour of clients, by a part of the name of their server."""


def observe(held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None) -> dict[str, Fact]:
    """Its state, its peer and what waits in it.

    Args:
        noted: see `sockets.queue_of`.

    Raises:
        OSError: it cannot be looked into.
        CaptureError: the kernel does not tell.
    """
    answer = opened.listings.unix_answer(held.first.inode)
    if (told := parsed(answer)) is None:
        raise CaptureError(f"cannot ask the kernel about the unix socket {held.name} (sock_diag): load the module unix_diag")
    facts = sockets.general_facts(held, looked, opened)
    has_queue = told.state == ESTABLISHED or told.type == socket.SOCK_DGRAM
    identify = partial(scm_rights.number_of, opened)
    queue = sockets.queue_of(looked, held.first.number, noted, identify) if has_queue else sockets.NOTHING
    return (
        facts
        | unix_names.observe(held, looked, told.name, told.file)
        | peer_credentials.observe(looked)
        | {
            "state": told.state,
            "name": told.name,
            "peer": told.peer,
            "peer_is_ours": _is_ours(told.peer, held, opened),
            "peer_name": _peer_name(looked),
            "backlog": told.backlog,
            "shutdown": told.shutdown,
            "clients": list(told.clients),
            "not_accepted": sockets.unsent(looked) if _waits(told) else NOT_WAITING,
            "queue": list(queue.messages),
            "passed": [list(numbers) for numbers in queue.passed] if any(queue.passed) else [],
            "too_long": queue.too_long,
            "urgent": queue.urgent,
            "reset": queue.reset,
            "sources": list(map(_packed_name, queue.sources)) if told.type == socket.SOCK_DGRAM and any(queue.sources) else [],
        }
    )


def again(held: OpenFile, facts: Mapping[str, Fact], opened: Opened) -> Mapping[str, Fact]:
    """Facts of a socket that answers as before, and of what they say of others: its peer, and the file that is its name.

    Raises:
        OSError: it was closed meanwhile.
    """
    found: dict[str, Fact] = {**facts, "peer_is_ours": _is_ours(number_of(facts["peer"]), held, opened)}
    name = facts["name"]
    assert isinstance(name, bytes)
    if name and name[:1] != b"\0":
        told = parsed(opened.listings.unix_answer(held.first.inode))
        with sockets.looked_into(held.pid, held.first.number) as looked:
            found |= unix_names.observe(held, looked, name, told.file if told else None)
    return found if found != facts else facts


def _is_ours(peer: int, held: OpenFile, opened: Opened) -> bool:
    return peer in opened.inodes or peer in held.kin.sockets


def _waits(told: UnixSocket) -> bool:
    """Whether a socket is connected and waits to be accepted: its other end has no number yet."""
    return told.state == ESTABLISHED and told.type != socket.SOCK_DGRAM and not told.peer and told.shutdown != BOTH_DIRECTIONS


def _packed_name(source: object) -> bytes:
    """A sender's name as bind(2) was told it, without the address's head; b"" for none."""
    if not source:
        return b""
    return source if isinstance(source, bytes) else os.fsencode(str(source)) + b"\0"


def _peer_name(looked: socket.socket) -> bytes:
    try:
        name = looked.getpeername()
    except OSError:
        return b""
    return name if isinstance(name, bytes) else os.fsencode(name)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The socket as it was observed."""
    if held.observed.get("family") != socket.AF_UNIX:
        return None
    facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed}
    return Resource(KIND, held.name, facts | {"maker": peer_credentials.by_its_own_number(facts["maker"])})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a unix socket cannot be kept."""
    seen = held.observed
    if seen.get("family") != socket.AF_UNIX:
        return None
    what = f"{held.name} is a unix socket"
    if any(isinstance(numbers, list) and sockets.UNKNOWN in numbers for numbers in _list(seen["passed"])):
        return f"{what} with descriptors on their way in it (SCM_RIGHTS) that failover cannot examine: {AS_SOON_AS} they arrive"
    if seen["passed"] and held.kin.pids and held.lent is None:
        return f"{what} with descriptors on their way in it between several processes: {AS_SOON_AS} the program has received them"
    if 0 in _list(seen["clients"]):
        return f"{what} where a connection waits to be accepted whose client has gone: {_ACCEPTED}"
    if seen["urgent"]:
        return f"{what} in which an out-of-band byte waits (MSG_OOB): {AS_SOON_AS} the program has read that"
    if seen["too_long"]:
        return f"{what} in which more than {sockets.QUEUE_LIMIT >> 20} MiB wait: {AS_SOON_AS} the program has read them"
    ends = _is_lost(seen) and bool(seen["peer"])  # another holder keeps what the program loses
    of_others = None if ends else other_holders.refuse(held, "a unix socket")
    return unix_names.refuse(held) or sockets.refuse_filter(held) or of_others


def findings(held: Sequence[Resource], surroundings: Surroundings) -> Iterator[Finding]:
    """Findings about all sockets together: which of them end, and connections that wait to be accepted."""
    ours = [one for one in held if one.kind == KIND]
    awaited = awaited_here(ours)
    known = {number_of(one.facts["socket"]) for one in ours}
    for one in ours:
        if number_of(one.facts["not_accepted"]) > 0 and number_of(one.facts["socket"]) in awaited:
            text = (
                f"{one.name} is a unix socket whose connection waits to be accepted with data in it, which failover cannot read"
            )
            yield Finding(KIND, one.name, REFUSED, f"{text}: {_ACCEPTED}")
        elif leads_outside(one, known, awaited):
            yield sockets.ends(KIND, one.name, note(one), surroundings, _may_exit(one))
        if count := len({number_of(client) for client in _list(one.facts["clients"])} - known - {0}):
            which = "1 connection that waits" if count == 1 else f"{count} connections that wait"
            text = f"{which} at {one.name} to be accepted end{'s' if count == 1 else ''}"
            yield sockets.ends(KIND, one.name, text, surroundings)


def awaited_here(held: Iterable[Resource]) -> set[int]:
    """The sockets whose connections wait at listeners among these, by their numbers."""
    return {number_of(inode) for one in held for inode in _list(one.facts.get("clients", []))}


def leads_outside(one: Resource, known: Collection[int], awaited: Collection[int]) -> bool:
    """Whether a socket is connected to another process, which it has no name of to be connected to again.

    Args:
        known: the program's own sockets, by their numbers.
    """
    facts = one.facts
    if facts.get("not_accepted", NOT_WAITING) != NOT_WAITING:
        return number_of(facts["socket"]) not in awaited
    peer = number_of(facts["peer"])
    return bool(peer) and peer not in known and _is_lost(facts)


def _is_lost(facts: Mapping[str, Fact]) -> bool:
    """Whether its peer, if it has one, is another process's, and has no name by which it could be connected to again."""
    return not facts.get("peer_is_ours") and not (facts["type"] == socket.SOCK_DGRAM and facts["peer_name"])


def note(one: Resource) -> str:
    """The sentence that a connection with another process ends."""
    own, peer = _name_for_people(one, "name"), _name_for_people(one, "peer_name")
    where = peer or (f"a client of {own}" if own else "another process")
    return f"the unix socket {one.name} with {where} ends"


def _may_exit(one: Resource) -> str:
    """The possible effect of that on a program that is no server."""
    peer = _name_for_people(one, "peer_name")
    if _name_for_people(one, "name") and not peer:
        return ""
    known = next((f" ({what})" for part, what in _EXITING if part in peer), "")
    return f", as if its peer had died: it may exit{known}, unless it connects again"


def _name_for_people(one: Resource, which: str) -> str:
    """A name for people."""
    name = one.facts[which]
    assert isinstance(name, bytes)
    return unix_names.in_words(name)


def _list(fact: Fact) -> list[Fact]:
    assert isinstance(fact, list)
    return fact
