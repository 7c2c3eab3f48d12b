"""Hand over TCP connections with other machines when a program moves (rule ``carry``): the peer notices only a pause.

That holds only where the program continues from the very state in which it was frozen for the last time: after a handover, after
a failback, after a ``failover capture`` that ends it. After a crash, the peer has received data, and was told that its own data
has arrived, and the checkpoint knows nothing of both. No kernel sends again what has arrived, so the connection would hang for
ever, or continue with bytes missing. So only a *held* snapshot takes connections along, and only a restore that knows that
nothing ran since takes them over. In all other cases they are reset, as `checkpoint.resources.sockets.tcp` says.

From the capture until it is taken over, a connection is silent (`checkpoint.linux.net.packet_drop`), on both machines.

One more fact besides those of `checkpoint.resources.sockets.tcp`: ``carried``, a map with the fields of
`checkpoint.linux.net.tcp_repair.Kept`.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final, NoReturn

import msgspec
from msgspec import Struct, field
from msgspec.structs import asdict, replace

from checkpoint.capability import Area, by_rule
from checkpoint.errors import CheckpointError, MismatchError, RestoreError
from checkpoint.linux.net import packet_drop, tcp_repair, time_wait
from checkpoint.linux.net.packet_drop import Connection
from checkpoint.linux.net.tcp_repair import CannotCarryError, InUseError, Kept
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.model import Fact, Resource, Snapshot
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import inet_addresses, tcp
from checkpoint.resources.sockets.tcp import KIND, LEFT, TAKEN
from checkpoint.sentences import in_words

CAPABILITIES: Final = (
    by_rule(
        Area.SOCKETS,
        'TCP connections with others (`connections = "carry"`)',
        "a handover, a failback, and `failover capture` with `restore` carry established connections, with the data in "
        "them (TCP_REPAIR); their address must follow (docs/connections.md). After a crash they are reset",
        "it takes CAP_NET_ADMIN",
        "continues once this machine has its address",
    ),
)

END_S: Final = 2.0
"""How long the end of the process that had a connection is waited for."""
PAUSE_S: Final = 0.01
TRACED: Final = "t"
"""State of a process that its tracer holds. Source: proc_pid_stat(5)."""


# --- Captured ----------------------------------------------------------------------------------------------------------


class Departing(Struct, frozen=True):
    """The connections of a program that stands still, and may do so for good.

    Attributes:
        silent: those that are taken along.
        facts: additional facts for each resource, by the socket's number.
    """

    silent: tuple[Connection, ...] = ()
    facts: Mapping[int, Mapping[str, Fact]] = field(default_factory=dict)

    def added_to(self, state: Snapshot) -> Snapshot:
        """A snapshot with what is known of its connections."""
        return _changed(state, self._with_facts) if self.facts else state

    def _with_facts(self, held: Resource) -> Resource:
        more = self.facts.get(number_of(held.facts["socket"])) if held.kind == KIND else None
        return replace(held, facts={**held.facts, **more}) if more else held

    def stay(self, pid: int) -> None:
        """The program is let go of: it is heard again, unless it was killed meanwhile."""
        with contextlib.suppress(CheckpointError, OSError):
            if self.silent and procfs.status(pid).state == TRACED:
                packet_drop.lift(self.silent)


NOBODY: Final = Departing()


def depart(opened: Iterable[OpenFile]) -> Departing:
    """Silence and read the connections of a program that stands still.

    Args:
        opened: its open files, as they were observed.
    """
    wanted = {number_of(one.observed["socket"]): one for one in _with_others(opened)}
    between = {number: _connection(one.observed) for number, one in wanted.items()}
    if not wanted:
        return NOBODY
    try:
        packet_drop.impose(between.values())
    except OSError as error:
        with contextlib.suppress(OSError):  # it may have been obeyed for all that
            packet_drop.lift(between.values())
        return Departing((), {number: {LEFT: _without_right(error)} for number in wanted})
    facts: dict[int, dict[str, Fact]] = {}
    try:
        for number, one in wanted.items():
            facts[number] = _looked_at(one)
    except BaseException:
        packet_drop.lift(between.values())
        raise
    packet_drop.lift(between[number] for number, found in facts.items() if TAKEN not in found)
    return Departing(tuple(between[number] for number, found in facts.items() if TAKEN in found), facts)


def _with_others(opened: Iterable[OpenFile]) -> Iterator[OpenFile]:
    """Connections that live, and whose other end is not the program's, too."""
    own = (one for one in opened if one.lent is None)  # of another the program has no descriptor that could be given to it
    living = [(one, _connection(one.observed)) for one in own if tcp.is_carriable(one.observed)]
    ends = {(between.peer, between.ours) for _, between in living}
    for one, between in living:
        if (between.ours, between.peer) not in ends:
            yield one


def _connection(facts: Mapping[str, Fact]) -> Connection:
    address, peer = facts["address"], facts["peer"]
    assert isinstance(address, list) and isinstance(peer, list)
    return Connection.between(address, peer)


def _looked_at(one: OpenFile) -> dict[str, Fact]:
    try:
        if os.stat(f"/proc/{one.pid}/ns/net").st_ino != os.stat("/proc/self/ns/net").st_ino:
            return {LEFT: "the program lives in a network namespace of its own"}
        with copy_of(one.pid, one.first.number) as descriptor, _borrowed(descriptor) as looked:
            kept = tcp_repair.read(looked)
    except CannotCarryError as reason:
        return {LEFT: str(reason)}
    except OSError as error:
        return {LEFT: _without_right(error)}
    return {TAKEN: {**asdict(kept), "buffers": list(kept.buffers)}}


def _without_right(error: OSError) -> str:
    return f"{error.strerror}: it takes CAP_NET_ADMIN, and a kernel with nf_tables and TCP_REPAIR"


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    lent = socket.socket(fileno=descriptor)
    try:
        yield lent
    finally:
        lent.detach()


def heard_again(opened: Iterable[OpenFile]) -> None:
    """Let connections be heard again that a keeper had silenced before it died and left the program running."""
    found = list(_with_others(opened))
    with contextlib.suppress(OSError):  # then no keeper could have silenced them either
        for one in found:
            with copy_of(one.pid, one.first.number) as descriptor, _borrowed(descriptor) as looked:
                tcp_repair.leave_behind(looked)
        packet_drop.lift(_connection(one.observed) for one in found)


# --- Restored ----------------------------------------------------------------------------------------------------------


class _Arrival(Struct, frozen=True):
    """One connection.

    Attributes:
        process: which of the component's has it: its place among them.
    """

    process: int
    resource: Resource
    connection: Connection
    kept: Kept


class Arriving:
    """Connections that a program takes up again: made once it has its descriptors, and heard from when it goes on.

    Attributes:
        notes: steps to take for them, and connections that were reset.
        established: connections that were open at the capture.
    """

    established = 0

    def __init__(
        self, arrivals: Iterable[_Arrival] = (), ended: Iterable[Connection] = (), state: Snapshot | None = None
    ) -> None:
        """
        Args:
            arrivals: connections that it takes up.
            ended: connections that have ended: this machine resets them, also where it was to be silent.
        """
        self._arrivals = tuple(arrivals)
        self._ended = tuple(ended)
        self.notes = tuple(_missing(one) for one in self._arrivals if not inet_addresses.is_ours(_ends(one.resource)[0]))
        if state is not None:
            everything = [held for told in state.processes for held in told.resources]
            self.notes += tcp.summary(everything)
            self.established = tcp.established(everything)
        self._made: list[tuple[socket.socket, _Arrival, int]] = []

    def connect(self, pids: Sequence[int]) -> None:
        """Turn the sockets that the processes were given into their connections. Their peers hear nothing yet.

        Args:
            pids: of the component's processes, as `checkpoint.snapshot.process_tree.views` orders them.

        Raises:
            RestoreError: one of them cannot be had any more.
        """
        for one in self._arrivals:
            descriptors = one.resource.facts["descriptors"]
            assert isinstance(descriptors, list) and isinstance(descriptors[0], list)
            try:
                with copy_of(pids[one.process], number_of(descriptors[0][0])) as descriptor:
                    made = socket.socket(fileno=os.dup(descriptor))
                reuse = made.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)
                self._made.append((made, one, reuse))
                tcp_repair.connect(made, one.kept, *_ends(one.resource))
                tcp_repair.fill(made, one.kept)
            except (CannotCarryError, OSError) as error:
                raise RestoreError(f"cannot take up the TCP connection {one.resource.name}: {in_words(error)}") from error

    def let_go(self) -> None:
        """They go on, a moment before their program does.

        Raises:
            RestoreError: the kernel does not let them.
        """
        try:
            for made, one, reuse in self._made:
                tcp_repair.set_free(made, one.kept, reuse)
            packet_drop.lift([one.connection for one in self._arrivals])
            for made, one, reuse in self._made:
                tcp_repair.ask_peer(made, one.kept, reuse)
                made.close()
        except OSError as error:
            raise RestoreError(f"cannot resume TCP connections: {error.strerror}") from error
        with contextlib.suppress(OSError):  # then no keeper could have silenced them either
            packet_drop.lift(self._ended)


def _missing(one: _Arrival) -> str:
    ours = one.connection.ours[0]
    return (
        f"the TCP connection {one.resource.name} continues once this machine has its address: add {ours} to one of its interfaces"
    )


def arriving(state: Snapshot, *, wanted: bool, all_of_them: bool = False) -> tuple[Arriving, Snapshot]:
    """The connections of a snapshot that can be taken up here, tried by making each of them.

    Args:
        wanted: nothing has run since the capture; else none is.
        all_of_them: refuse if one cannot; silent connections stay silent, so that another restore may succeed.

    Returns:
        Those, which are silent from now on; and the snapshot, with the reason in the place of each that cannot be taken up.

    Raises:
        MismatchError: one cannot, and all were to be.
    """
    if all_of_them:
        _require_taken(state)
    lost: dict[int, str] = {}
    arrivals = []
    ended = []
    for process, told in enumerate(state.processes):
        for held in told.resources:
            if held.kind == KIND and not wanted and tcp.is_carriable(held.facts):
                ended.append(_connection(held.facts))
            if held.kind == KIND and TAKEN in held.facts:
                one = _Arrival(process, held, _connection(held.facts), _kept(held))
                if reason := _hindrance(one, stays_silent=all_of_them) if wanted else "the program resumes from an older state":
                    lost[number_of(held.facts["socket"])] = reason
                else:
                    arrivals.append(one)

    if lost and all_of_them:
        _refuse(state, ((held, lost[number]) for number, held in _by_socket(state).items() if number in lost))

    def without(held: Resource) -> Resource:
        if held.kind != KIND or (reason := lost.get(number_of(held.facts["socket"]))) is None:
            return held
        return replace(held, facts={**{name: fact for name, fact in held.facts.items() if name != TAKEN}, LEFT: reason})

    state = _changed(state, without) if lost else state
    return Arriving(arrivals, ended, state), state


def _changed(state: Snapshot, change: Callable[[Resource], Resource]) -> Snapshot:
    """A snapshot with other resources."""
    members = tuple(replace(member, resources=tuple(map(change, member.resources))) for member in state.members)
    return replace(state, resources=tuple(map(change, state.resources)), members=members)


def _by_socket(state: Snapshot) -> dict[int, Resource]:
    """The TCP connections of all processes, by the number of their sockets."""
    held = (one for process in state.processes for one in process.resources if one.kind == KIND)
    return {number_of(one.facts["socket"]): one for one in held}


def _require_taken(state: Snapshot) -> None:
    """Refuse a snapshot whose capture has left a connection with another program behind."""
    held = _by_socket(state)
    own = tcp.pairs(held.values())
    left = [one for number, one in held.items() if tcp.is_carriable(one.facts) and TAKEN not in one.facts and number not in own]
    if left:
        _refuse(state, ((one, str(one.facts.get(LEFT, "its capture did not take it along"))) for one in left))


def _refuse(state: Snapshot, lost: Iterable[tuple[Resource, str]]) -> NoReturn:
    reasons = tuple(f"the TCP connection {tcp.named(one)} cannot be taken up: {why}" for one, why in lost)
    raise MismatchError(
        f"cannot restore {state.component} here: {'; '.join(reasons)}. Without them: --connections reset", reasons
    )


def _hindrance(one: _Arrival, *, stays_silent: bool) -> str:
    """Why a connection cannot be taken up here; "" of one that can, and is silent from now on."""
    try:
        packet_drop.impose([one.connection])
        _try(one)
    except (CannotCarryError, OSError) as reason:
        with contextlib.suppress(OSError):
            if not stays_silent:
                packet_drop.lift([one.connection])
        return _without_right(reason) if isinstance(reason, OSError) else str(reason)
    return ""


def _kept(held: Resource) -> Kept:
    found = held.facts[TAKEN]
    try:
        assert isinstance(found, dict)
        return msgspec.convert(found, Kept)
    except (AssertionError, msgspec.ValidationError) as error:
        raise RestoreError(f"cannot restore {held.name}: the snapshot does not describe its connection: {error}") from error


def _ends(held: Resource) -> tuple[tcp_repair.Address, tcp_repair.Address]:
    address, peer = held.facts["address"], held.facts["peer"]
    assert isinstance(address, list) and isinstance(peer, list)
    return tcp_repair.address_of(address), tcp_repair.address_of(peer)


def _try(one: _Arrival) -> None:
    """Make it and take it away again; its peer hears nothing. The process that had it on this machine may be about to end.

    Raises:
        CannotCarryError: this machine cannot have it.
        OSError: we may not.
    """
    deadline = time.monotonic() + END_S
    while True:
        time_wait.remove_orphan((one.connection.ours, one.connection.peer))
        family, kind, protocol = (number_of(one.resource.facts[name]) for name in ("family", "type", "protocol"))
        with socket.socket(family, kind, protocol) as tried:
            try:
                tcp_repair.connect(tried, one.kept, *_ends(one.resource))
                return
            except InUseError:
                if time.monotonic() > deadline:
                    raise
        time.sleep(PAUSE_S)
