"""The agent's control socket, from a loop of asyncio, on behalf of users. Wire: `failover.client.control`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any, Final

from checkpoint.linux.unix_address import address_of
from failover.client.control import (
    CONNECT_TIMEOUT_S,
    LENGTH,
    MESSAGE_LIMIT,
    Output,
    Refused,
    Reply,
    Request,
    Result,
    Update,
    decoded,
    encoded,
    socket_path,
    why_unreachable,
)
from failover.errors import AgentRefusedError, LostAgentError, NoAgentError

ANSWER_S: Final = 10.0
"""How long an answer may take: an agent waits 2 s for other robots, and a busy machine is slower. After it the agent hangs."""


class AgentLink:
    """One connection to the agent; one request at a time. Lives in one loop."""

    def __init__(self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._path = path
        self._reader = reader
        self._writer = writer

    @classmethod
    async def open(cls, path: Path | None = None) -> AgentLink:
        """Connect.

        Raises:
            NoAgentError: no agent listens there, or not for this user.
        """
        path = path or socket_path()
        try:
            with address_of(path) as address:
                async with asyncio.timeout(CONNECT_TIMEOUT_S):
                    reader, writer = await asyncio.open_unix_connection(address)
        except TimeoutError as error:
            raise NoAgentError(why_unreachable(path, BlockingIOError())) from error
        except OSError as error:
            raise NoAgentError(why_unreachable(path, error)) from error
        return cls(path, reader, writer)

    async def ask(
        self, verb: str, on_behalf: int | None = None, *, within_s: float = ANSWER_S, **arguments: Any
    ) -> dict[str, Any]:
        """Make a request and wait for its result. After a `LostAgentError` the connection is of no more use.

        Args:
            on_behalf: uid of the user for whom it is made; None: of this process itself.

        Raises:
            AgentRefusedError: the agent says no.
            LostAgentError: it went away before it answered, or did not answer in time.
        """
        try:
            async with asyncio.timeout(within_s), contextlib.aclosing(self.stream(verb, on_behalf, **arguments)) as replies:
                async for reply in replies:
                    if isinstance(reply, Result):
                        return reply.value
        except TimeoutError:
            raise LostAgentError(
                f"the agent at {self._path} has not answered {verb} within {within_s:.0f} s: it hangs, or its robot is "
                "overloaded; see its log"
            ) from None
        raise LostAgentError(f"the agent at {self._path} ended its answer to {verb} without a result; see its log")

    async def stream(
        self, verb: str, on_behalf: int | None = None, **arguments: Any
    ) -> AsyncGenerator[Update | Output | Result, None]:
        """Make a request and yield everything that comes back, the result last.

        Raises:
            AgentRefusedError, LostAgentError: as for `ask`.
            RequestError: it cannot be said.
        """
        body = encoded(Request(verb, arguments, on_behalf))
        try:
            self._writer.write(LENGTH.pack(len(body)) + body)
            await self._writer.drain()
            while True:
                reply = await self._receive(verb)
                if isinstance(reply, Refused):
                    raise AgentRefusedError(reply.message, reply.kind, reply.reasons)
                yield reply
                if isinstance(reply, Result):
                    return
        except (OSError, asyncio.IncompleteReadError) as error:
            raise LostAgentError(
                f"the agent at {self._path} ended during {verb}; start failover-agent, or see its log"
            ) from error

    async def _receive(self, verb: str) -> Reply:
        (size,) = LENGTH.unpack(await self._reader.readexactly(LENGTH.size))
        if size > MESSAGE_LIMIT:
            raise LostAgentError(f"{self._path} announced a reply of {size} bytes, over {MESSAGE_LIMIT}; is it an agent?")
        return decoded(await self._reader.readexactly(size), self._path, verb)

    async def close(self) -> None:
        """End the connection; a request that still goes on is dropped, the component is not."""
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def __aenter__(self) -> AgentLink:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


async def ask_once(
    path: Path | None, verb: str, on_behalf: int | None = None, *, within_s: float = ANSWER_S, **arguments: Any
) -> dict[str, Any]:
    """One request over a connection of its own. Raises as `AgentLink.open` and `AgentLink.ask`."""
    async with await AgentLink.open(path) as link:
        return await link.ask(verb, on_behalf, within_s=within_s, **arguments)
