"""The guard's end of the task socket (TASK.md): which process keeps the state, how it begins, which commits are safe.

Nothing here waits for the program: a message that does not fit into its socket is not sent; the next message says more.

====================  ==================================================================================================
state                 arrows out of it
====================  ==================================================================================================
free                  a process of the right user connects → connected
connected             it says `Hello` and is known how to begin → begun; it hangs up → free; it breaks the rules → free
begun                 it says `Keeps` → kept; it hangs up → free; it breaks the rules → free
kept                  it hangs up, or breaks the rules → gone
gone                  none: every process that connects is refused
====================  ==================================================================================================
"""

from __future__ import annotations

import array
import contextlib
import os
import secrets
import select
import socket
import struct
from pathlib import Path
from typing import Final

from agent.guard.messages import TaskConnected, TaskKeeps
from checkpoint.errors import TaskPacketError
from checkpoint.segment.task_messages import (
    NAME,
    NAME_PREFIX,
    PACKET_SIZE_MAX,
    VARIABLE,
    Begin,
    FromGuard,
    Hello,
    Kept,
    Origin,
    Refused,
    Safe,
    encode,
    from_program,
)

BACKLOG: Final = 4
PACKETS_A_TURN: Final = 8
"""Packets and callers that are heard before the guard looks at its lease again."""
_CREDENTIALS: Final = struct.Struct("3i")

Told = TaskConnected | TaskKeeps


def name_told_to(pid: int) -> str:
    """Where a program that was started by another guard looks for its own; "" where it was told none, or hides it."""
    try:
        environment = Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return ""
    prefix = f"{VARIABLE}=".encode()
    told = [item.removeprefix(prefix).decode(errors="replace") for item in environment.split(b"\0") if item.startswith(prefix)]
    return told[0] if told and NAME.fullmatch(told[0]) else ""


class TaskEnd:
    """The socket that one program is born with the name of.

    Attributes:
        environment: the variable by which the program finds the socket.
        pid: of the process that keeps the state; 0 before it has said so.
        keeps: it has made a commit.
    """

    def __init__(self, component: str, user: int, name: str = "") -> None:
        """Listen.

        Args:
            user: uid whose processes may keep the state; root's may, too.
            name: where a program that was restored looks; "" for a new one.

        Raises:
            OSError: another process listens there.
        """
        name = name or NAME_PREFIX + secrets.token_hex(8)
        self.environment = {VARIABLE: name}
        self.pid = 0
        self.keeps = False
        self._component = component
        self._users = (0, user)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        try:
            self._listener.bind("\0" + name[1:])
        except OSError:
            self._listener.close()
            raise
        self._listener.listen(BACKLOG)
        self._poll = select.epoll()
        self._poll.register(self._listener, select.EPOLLIN)
        self._program: socket.socket | None = None
        self._caller_pid = 0
        self._has_said_hello = False
        self._has_begun = False
        self._pipes = (0, 0)
        self._counters = -1
        self._beginning: tuple[int, Origin | None] | None = None
        self._segment = -1
        self._newest_told = 0
        self._newest_kept = 0

    def fileno(self) -> int:
        """For the guard's poll: readable means that `heed` has something to do."""
        return self._poll.fileno()

    def flows_into(self, counters: int, outputs: tuple[int, int]) -> None:
        """Name the counters and pipes that the program's output goes through.

        Args:
            counters: of its streams; stays the caller's.
            outputs: of each of its pipes, one end.
        """
        first, second = (os.fstat(end).st_ino for end in outputs)
        self._pipes = (first, second)
        self._counters = os.open(f"/proc/self/fd/{counters}", os.O_RDONLY | os.O_CLOEXEC)

    def begin(self, epoch: int, origin: Origin | None = None, segment: int = -1) -> None:
        """Have the program begin, or go on: at once if it waits, else as soon as it says that it keeps a state.

        Args:
            segment: descriptor of the state that it goes on with, if there is an origin; stays the caller's.
        """
        self._segment = os.dup(segment) if origin is not None else -1
        self._beginning = epoch, origin
        self._say_begin()

    def tell_safe(self, commit: int) -> None:
        """Say that a commit is safe, if a program listens."""
        if self._has_begun and commit > self._newest_told and self._say(Safe(commit)):
            self._newest_told = commit

    def tell_kept(self, commit: int) -> None:
        """Say that no robot can stand by, and that this robot's disk holds a commit, if a program listens."""
        if self._has_begun and commit > self._newest_kept and self._say(Kept(commit)):
            self._newest_kept = commit

    def heed(self) -> tuple[Told, ...]:
        """Handle the packets that have come; return the events that the agent should hear of."""
        told: list[Told] = []
        for _ in range(PACKETS_A_TURN):
            ready = self._poll.poll(0, 1)
            if not ready:
                break
            if ready[0][0] == self._listener.fileno():
                self._accept()
            else:
                told += self._hear()
        return tuple(told)

    def close(self) -> None:
        """The program has ended, or was not born."""
        self._hang_up()
        for end in (self._listener, self._poll):
            end.close()
        self._drop(self._counters, self._segment)
        self._counters = self._segment = -1

    # --- callers ---

    def _accept(self) -> None:
        """Take a caller in, or turn it away."""
        try:
            caller, _ = self._listener.accept()
        except OSError:  # it has gone already
            return
        caller.setblocking(False)
        pid, uid, _ = _CREDENTIALS.unpack(caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
        refusal = self._refusal(pid, uid)
        if refusal:
            with contextlib.suppress(OSError):
                caller.send(encode(Refused(f"{self._component}: {refusal}")))
            caller.close()
            return
        self._program, self._caller_pid = caller, pid
        self._poll.register(caller, select.EPOLLIN)

    def _refusal(self, pid: int, uid: int) -> str:
        """Why a caller may not keep the state; "" if it may."""
        if uid not in self._users:
            return f"a process of uid {uid} may not keep the state of a program of uid {self._users[-1]}; run both as one user"
        if not pid:
            return "the guard cannot see the process that keeps its state; start it in this PID namespace or one inside"
        if self._program is not None:
            return f"pid {self._caller_pid} keeps its state already; run each program that keeps one as a component of its own"
        if self.keeps:
            return f"pid {self.pid} kept its state and has ended; run each program that keeps one as a component of its own"
        return ""

    def _hear(self) -> list[Told]:
        """One packet of the process that keeps the state, or its end."""
        assert self._program is not None, "only what is registered is ready"
        try:
            content = self._program.recv(PACKET_SIZE_MAX + 1)
        except BlockingIOError:
            return []
        except OSError:
            content = b""
        if not content:
            return self._hang_up()
        try:
            return self._heard(content)
        except TaskPacketError as error:
            self._say(Refused(f"{self._component}: {error}"))
            return self._hang_up()

    def _heard(self, content: bytes) -> list[Told]:
        packet = from_program(content)
        if isinstance(packet, Hello):
            if self._has_said_hello:
                raise TaskPacketError("Hello was said twice")
            self._has_said_hello, self.pid = True, self._caller_pid
            self._say_begin()
            return [TaskConnected(self.pid)]
        if not self._has_begun:
            raise TaskPacketError("the program made a commit before the guard told it how to begin")
        self.keeps = True
        self._drop(self._segment)
        self._segment = -1
        return [TaskKeeps(self.pid)]

    def _hang_up(self) -> list[Told]:
        """The program has gone. If it made no commit, another process may keep the state."""
        if self._program is None:
            return []
        self._poll.unregister(self._program)
        self._program.close()
        self._program, was_known = None, self._has_said_hello
        self._has_said_hello = self._has_begun = False
        if self.keeps:
            return []
        self.pid = 0
        return [TaskConnected(0)] if was_known else []

    # --- saying ---

    def _say_begin(self) -> None:
        if self._beginning is None or not self._has_said_hello or self._has_begun:
            return
        epoch, origin = self._beginning
        descriptors = (self._counters,) if origin is None else (self._counters, self._segment)
        self._has_begun = self._say(Begin(self._component, epoch, self._pipes, origin), descriptors)

    def _say(self, packet: FromGuard, descriptors: tuple[int, ...] = ()) -> bool:
        """Whether a program is connected and the packet fitted into the socket."""
        if self._program is None:
            return False
        ancillary = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))] if descriptors else []
        try:
            self._program.sendmsg([encode(packet)], ancillary, socket.MSG_NOSIGNAL)
        except OSError:  # full, or gone: that is heard next
            return False
        return True

    def _drop(self, *descriptors: int) -> None:
        for descriptor in descriptors:
            if descriptor >= 0:
                os.close(descriptor)
