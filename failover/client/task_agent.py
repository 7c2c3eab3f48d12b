"""The state of a program that runs under an agent: what it begins with, and which commits are safe at another robot.

`failover run --engine cooperative` starts a program with one end of a socket, on which its guard says both
(`checkpoint.task_channel`). There is no file beside such a program.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import threading
import time
from dataclasses import dataclass

from checkpoint.channel import Channel, ChannelClosedError, ChannelError, close_all
from checkpoint.segment import PENDING, Committed, Outputs
from checkpoint.segment_reader import SegmentReader
from checkpoint.task_channel import VARIABLE, Begin, Message, Safe
from failover.client.task_output import OwnOutput
from failover.errors import NotCommittedError, TaskError


@dataclass(frozen=True, slots=True)
class Handed:
    """What the guard gave at the beginning.

    Attributes:
        state: what was committed last; None where the component begins.
    """

    begin: Begin
    state: Committed | None


class Guarded:
    """This program's end of the socket. Belongs to this process alone: no child, and nothing it executes, gets it."""

    def __init__(self, end: socket.socket) -> None:
        self._channel: Channel[Message] = Channel(end, Message)
        self._lock = threading.Lock()
        self._output: OwnOutput | None = None
        self._is_pending = False
        self.durable = 0
        """Number of the newest commit that a standby holds."""
        self.handed = self._receive_begin()

    def _receive_begin(self) -> Handed:
        try:
            begin, descriptors = self._channel.receive()
        except (ChannelError, OSError) as error:
            raise TaskError(f"cannot keep a state under the agent: its guard does not say how to begin: {error}") from error
        try:
            if not isinstance(begin, Begin) or len(descriptors) != 1 + (begin.origin is not None):
                raise TaskError("cannot keep a state under the agent: its guard says something else than how to begin")
            if _has_pipes(begin.pipes):
                self._output = OwnOutput(descriptors[0])
            return Handed(begin, _state_in(descriptors[1]) if begin.origin is not None else None)
        finally:
            close_all(descriptors)

    def outputs(self) -> Outputs:
        """What this program has written until now, for its commit."""
        outputs = self._output.totals() if self._output is not None else None
        self._is_pending = outputs is PENDING
        return outputs

    @property
    def trouble(self) -> str:
        """Why the newest commit does not travel; "" while all is well."""
        return "its output pipe is full, the guard takes nothing from it; a later commit will do" if self._is_pending else ""

    def notice(self) -> None:
        """There is a new commit: whoever takes it looks by himself."""

    def wait(self, number: int, timeout: float | None) -> None:
        """Return when a standby holds commit ``number``.

        Raises:
            NotCommittedError: it does not, in time.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._lock:
            while self.durable < number:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    why = self.trouble or f"the standby holds commit {self.durable}; failover status says how it stands"
                    raise NotCommittedError(f"commit {number} is not safe after {timeout} s: {why}")
                self._hear(left)

    def _hear(self, left: float | None) -> None:
        readable, _, _ = select.select([self._channel.fileno()], [], [], left)
        if not readable:
            return
        try:
            message, descriptors = self._channel.receive()
        except ChannelClosedError as error:
            raise NotCommittedError("the guard of this program has gone: nothing that it commits is safe any more") from error
        close_all(descriptors)
        if isinstance(message, Safe):
            self.durable = max(self.durable, message.commit)

    def close(self) -> None:
        """Let go of the socket."""
        self._channel.close()


def guarded() -> Guarded | None:
    """Our end of the guard's socket; None where this program was not started as one that keeps its state."""
    told = os.environ.pop(VARIABLE, "")
    if not told.isdigit():
        return None
    try:
        if not stat.S_ISSOCK(os.fstat(int(told)).st_mode):
            return None
    except OSError:  # we are a child of the program that it was given to
        return None
    os.set_inheritable(int(told), False)
    return Guarded(socket.socket(fileno=int(told)))


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
