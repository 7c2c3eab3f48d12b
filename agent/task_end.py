"""The guard's end of a program that keeps its state: what it begins with, and which of its commits are safe.

Nothing here waits for the program: what does not fit into its socket is not said, the next one says more.
"""

from __future__ import annotations

import contextlib
import os

from agent.guard_messages import Task
from checkpoint import channel
from checkpoint.channel import Channel, ChannelError
from checkpoint.task_channel import VARIABLE, Begin, Message, Safe


class TaskEnd:
    """One program's socket.

    Args:
        segment: descriptors of the state that it goes on with, if it has one; they stay the caller's.
    """

    def __init__(self, component: str, task: Task, segment: tuple[int, ...]) -> None:
        self._component, self._task, self._segment = component, task, segment
        ours, self._theirs = channel.pair()
        ours.setblocking(False)
        self._channel: Channel[Message] = Channel(ours, Message)
        self.environment = {VARIABLE: str(self._theirs.fileno()), "FAILOVER_COMPONENT": component}

    def begin(self, counters: int, outputs: tuple[int, int]) -> int:
        """Leave its first message in the socket; the descriptor that it is to be born with.

        Args:
            outputs: write ends of its pipes.

        Raises:
            ChannelError: it cannot be sent.
        """
        first, second = (os.fstat(end).st_ino for end in outputs)
        visible = os.open(f"/proc/self/fd/{counters}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            begin = Begin(self._component, self._task.epoch, (first, second), self._task.origin)
            self._channel.send(begin, (visible, *self._segment))
        finally:
            os.close(visible)
        return self._theirs.fileno()

    def born(self) -> None:
        """It has its end; ours of that goes."""
        self._theirs.close()
        self._segment = ()

    def tell_safe(self, commit: int) -> None:
        """Say that a commit is safe, if it listens."""
        with contextlib.suppress(ChannelError):
            self._channel.send(Safe(commit))

    def close(self) -> None:
        """The program was not born."""
        self._theirs.close()
        self._channel.close()
