"""A question to the server that ends in time, whatever the library does: a child process asks it, and is killed when it is late.

OpenLDAP's library has times out of its own, and does not keep them while a connection is being encrypted: with version 2.5.13 and
a server that is stopped, ldaps waits without an end and takes a whole processor, with any network time out; StartTLS does so with
one below a second. A thread cannot be ended, a process can.
"""

from __future__ import annotations

import math
import os
import select
import signal
import time
from contextlib import suppress
from typing import Final

import msgspec

from agent.directory.server import LdapServer, UnknownUserError, WrongPasswordError
from agent.errors import DirectoryError
from checkpoint.errors import UNDECODABLE

REQUESTS: Final = 4
"""Times ``timeout_s`` that a whole question may take: it is a handful of requests, each quick where the server is well."""

PIECE_SIZE: Final = 64 << 10
KINDS: Final = {kind.__name__: kind for kind in (WrongPasswordError, UnknownUserError, DirectoryError)}


class Told(msgspec.Struct, frozen=True):
    """What the child says: the groups, or the class of an error and its sentence."""

    groups: tuple[str, ...] = ()
    kind: str = ""
    sentence: str = ""


class BoundedServer:
    """The same server, asked for ``limit_s`` at most. For a process with one thread: the child is a fork of it."""

    def __init__(self, server: LdapServer, limit_s: float) -> None:
        self._server = server
        self._limit_s = limit_s

    def groups(self, user: str, password: str | None) -> frozenset[str]:
        """As `LdapServer.groups`.

        Raises:
            WrongPasswordError, UnknownUserError: the server says no.
            DirectoryError: it cannot be asked, was late, or its answer cannot be used.
        """
        ours, theirs = os.pipe()
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(math.ceil(self._limit_s) + 1)  # should our parent have gone
            self._ask(theirs, user, password)
        os.close(theirs)
        try:
            body = _whole(ours, time.monotonic() + self._limit_s)
        finally:
            os.close(ours)
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        if body is None:
            raise DirectoryError(f"the server has not answered in {self._limit_s:g} s")
        try:
            told = msgspec.msgpack.decode(body, type=Told)
        except UNDECODABLE:
            raise DirectoryError("the process that asks the server ended in the middle of its answer") from None
        if told.kind:
            raise KINDS[told.kind](told.sentence)
        return frozenset(told.groups)

    def _ask(self, to: int, user: str, password: str | None) -> None:
        """The child's whole life."""
        try:
            try:
                told = Told(tuple(self._server.groups(user, password)))
            except DirectoryError as error:
                told = Told((), type(error).__name__, str(error))
            with suppress(OSError), open(to, "wb") as file:
                file.write(msgspec.msgpack.encode(told))
        finally:
            os._exit(0)  # whatever went wrong: there must not be two of the process that asks


def _whole(pipe: int, deadline_s: float) -> bytes | None:
    """All that comes through a pipe until its end; None when that has not come in time."""
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    body = bytearray()
    while (left_s := deadline_s - time.monotonic()) > 0:
        if poll.poll(math.ceil(left_s * 1_000)):
            piece = os.read(pipe, PIECE_SIZE)
            if not piece:
                return bytes(body)
            body += piece
    return None
