"""The control socket: who asks the agent what, on this robot. The wire and the verbs are `failover.client.control`'s."""

from __future__ import annotations

import asyncio
import contextlib
import grp
import logging
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

import msgspec

from agent.caller import Caller, caller_of
from agent.errors import AgentError, RefusedError
from agent.mistake import end_lanes_on_mistake
from checkpoint.errors import UNDECODABLE, CheckpointError
from checkpoint.linux.address import address_of
from failover.client.control import LENGTH, MESSAGE_LIMIT, Output, Refused, Reply, Request, Result, Update
from failover.errors import FailoverError

OWNER_ONLY: Final = 0o600
OWNER_AND_GROUP: Final = 0o660

CLIENTS_LIMIT: Final = 256
"""Connections at a time; a script that forgets to close them is told, and the agent keeps its descriptors."""

log = logging.getLogger("failover.control")

_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Request)


class Conversation:
    """What a verb says to its client while it works, and who that is."""

    def __init__(self, writer: asyncio.StreamWriter, caller: Caller) -> None:
        self._writer = writer
        self.caller = caller

    async def update(self, value: dict[str, Any]) -> None:
        """Something to show."""
        await self.reply(Update(value))

    async def output(self, stream: int, offset: int, content: bytes) -> None:
        """Bytes of the component."""
        await self.reply(Output(stream, offset, content))

    async def reply(self, reply: Reply) -> None:
        """One message; waits while the client does not read."""
        body = _encoder.encode(reply)
        self._writer.write(LENGTH.pack(len(body)) + body)
        await self._writer.drain()


Verb = Callable[[Conversation, dict[str, Any]], Awaitable[dict[str, Any]]]
"""Works on the arguments, may talk meanwhile, returns the result's value or raises."""


class ControlServer:
    """The listening end. Lives in the lanes' loop."""

    def __init__(self, path: Path, group: str, verbs: dict[str, Verb]) -> None:
        self._path = path
        self._group = group
        self._verbs = verbs
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Listen; only the owner, and the group if there is one, may connect.

        Raises:
            AgentError: the socket cannot be made, or the group is unknown.
        """
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()
        try:
            before = os.umask(0o177)
            try:
                with address_of(self._path) as address:
                    self._server = await asyncio.start_unix_server(self._connected, address)
            finally:
                os.umask(before)
            if self._group:
                os.chown(self._path, -1, grp.getgrnam(self._group).gr_gid)
                self._path.chmod(OWNER_AND_GROUP)
            else:
                self._path.chmod(OWNER_ONLY)
        except KeyError as error:
            raise AgentError(f"group = {self._group!r}: this system has no such group; make it, or leave it empty") from error
        except OSError as error:
            raise AgentError(f"cannot listen on {self._path}: {error.strerror}; name another runtime_directory") from error

    async def close(self) -> None:
        """Hang up on everybody and remove the socket."""
        if self._server is not None:
            self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        task.add_done_callback(self._clients.discard)
        task.add_done_callback(end_lanes_on_mistake)
        try:
            caller = caller_of(writer.get_extra_info("socket"))
            await self._converse(reader, Conversation(writer, caller))
        except (ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # the client has gone, or the agent ends; the request goes with it, the component does not
        finally:
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, conversation: Conversation) -> None:
        """Request after request, until the client closes or says what is none."""
        try:
            if len(self._clients) > CLIENTS_LIMIT:
                raise RefusedError(f"{CLIENTS_LIMIT} clients are connected; close some")
            while (request := await _request(reader)) is not None:
                await self._serve(request, conversation, reader)
        except RefusedError as refusal:
            await conversation.reply(Refused(refusal.kind, str(refusal)))

    async def _serve(self, request: Request, conversation: Conversation, reader: asyncio.StreamReader) -> None:
        """Work on one request; a client that hangs up in the middle ends it."""
        work = asyncio.ensure_future(self._answer(request, conversation))
        gone = asyncio.ensure_future(_hung_up(reader))
        try:
            await asyncio.wait({work, gone}, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                await conversation.reply(work.result())
            else:
                raise ConnectionResetError
        finally:
            for future in (work, gone):
                future.cancel()
            await asyncio.gather(work, gone, return_exceptions=True)

    async def _answer(self, request: Request, conversation: Conversation) -> Reply:
        verb = self._verbs.get(request.verb)
        if verb is None:
            return Refused("RefusedError", f"no verb {request.verb!r} here; client and agent are of different versions")
        try:
            return Result(await verb(conversation, request.arguments))
        except RefusedError as refusal:
            return Refused(refusal.kind, str(refusal), refusal.reasons)
        except (AgentError, CheckpointError, FailoverError) as error:
            return Refused(type(error).__name__, str(error), tuple(getattr(error, "reasons", ())))


async def _request(reader: asyncio.StreamReader) -> Request | None:
    """The next request; None when the client has closed."""
    try:
        (size,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    except asyncio.IncompleteReadError as error:
        if not error.partial:
            return None
        raise
    if size > MESSAGE_LIMIT:
        raise RefusedError(f"a request of {size} bytes is over the limit of {MESSAGE_LIMIT}")
    try:
        return _decoder.decode(await reader.readexactly(size))
    except UNDECODABLE as error:
        raise RefusedError(f"a request was not understood: {error}; client and agent are of different versions") from error


async def _hung_up(reader: asyncio.StreamReader) -> None:
    """Return when the client has closed its end. It says nothing while it waits: one request at a time."""
    while not reader.at_eof() and reader.exception() is None:
        await asyncio.sleep(HANGUP_POLL_S)


HANGUP_POLL_S: Final = 0.1
"""How soon a client that went away is noticed; asyncio's reader has no way to wait for the end without reading."""
