"""Server of the control socket: identifies clients, takes their requests. Wire and verbs: `failover.client.control`."""

from __future__ import annotations

import asyncio
import contextlib
import grp
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

import msgspec

from agent.errors import AgentError, RefusedError
from agent.system.crash import end_worker_on_mistake
from agent.system.permissions import NOBODY, Caller, caller_of, spoken_for, uid_named, uid_of
from agent.worker.control.quotas import Admission
from checkpoint.errors import UNDECODABLE, CheckpointError
from checkpoint.linux.unix_address import address_of
from failover.client.control import LENGTH, ON_BEHALF, REQUEST_LIMIT, Output, Refused, Reply, Request, Result, Update
from failover.errors import FailoverError

OWNER_ONLY: Final = 0o600
OWNER_AND_GROUP: Final = 0o660

IDLE_S: Final = 60.0
"""How long a connection may stay open without a request. One whose request is being answered may take any time."""

REQUEST_S: Final = 30.0
"""How long a request may take from its first byte to its last: a client writes it at once, however busy the machine is."""

MEMBER_S: Final = 60.0
"""How long a user for whom another one asks is believed to be a member of the group: an organisation's accounts may be slow."""

SPOKEN_FOR_MAX: Final = 1_024
"""Such users that are remembered."""

PIECE_SIZE: Final = 32 << 10
"""Bytes read ahead of a client (asyncio reads twice as many and one more piece); a request takes memory as it arrives."""

_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Request)


class Conversation:
    """The answers of a verb to its client while it works, and the client's identity."""

    def __init__(self, writer: asyncio.StreamWriter, caller: Caller) -> None:
        self.writer = writer
        self.caller = caller

    async def update(self, value: dict[str, Any]) -> None:
        """Something to show."""
        await self.reply(Update(value))

    async def output(self, stream: int, offset: int, content: bytes, times: tuple[tuple[int, int], ...] = ()) -> None:
        """Bytes of the component."""
        await self.reply(Output(stream, offset, content, times))

    async def reply(self, reply: Reply) -> None:
        """One message; waits while the client does not read."""
        await _say(self.writer, reply)


Verb = Callable[[Conversation, dict[str, Any]], Awaitable[dict[str, Any]]]
"""Works on the arguments, may talk meanwhile, returns the result's value or raises."""


class ControlServer:
    """The listening end. Lives in the worker's loop."""

    def __init__(self, path: Path, group: str, verbs: dict[str, Verb], page_user: str = "") -> None:
        """
        Args:
            page_user: the user whose process may ask for other users, besides root and our own; "": none.
        """
        self._page_uid = uid_named(page_user) if page_user else NOBODY
        self._spoken_for: dict[tuple[int, int], tuple[Caller, float]] = {}
        self._path = path
        self._group = group
        self._verbs = verbs
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._admission = Admission(self._page_uid)

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
                    self._server = await asyncio.start_unix_server(self._connected, address, limit=PIECE_SIZE)
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
        """Hang up on all clients and remove the socket."""
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
        task.add_done_callback(end_worker_on_mistake)
        try:
            await self._converse(reader, writer)
        except (ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # the client has gone, or the agent ends; the request goes with it, the component does not
        finally:
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve request after request, until the client closes, sends bytes that are none, or sends nothing."""
        connection = writer.get_extra_info("socket")
        uid = uid_of(connection)
        try:
            self._admission.enter(uid)
        except RefusedError as refusal:
            await _say(writer, Refused(refusal.kind, str(refusal)))
            return
        try:
            conversation = Conversation(writer, caller_of(connection))
            while await self._served(reader, conversation):
                pass
        except RefusedError as refusal:
            await _say(writer, Refused(refusal.kind, str(refusal)))
        finally:
            self._admission.leave(uid)

    async def _served(self, reader: asyncio.StreamReader, conversation: Conversation) -> bool:
        """Take one request, and answer it; whether there was one. Its bytes are counted until then.

        Raises:
            RefusedError: it was none, it did not come in time, or it is one too many.
        """
        uid, body = conversation.caller.uid, bytearray()
        try:
            if not await self._receive(reader, uid, body):
                return False
            request = _request(body)
            await self._serve(request, await self._for_whom(request, conversation), reader)
            return True
        finally:
            self._admission.let_go(uid, _counted(len(body)))

    async def _for_whom(self, request: Request, conversation: Conversation) -> Conversation:
        """The same conversation, with the user for whom the request is made.

        Raises:
            RefusedError: the client may not speak for that user.
        """
        if request.on_behalf is None:
            return conversation
        if request.verb not in ON_BEHALF:
            raise RefusedError(f"{request.verb} is asked by the user itself, never on behalf of one", "PermissionError")
        key, now_s = (conversation.caller.uid, request.on_behalf), asyncio.get_running_loop().time()
        known = self._spoken_for.get(key)
        if known is None or now_s > known[1]:
            if len(self._spoken_for) >= SPOKEN_FOR_MAX:
                self._spoken_for.clear()
            caller = await asyncio.to_thread(
                spoken_for, conversation.caller, request.on_behalf, self._page_uid, self._group
            )  # a directory of users may be slow
            known = self._spoken_for[key] = (caller, now_s + MEMBER_S)
        return Conversation(conversation.writer, known[0])

    async def _receive(self, reader: asyncio.StreamReader, uid: int, body: bytearray) -> bool:
        """Add the bytes of the next request to ``body`` as they arrive; False when the client has closed instead.

        Raises:
            RefusedError: as for `_served`.
        """
        try:
            async with asyncio.timeout(IDLE_S):
                first = await reader.read(1)
        except TimeoutError:
            raise RefusedError(f"nothing was asked on this connection for {IDLE_S:.0f} s; connect again") from None
        if not first:
            return False
        try:
            async with asyncio.timeout(REQUEST_S):
                (size,) = LENGTH.unpack(first + await reader.readexactly(LENGTH.size - 1))
                if size > REQUEST_LIMIT:
                    raise RefusedError(f"a request of {size} bytes is over the limit of {REQUEST_LIMIT}")
                while len(body) < size:
                    piece = await reader.read(min(size - len(body), PIECE_SIZE))
                    if not piece:
                        raise asyncio.IncompleteReadError(b"", size)
                    self._admission.hold(uid, _counted(len(body) + len(piece)) - _counted(len(body)))
                    body += piece
        except TimeoutError:
            raise RefusedError(
                f"a request was begun and {len(body)} bytes of it came in {REQUEST_S:.0f} s; connect again and send it whole"
            ) from None
        return True

    async def _serve(self, request: Request, conversation: Conversation, reader: asyncio.StreamReader) -> None:
        """Work on one request; a client that hangs up in the middle, or asks for more before the answer, ends it."""
        work = asyncio.ensure_future(self._answer(request, conversation))
        more = asyncio.ensure_future(reader.read(1))
        try:
            await asyncio.wait({work, more}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for future in (work, more):
                future.cancel()
            await asyncio.gather(work, more, return_exceptions=True)
        if work.cancelled() and not more.result():
            raise ConnectionResetError
        if not work.cancelled():
            await conversation.reply(work.result())
        if not more.cancelled() and more.result():
            raise RefusedError("another request came before the answer; wait for it, or use another connection")

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


def _counted(size: int) -> int:
    """How many bytes of a request of this size are counted: a small one is always heard."""
    return max(size - PIECE_SIZE, 0)


def _request(body: bytearray) -> Request:
    try:
        return _decoder.decode(body)
    except UNDECODABLE as error:
        raise RefusedError(f"a request was not understood: {error}; client and agent are of different versions") from error


async def _say(writer: asyncio.StreamWriter, reply: Reply) -> None:
    """One message; waits while the client does not read."""
    body = _encoder.encode(reply)
    writer.write(LENGTH.pack(len(body)) + body)
    await writer.drain()
