"""Link of a program to its agent: the state with which it begins, and which commits are safe at another robot.

The guard of such a program listens at a name that it leaves in the environment (`checkpoint/segment/TASK.md`). There is no file
beside the program then.
"""

from __future__ import annotations

import array
import contextlib
import logging
import os
import select
import socket
import stat
import struct
import threading
import time
import weakref
from typing import Final

from msgspec import Struct

from checkpoint.errors import TaskPacketError
from checkpoint.keeper.messages import close_all
from checkpoint.segment.layout import PENDING, Committed, Outputs
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.task_messages import (
    NAME,
    PACKET_SIZE_MAX,
    VARIABLE,
    Begin,
    FromGuard,
    Hello,
    Keeps,
    Kept,
    Refused,
    Safe,
    encode,
    from_guard,
)
from checkpoint.sentences import in_words
from failover.errors import NotCommittedError, TaskError
from failover.kept_state.output import OwnOutput

_CREDENTIALS: Final = struct.Struct("3i")
_INT_SIZE: Final = array.array("i").itemsize
LOOK_S: Final = 1.0
"""How long a thread holds the socket: another may wait with less patience."""
DESCRIPTORS_MAX: Final = 2
"""Counters, and a segment."""

EVERY: Final = (1 << 64) - 1
"""Greater than the number of any commit."""

UNTOLD: Final = "cannot keep a state under the agent: its guard does not say how to begin"

log = logging.getLogger("failover")


class Handed(Struct, frozen=True):
    """The packet and the state that the guard gave at the beginning.

    Attributes:
        state: of the last commit; None where the component begins.
    """

    begin: Begin
    state: Committed | None


class Guarded:
    """This program's end of the socket. Belongs to this process alone: no child, and nothing it executes, gets it.

    Args:
        end: connected to the guard; ours from now on.

    Raises:
        TaskError: the guard will not have it, or sends nonsense.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._hearing = threading.RLock()
        """Held by the code that waits for the next packet: a thread, and perhaps a signal handler that interrupts it."""
        self._output: OwnOutput | None = None
        self._is_pending = False
        self._told_segment = 0
        self.durable = 0
        """Number of the newest commit that a standby holds."""
        self.kept = 0
        """The same on this robot's disk, told while no robot could stand by."""
        try:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it has hung up; it may have said why
                end.send(encode(Hello()), socket.MSG_NOSIGNAL)
            self.handed = self._receive_begin()
        except OSError as error:
            end.close()
            raise TaskError(f"{UNTOLD}: {error.strerror or error}") from error
        except BaseException:
            end.close()
            raise
        _close_in_children(self)

    def _receive_begin(self) -> Handed:
        """Wait to be told how to begin: a warm program waits here until its robot takes over."""
        begin, descriptors = self._receive()
        try:
            if isinstance(begin, Refused):
                raise TaskError(f"cannot keep a state under the agent: {begin.text}")
            if not isinstance(begin, Begin) or len(descriptors) != 1 + (begin.origin is not None):
                raise TaskError(f"{UNTOLD}, but says something else")
            if _has_pipes(begin.pipes):
                self._output = OwnOutput(descriptors[0])
            return Handed(begin, _state_in(descriptors[1]) if begin.origin is not None else None)
        finally:
            close_all(descriptors)

    def _receive(self, flags: int = 0) -> tuple[FromGuard, tuple[int, ...]]:
        """One packet, and its descriptors, ours to close.

        Raises:
            TaskError: the guard has gone, or sent bytes that are no packet.
        """
        room = socket.CMSG_SPACE(DESCRIPTORS_MAX * _INT_SIZE)
        try:
            content, ancillary, _, _ = self._end.recvmsg(PACKET_SIZE_MAX + 1, room, flags | socket.MSG_CMSG_CLOEXEC)
        except ConnectionResetError:  # said once, before the last packet of a guard that hung up
            content, ancillary, _, _ = self._end.recvmsg(PACKET_SIZE_MAX + 1, room, flags | socket.MSG_CMSG_CLOEXEC)
        carried = array.array("i")
        for level, kind, packed in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                carried.frombytes(packed[: len(packed) - len(packed) % _INT_SIZE])
        try:
            if not content:
                raise TaskError("the guard of this program has gone: nothing that it commits is safe any more")
            return from_guard(content), tuple(carried)
        except TaskPacketError as error:
            close_all(tuple(carried))
            raise TaskError(f"cannot understand the guard of this program: {error}") from error
        except TaskError:
            close_all(tuple(carried))
            raise

    def outputs(self) -> Outputs:
        """The output that this program has written until now, for its commit."""
        outputs = self._output.totals() if self._output is not None else None
        self._is_pending = outputs is PENDING
        return outputs

    @property
    def trouble(self) -> str:
        """Why the newest commit does not travel; "" while all is well."""
        return "its output pipe is full, the guard takes nothing from it; a later commit will do" if self._is_pending else ""

    def notice(self, segment: int) -> None:
        """There is a new commit. The keeper looks for commits by itself. The guard is told of the first one in each segment.

        Args:
            segment: how many segments there were, with the one that it went to.
        """
        if segment == self._told_segment:
            return
        try:
            self._end.send(encode(Keeps()), socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)
        except OSError:  # full: at the next commit; gone: no guard listens
            return
        self._told_segment = segment

    def wait(self, number: int, timeout: float | None) -> None:
        """Return when a standby holds commit ``number``.

        Raises:
            NotCommittedError: it does not, in time.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while self.durable < number:
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                why = self.trouble or f"the standby holds commit {self.durable}; see failover status"
                raise NotCommittedError(f"commit {number} is not safe after {timeout} s: {why}")
            if self._hearing.acquire(timeout=LOOK_S if left is None else min(left, LOOK_S)):
                try:
                    if self.durable < number:
                        self._hear(LOOK_S if left is None else min(left, LOOK_S))
                finally:
                    self._hearing.release()

    def _hear(self, patience_s: float) -> None:
        waiting = select.poll()
        waiting.register(self._end, select.POLLIN)
        if not waiting.poll(patience_s * 1000):
            return
        try:
            message, descriptors = self._receive(socket.MSG_DONTWAIT)
        except BlockingIOError:  # a signal handler has taken it
            return
        except (TaskError, OSError) as error:
            raise NotCommittedError(in_words(error)) from error
        close_all(descriptors)
        if isinstance(message, Safe):
            self.durable = max(self.durable, message.commit)
        elif isinstance(message, Kept):
            self.kept = max(self.kept, message.commit)

    def fileno(self) -> int:
        """Readable: `hear` has something to take in; or the guard has gone."""
        return self._end.fileno()

    def hear(self) -> int:
        """Take in what the guard has said, without a wait; the number of the newest commit that a standby holds.

        `EVERY` while no robot can stand by: the agent writes to this robot's disk now and then, and to wait for that helps
        little.

        Raises:
            NotCommittedError: the guard has gone.
        """
        with self._hearing:
            before = (-1, -1)
            while before != (before := (self.durable, self.kept)):
                self._hear(0)
        return EVERY if self.kept > self.durable else self.durable

    def close(self) -> None:
        """Let go of the socket."""
        self._end.close()


def has_guard() -> bool:
    """Whether the environment names a guard that keeps the state of this program; `guarded` connects to it."""
    return NAME.fullmatch(os.environ.get(VARIABLE, "")) is not None


def guarded() -> Guarded | None:
    """Our end of the guard's socket; None where this program has no guard that keeps its state.

    Raises:
        TaskError: its guard will not have it.
    """
    told = os.environ.pop(VARIABLE, "")
    if not NAME.fullmatch(told):
        return None
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        end.connect("\0" + told[1:])
        _, uid, _ = _CREDENTIALS.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    except OSError as error:
        end.close()
        log.warning("no agent keeps this state, a file does: no guard listens at %s=%s: %s", VARIABLE, told, error.strerror)
        return None
    if uid not in (0, os.geteuid()):
        end.close()
        log.warning(
            "no agent keeps this state, a file does: the listener at %s=%s is uid %d, not this user or root", VARIABLE, told, uid
        )
        return None
    return Guarded(end)


def _close_in_children(guarded: Guarded) -> None:
    """A forked child would keep the guard from learning of our end."""
    remembered = weakref.ref(guarded)

    def forked() -> None:
        known = remembered()
        if known is not None:
            known.close()

    os.register_at_fork(after_in_child=forked)


def _has_pipes(told: tuple[int, int]) -> bool:
    """Whether our standard output and error are still the pipes that we were born with."""
    for number, inode in zip((1, 2), told, strict=True):
        try:
            found = os.fstat(number)
        except OSError:
            return False
        if not stat.S_ISFIFO(found.st_mode) or found.st_ino != inode:
            return False
    return True


def _state_in(segment: int) -> Committed:
    reader = SegmentReader(segment)
    try:
        committed = reader.read()
    finally:
        reader.close()
    if committed is None:
        raise TaskError("cannot resume: the guard handed over a state in which nothing was committed")
    return committed
