"""One end of a `checkpoint.keeper.messages` inside asyncio: answers come in the order of the requests, events in between."""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from agent.errors import AgentError
from agent.worker.components.stall_watchdog import Watchman
from checkpoint.keeper.messages import Channel, ChannelClosedError, ChannelError, close_all

Answer = tuple[Any, tuple[int, ...]]
"""A reply and the descriptors that came with it, now the asker's to close."""


class Dialogue:
    """A conversation with a guard or a keeper. Lives in one loop.

    Attributes:
        heard: takes an event and returns True; False for the answer to a request.
        ended: called once when the other end has gone.
    """

    def __init__(
        self,
        end: socket.socket,
        incoming: Any,
        lost: type[AgentError],
        whom: str,
    ) -> None:
        """
        Args:
            incoming: the union of the messages that may come.
            lost: raised to each task that waits, or asks, when the other end has gone.
            whom: the other end, for messages.
        """
        end.setblocking(False)
        self._channel: Channel[Any] = Channel(end, incoming)
        self._lost = lost
        self._whom = whom
        self.heard: Callable[[Any], bool] = lambda _: False
        self.ended: Callable[[], None] = lambda: None
        self._waiting: deque[asyncio.Future[Answer]] = deque()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._channel.fileno(), self._readable)
        self._watchman: Watchman | None = None
        self.open = True

    def watch(self, pid: int) -> None:
        """The other end is this process: it is ended if it does nothing while it owes us an answer."""
        self._watchman = Watchman(pid, self._whom, lambda: self._waiting[0] if self.open and self._waiting else None)

    async def ask(self, message: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> Answer:
        """Send a request and wait for its answer.

        Raises:
            AgentError: of the class given, when the other end has gone.
        """
        self.tell(message, descriptors)
        answer: asyncio.Future[Answer] = self._loop.create_future()
        self._waiting.append(answer)
        if self._watchman is not None:
            self._watchman.awaits()
        return await answer

    def tell(self, message: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> None:
        """Send a message that has no answer; raises as `ask`."""
        if not self.open:
            raise self._lost(f"{self._whom} has gone")
        try:
            self._channel.send(message, descriptors)
        except ChannelError as error:
            if self._watchman is not None and not isinstance(error, ChannelClosedError):
                self._watchman.end(str(error))  # it must not live on while it counts as gone
            self._end()
            raise self._lost(f"{self._whom} has gone: {error}") from error

    def close(self) -> None:
        """Hang up; each waiting task is told that the other end is lost, and `ended` is not called."""
        self.ended = lambda: None
        self._end()

    def _readable(self) -> None:
        while self.open:
            try:
                message, descriptors = self._channel.receive()
            except BlockingIOError:
                return
            except ChannelError:
                self._end()
                return
            if self.heard(message):
                close_all(descriptors)
            elif self._waiting:
                answer = self._waiting.popleft()
                if answer.done():
                    close_all(descriptors)
                else:
                    answer.set_result((message, descriptors))
            else:
                close_all(descriptors)

    def _end(self) -> None:
        if not self.open:
            return
        self.open = False
        if self._watchman is not None:
            self._watchman.close()
        self._loop.remove_reader(self._channel.fileno())
        self._channel.close()
        while self._waiting:
            answer = self._waiting.popleft()
            if not answer.done():
                answer.set_exception(self._lost(f"{self._whom} has gone in the middle of a request"))
        self.ended()
