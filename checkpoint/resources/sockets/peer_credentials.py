"""Restore the peer identity of unix sockets (SO_PEERCRED): the process that made or connected the socket, as it was then.

Facts that this module adds to unix sockets: ``maker``: [pid, uid, gid], the pid as that process itself knows it; empty for a
socket that reports no peer.

Source: unix(7), SO_PEERCRED; init_peercred() in net/unix/af_unix.c; credentials(7).
"""

from __future__ import annotations

import contextlib
import signal
import socket
import struct
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import Status
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, ProcessState, Resource
from checkpoint.resources.restore_context import number_of

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "the peer that a unix socket names (SO_PEERCRED)",
        "the user and group that made the socket, also before a change of user; a note says where failover cannot set "
        "them, or where another process made the socket",
    ),
)

_CREDENTIALS: Final = struct.Struct("<iII")
NOBODY: Final = 0xFFFFFFFF
SAME: Final = -1


def observe(looked: socket.socket) -> dict[str, Fact]:
    """The process and user that it tells, by our own numbers."""
    pid, uid, gid = _CREDENTIALS.unpack(looked.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return {"maker": [pid, uid, gid] if uid != NOBODY else []}


def by_its_own_number(maker: Fact) -> Fact:
    """The same, with the pid that the process knows itself by; as it is where that has ended."""
    assert isinstance(maker, list)
    if not maker:
        return maker
    with contextlib.suppress(ProbeError, ProcessGoneError):
        return [procfs.status(number_of(maker[0])).pids[-1], *maker[1:]]
    return maker


class Disguise(Struct, frozen=True):
    """A vessel that can pass for another user for as long as it takes to make a socket, or to send.

    A connection tells the effective ids, a message (SCM_CREDENTIALS) the real ones.

    Attributes:
        vessel: its process now.
        program: the process that it will be.
        eyes: it opens files as the program's user already.
        inner_pid: its PID as it knows it itself.
    """

    vessel: Status
    program: ProcessState
    eyes: bool
    inner_pid: int

    @contextlib.contextmanager
    def as_maker(self, table: CallTable, one: Resource) -> Iterator[None]:
        """Make calls for the body as the user that made a socket; as the program's user where that is unknown, never as ours."""
        maker = one.facts.get("maker")
        if isinstance(maker, list) and maker:
            if self._is_foreign(number_of(maker[1]), number_of(maker[2])):
                with self.as_program(table):
                    yield
                return
            lost = f"{one.name} reports another user as its peer (SO_PEERCRED): it was uid {maker[1]!r}, gid {maker[2]!r}"
            with self._as(table, number_of(maker[1]), number_of(maker[2]), lost):
                yield
        else:
            with self.as_program(table):
                yield

    @contextlib.contextmanager
    def as_program(self, table: CallTable) -> Iterator[None]:
        """Make calls for the body as the program's user: sent messages tell their sender."""
        with self._as(table, self.program.credentials.uids[1], self.program.credentials.gids[1], ""):
            yield

    @contextlib.contextmanager
    def as_owner(self, table: CallTable, one: Resource) -> Iterator[None]:
        """Make calls for the body as the user that owns a socket; as the program's user where that is unknown."""
        owner = one.facts.get("user")
        if isinstance(owner, list) and owner and not self._is_foreign(number_of(owner[0]), number_of(owner[1])):
            with self._as(table, number_of(owner[0]), number_of(owner[1]), ""):
                yield
        else:
            with self.as_program(table):
                yield

    def notes(self, held: Iterable[Resource]) -> tuple[str, ...]:
        """Which sockets tell another process, or another user, than before."""
        found = []
        for one in held:
            maker = one.facts.get("maker")
            if not (isinstance(maker, list) and maker):
                continue
            if maker[0] != self.inner_pid:
                found.append(f"{one.name} reports another process as its peer (SO_PEERCRED): it was pid {maker[0]!r}")
            if self._is_foreign(number_of(maker[1]), number_of(maker[2])):
                found.append(
                    f"{one.name} reports another user as its peer (SO_PEERCRED): it was uid {maker[1]!r}, gid {maker[2]!r}"
                )
        return tuple(found)

    def _is_foreign(self, uid: int, gid: int) -> bool:
        """Whether a program of an ordinary user's says that it was another user, or of another group: that is not made so."""
        theirs = self.program.credentials
        return self.eyes and 0 not in theirs.uids and (uid not in theirs.uids or gid not in {*theirs.gids, *theirs.groups})

    def _is(self, uid: int, gid: int) -> bool:
        return (uid, gid) == (self.vessel.uids[1], self.vessel.gids[1])

    @contextlib.contextmanager
    def _as(self, table: CallTable, uid: int, gid: int, lost: str) -> Iterator[None]:
        if self._is(uid, gid):
            yield
            return
        table.attempt(lost, "setresgid", gid, gid, SAME)
        table.attempt(lost, "setresuid", uid, uid, SAME)
        yield
        table.attempt("", "setresuid", *self.vessel.uids[:2], SAME)  # its saved ids permit it
        table.attempt("", "setresgid", *self.vessel.gids[:2], SAME)
        if self.eyes:
            table.call("set the filesystem's gid", "setfsgid", self.program.credentials.gids[3])
            table.call("set the filesystem's uid", "setfsuid", self.program.credentials.uids[3])
        table.call("end with the parent, still", "prctl", abi.PR_SET_PDEATHSIG, signal.SIGKILL)  # a change of user takes it back
