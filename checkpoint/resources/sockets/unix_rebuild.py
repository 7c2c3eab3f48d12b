"""Rebuild unix sockets in order: named ones, connections, connections that wait to be accepted, and then the waiting data.

The named sockets come first, ghosts before all others (see `checkpoint.resources.sockets.unix_names`). Connections that wait to
be accepted keep their order.

Each socket is made with the identity of its maker (`checkpoint.resources.sockets.peer_credentials`).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from typing import Final

from checkpoint.linux.net.unix_diag import ESTABLISHED, LISTENING
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import renamed_paths, sockets, unix
from checkpoint.resources.sockets.peer_credentials import Disguise
from checkpoint.resources.sockets.sockets import Way
from checkpoint.resources.sockets.unix_names import NOT_WAITING, Naming, is_abandoned, is_ghost, packed

CLOSE_ON_EXEC: Final = socket.SOCK_CLOEXEC


def _list(fact: Fact) -> list[Fact]:
    assert isinstance(fact, list)
    return fact


def _of(held: Resource, name: str) -> int:
    return number_of(held.facts[name])


def _bytes_of(held: Resource, name: str) -> bytes:
    fact = held.facts[name]
    assert isinstance(fact, bytes)
    return fact


def _name_of(held: Resource) -> bytes:
    return _bytes_of(held, "name")


class Work:
    """One restore of unix sockets."""

    def __init__(
        self, table: CallTable, held: Sequence[Resource], first: int, *, disguise: Disguise, working_directory: str
    ) -> None:
        """
        Args:
            first: the number from which on no descriptor is wanted.
            working_directory: where the vessel is.
        """
        self._table = table
        self._held = {_of(one, "socket"): one for one in held}
        self._awaited = unix.awaited_here(held)
        self._next = first
        self._disguise = disguise
        self._working = working_directory
        self._naming = Naming(table, working_directory, self._away)
        self._made: dict[int, int] = {}
        self._closing: list[int] = []
        self._others: dict[int, int] = {}

    @property
    def end(self) -> int:
        """The first number after those that they stand at."""
        return self._next

    def run(self) -> dict[int, int]:
        """Make them all."""
        alone = [one for one in self._held.values() if self._stands_alone(one)]
        for one in sorted(alone, key=lambda one: (is_ghost(one), renamed_paths.is_moved(one.facts)), reverse=True):
            self._alone(one)
        for inode, one in self._held.items():
            if inode not in self._made and not self._waits_here(one):
                self._others |= self._connect(one)
        for one in self._held.values():
            for client in map(number_of, _list(one.facts.get("clients", []))):
                if client in self._held:  # of another process: it stays behind
                    self._wait_at(one, self._held[client])
        return self._made

    def _waits_here(self, one: Resource) -> bool:
        """Whether it waits to be accepted by the program itself."""
        return one.facts.get("not_accepted", NOT_WAITING) != NOT_WAITING and _of(one, "socket") in self._awaited

    def _ends(self, one: Resource) -> bool:
        """Whether it was connected to another process."""
        return unix.leads_outside(one, self._held, self._awaited)

    def fill(self) -> None:
        """Send what waits in them, connect those for datagrams, shut down what is; descriptors on their way are there by now."""
        table = self._table
        with self._disguise.as_program(table):
            for one in self._held.values():
                self._fill(one)
        for one in self._held.values():
            self._connect_datagrams(one)
        for inode, one in self._held.items():
            if how := _of(one, "shutdown"):
                table.attempt("", "shutdown", self._made[inode], sockets.SHUTDOWN_HOW[how])
            sockets.set_flags(table, one, self._made[inode])
        for number in (*self._closing, *self._naming.closing):
            table.close(number)

    def notes(self) -> tuple[str, ...]:
        """Sentences about differences."""
        ended = [one for one in self._held.values() if self._ends(one)]
        kept = (one for one in self._held.values() if one not in ended)
        return (*map(unix.note, ended), *self._disguise.notes(kept))

    def _away(self, made: int) -> int:
        """Move a descriptor above all that are wanted."""
        number, self._next = self._next, self._next + 1
        self._table.duplicate(made, number, os.O_CLOEXEC)
        self._table.close(made)
        return number

    def _keep(self, one: Resource, made: int) -> None:
        self._made[_of(one, "socket")] = self._away(made)

    # Alone, or with a name

    def _is_pair(self, one: Resource) -> bool:
        """Whether both ends are the program's and know each other, without the help of a name."""
        other = self._held.get(_of(one, "peer"))
        if other is None or other is one or _of(other, "peer") != _of(one, "socket"):
            return False
        names = [bool(_name_of(end)) for end in (one, other)]
        return not all(names) if _of(one, "type") == socket.SOCK_DGRAM else not any(names)

    def _stands_alone(self, one: Resource) -> bool:
        """Whether it is no end of a connection: it may be connected to a name for all that."""
        if _of(one, "state") != ESTABLISHED:
            return True
        if _of(one, "type") != socket.SOCK_DGRAM or self._is_pair(one):
            return False
        return bool(_name_of(one) or (one.facts["peer_name"] and _of(one, "peer") in self._held))

    def _alone(self, one: Resource) -> None:
        table = self._table
        made = sockets.make(table, one)
        self._keep(one, made)
        made = self._made[_of(one, "socket")]
        if _name_of(one):
            self._naming.bind(one, made)
        if _of(one, "state") == LISTENING:
            with self._disguise.as_maker(table, one):
                table.call(f"listen at {one.name}", "listen", made, _of(one, "backlog"))

    # Connections

    def _connect(self, one: Resource) -> dict[int, int]:
        """Make a connection: where its other end is gone, the number that stands for that end, by the socket's."""
        other = self._held.get(_of(one, "peer"))
        if other is None:
            ours, theirs = (self._away(number) for number in self._pair(one))
            self._made[_of(one, "socket")] = ours
            sockets.set_options(self._table, one, ours)
            self._closing.append(theirs)
            return {_of(one, "socket"): theirs}
        named = None if self._is_pair(one) else next((end for end in (one, other) if _name_of(end)), None)
        ends = self._pair(one) if named is None else self._through_listener(named, other if named is one else one)
        order = (one, other) if named is None or named is one else (other, one)
        for end, number in zip(order, ends, strict=True):
            self._keep(end, number)
        for end in order:
            sockets.set_options(self._table, end, self._made[_of(end, "socket")])
            if named is None and _name_of(end):
                self._naming.bind(end, self._made[_of(end, "socket")])
        return {}

    def _pair(self, one: Resource) -> tuple[int, int]:
        kind = _of(one, "type") | CLOSE_ON_EXEC
        place = self._table.place(bytes(8))
        ends = self._ends(one)
        with self._disguise.as_program(self._table) if ends else self._disguise.as_maker(self._table, one):
            return self._table.obtain_pair(f"make the sockets of {one.name}", "socketpair", socket.AF_UNIX, kind, 0, place)

    def _through_listener(self, named: Resource, client: Resource) -> tuple[int, int]:
        """Connect to a listener of that name and accept: (the accepted end, the client's)."""
        table = self._table
        listener = self._listener_of(named)
        lent = self._temporary_listener(named, client) if listener is None else self._made[_of(listener, "socket")]
        connecting = self._ask(listener or named, named, client)
        accepted = table.obtain(f"accept the connection of {named.name}", "accept4", lent, 0, 0, CLOSE_ON_EXEC)
        if listener is None:
            table.close(lent)
        return accepted, connecting

    def _listener_of(self, named: Resource) -> Resource | None:
        """The program's listener at the file, or the abstract name, that an accepted end has."""

        def place_of(one: Resource) -> tuple[Fact, ...]:
            return one.facts["name"], one.facts["path"], is_ghost(one)

        alike = (one for one in self._held.values() if _of(one, "state") == LISTENING and place_of(one) == place_of(named))
        return next(alike, None)

    def _ask(self, listener: Resource, accepted: Resource | None, client: Resource) -> int:
        """A client's socket, connected to a listener as the user that connected it.

        Args:
            accepted: the other end, which tells that user; None of one that is not there yet.
        """
        table = self._table
        connecting = sockets.make(table, client)
        if _name_of(client):
            self._naming.bind(client, connecting)
        address = self._naming.address_of(listener)
        arguments = (connecting, table.place(address), len(address))
        if accepted is None:
            with self._disguise.as_program(table):
                table.call(f"connect {client.name}", "connect", *arguments)
        else:
            with self._disguise.as_maker(table, accepted):
                table.call(f"connect {client.name}", "connect", *arguments)
        return connecting

    def _temporary_listener(self, named: Resource, client: Resource) -> int:
        """A listener in place of the one that an accepted end came from, made as the user that the client tells."""
        table = self._table
        form = (socket.AF_UNIX, _of(named, "type") | CLOSE_ON_EXEC, 0)
        lent = table.obtain(f"make a listener for {named.name}", "socket", *form)
        self._naming.bind(named, lent)
        with self._disguise.as_maker(table, client):
            table.call(f"listen for {named.name}", "listen", lent, 1)
        return lent

    def _wait_at(self, listener: Resource, client: Resource) -> None:
        """Connect a client whose connection is not accepted yet."""
        self._keep(client, self._ask(listener, None, client))

    # Datagrams, and what waits

    def _connect_datagrams(self, one: Resource) -> None:
        """Connect a socket for datagrams to the name that it was connected to."""
        name, table = one.facts["peer_name"], self._table
        if _of(one, "type") != socket.SOCK_DGRAM or not name or self._is_pair(one):
            return
        assert isinstance(name, bytes)
        peer = self._held.get(_of(one, "peer"))
        address = packed(name) if peer is None else self._naming.address_of(peer)
        lost = f"{one.name} is not connected to {os.fsdecode(name)!r}, where no socket receives here"
        table.attempt(lost, "connect", self._made[_of(one, "socket")], table.place(address), len(address))

    def _fill(self, one: Resource) -> None:
        """Send what waits in one of them, each datagram from the name that it came from."""
        messages = _list(one.facts["queue"])
        is_refused = self._ends(one) and one.facts.get("not_accepted", NOT_WAITING) != NOT_WAITING
        if one.facts.get("reset") or is_refused:  # the end that is closed soon has something unread, as it had
            number, byte = self._made[_of(one, "socket")], self._table.place(bytes(1))
            self._table.attempt("", "sendto", number, byte, 1, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL, 0, 0)
        if not messages:
            return
        told = one.facts["sources"] or []  # versions before said False where none has any
        sources = [source if isinstance(source, bytes) else b"" for source in _list(told)] or [b""] * len(messages)
        has_other_end = _of(one, "socket") in self._others  # which alone reaches it
        ways = {
            source: self._from(one, source) if source and not has_other_end else self._way_to(one)
            for source in dict.fromkeys(sources)
        }
        sockets.fill(self._table, one, [ways[source] for source in sources])

    def _way_to(self, one: Resource) -> Way:
        """How a message arrives at a socket."""
        inode, peer = _of(one, "socket"), _of(one, "peer")
        if inode in self._others:
            return Way(self._others[inode])
        if peer in self._made and (_of(one, "type") != socket.SOCK_DGRAM or self._is_pair(one)):
            return Way(self._made[peer], sender=self._held[peer])
        return Way(self._fresh(one), self._naming.address_of(one))

    def _from(self, one: Resource, source: bytes) -> Way:
        """How a message arrives at a socket from a name: the program's own socket sends it, else one that is made for it."""
        for inode, held in self._held.items():
            if _name_of(held) == source and _of(held, "type") == socket.SOCK_DGRAM:
                is_other_end = inode == _of(one, "peer") and self._is_pair(one)
                return Way(self._made[inode], b"" if is_other_end else self._naming.address_of(one), held)
        table, sender = self._table, self._fresh(one)
        path = os.fsdecode(source.rstrip(b"\0")) if source[:1] != b"\0" else ""
        place, address = table.place(source.rstrip(b"\0") + b"\0"), packed(source)
        may_remove = bool(path) and is_abandoned(os.path.join(self._working, path))
        if may_remove:
            table.attempt("", "unlinkat", AT_FDCWD, place, 0)
        lost = f"the data that waits in {one.name} came from {os.fsdecode(source)!r}, and has no sender now"
        table.attempt(lost, "bind", sender, table.place(address), len(address))
        if may_remove:
            table.attempt("", "unlinkat", AT_FDCWD, place, 0)
        return Way(sender, self._naming.address_of(one))

    def _fresh(self, one: Resource) -> int:
        form = (socket.AF_UNIX, _of(one, "type") | CLOSE_ON_EXEC, 0)
        sender = self._table.obtain(f"make a sender for {one.name}", "socket", *form)
        self._closing.append(sender)
        return sender
