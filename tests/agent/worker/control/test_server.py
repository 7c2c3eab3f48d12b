"""The control socket and users who hold connections, or begin requests and never end them: all others are served."""

from __future__ import annotations

import asyncio
import errno
import grp
import os
import pwd
import socket
import tempfile
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.errors import RefusedError
from agent.worker.control import quotas
from agent.worker.control import server as control_server
from agent.worker.control.quotas import Admission
from agent.worker.control.server import ControlServer, Conversation
from failover.client.control import LENGTH, REQUEST_LIMIT, Control, Refused, Reply, Request, Result
from failover.errors import AgentRefusedError

NOBODY, SOMEBODY = 65_534, 65_533

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="connects as other users")

PATIENCE_S = 60.0

_decoder: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)


@contextmanager
def user(uid: int) -> Iterator[None]:
    """What is connected meanwhile is this user's."""
    os.seteuid(uid)
    try:
        yield
    finally:
        os.seteuid(0)


@asynccontextmanager
async def server() -> AsyncIterator[Path]:
    """One that every user may connect to; ``wait`` never ends, ``ping`` does."""

    async def ping(_say: Conversation, _arguments: dict[str, Any]) -> dict[str, Any]:
        return {"robot": "robot1"}

    async def wait(_say: Conversation, _arguments: dict[str, Any]) -> dict[str, Any]:
        await asyncio.Event().wait()
        return {}

    with tempfile.TemporaryDirectory() as directory:
        Path(directory).chmod(0o755)
        path = Path(directory) / "control.sock"
        listening = ControlServer(path, "", {"ping": ping, "wait": wait})
        await listening.open()
        path.chmod(0o666)
        try:
            yield path
        finally:
            await listening.close()


def connect(path: Path, uid: int) -> socket.socket:
    link = socket.socket(socket.AF_UNIX)
    with user(uid) if uid != os.geteuid() else nullcontext():
        link.connect(str(path))
    link.setblocking(False)
    return link


async def send(link: socket.socket, body: bytes) -> None:
    await asyncio.get_running_loop().sock_sendall(link, body)


async def ask(link: socket.socket, verb: str) -> None:
    body = msgspec.msgpack.encode(Request(verb))
    await send(link, LENGTH.pack(len(body)) + body)


async def heard(link: socket.socket) -> Reply:
    """The next reply."""
    told = bytearray()
    async with asyncio.timeout(PATIENCE_S):
        while len(told) < LENGTH.size or len(told) < LENGTH.size + LENGTH.unpack_from(told)[0]:
            piece = await asyncio.get_running_loop().sock_recv(link, 1 << 16)
            assert piece, "it hung up without a word"
            told += piece
    reply: Reply = _decoder.decode(told[LENGTH.size :])
    return reply


async def pinged(path: Path, uid: int) -> Reply:
    with connect(path, uid) as link:
        await ask(link, "ping")
        return await heard(link)


def refused(reply: Reply) -> str:
    assert isinstance(reply, Refused), reply
    return reply.message


@as_root
def test_a_request_on_behalf_of_another_user_is_that_users_and_only_for_some_verbs() -> None:
    seen: list[int] = []

    async def noted(say: Conversation, _arguments: dict[str, Any]) -> dict[str, Any]:
        seen.append(say.caller.uid)
        return {}

    async def asked(path: Path, uid: int, verb: str, on_behalf: int | None) -> Reply:
        body = msgspec.msgpack.encode(Request(verb, {}, on_behalf))
        with connect(path, uid) as link:
            await send(link, LENGTH.pack(len(body)) + body)
            return await heard(link)

    async def body() -> None:
        group = grp.getgrgid(pwd.getpwnam("nobody").pw_gid).gr_name
        with tempfile.TemporaryDirectory() as directory:
            Path(directory).chmod(0o755)
            path = Path(directory) / "control.sock"
            listening = ControlServer(path, group, {"ping": noted, "run": noted}, "daemon")
            await listening.open()
            path.chmod(0o666)
            page = pwd.getpwnam("daemon").pw_uid
            try:
                assert isinstance(await asked(path, page, "ping", NOBODY), Result)
                assert isinstance(await asked(path, page, "ping", None), Result)
                assert "asked by the user itself" in refused(await asked(path, page, "run", NOBODY))
                assert "asked by the user itself" in refused(await asked(path, 0, "run", NOBODY))
                assert "command failover" in refused(await asked(path, page, "ping", 0))
                assert "may not ask for other users" in refused(await asked(path, SOMEBODY, "ping", NOBODY))
            finally:
                await listening.close()

    asyncio.run(body())
    assert seen == [NOBODY, pwd.getpwnam("daemon").pw_uid]


@as_root
def test_the_user_of_the_page_holds_as_many_connections_as_root() -> None:
    admission = Admission(page_uid=SOMEBODY)
    for _ in range(quotas.TRUSTED_CONNECTIONS_MAX):
        admission.enter(SOMEBODY)
    with pytest.raises(RefusedError, match="the most for one user"):
        admission.enter(SOMEBODY)
    for number in range(quotas.OTHERS_CONNECTIONS_MAX):
        admission.enter(10_000 + number)
    with pytest.raises(RefusedError, match="users other than root"):
        admission.enter(9_999)


@as_root
def test_idle_connections_of_one_user_shut_nobody_else_out() -> None:
    async def body() -> None:
        async with server() as path:
            with ExitStack() as held:
                for _ in range(quotas.USER_CONNECTIONS_MAX):
                    held.enter_context(connect(path, NOBODY))
                assert "holds 32 connections to the agent, the most for one user" in refused(await pinged(path, NOBODY))
                assert isinstance(await pinged(path, SOMEBODY), Result)
                assert isinstance(await pinged(path, 0), Result)
            while isinstance(await pinged(path, NOBODY), Refused):
                pass  # the server has not seen yet that they have closed

    asyncio.run(body())


@as_root
def test_all_users_together_leave_root_its_place() -> None:
    async def body() -> None:
        async with server() as path:
            with ExitStack() as held:
                for number in range(quotas.OTHERS_CONNECTIONS_MAX):
                    held.enter_context(connect(path, 60_000 + number // quotas.USER_CONNECTIONS_MAX))
                    await asyncio.sleep(0)  # the server has its turn: so many do not wait to be accepted
                assert "users other than root hold 128 connections" in refused(await pinged(path, NOBODY))
                assert isinstance(await pinged(path, 0), Result)

    asyncio.run(body())


@as_root
def test_half_requests_of_one_user_take_a_bounded_memory() -> None:
    size = REQUEST_LIMIT - 1

    async def body() -> None:
        async with server() as path:
            with ExitStack() as held:
                links = [held.enter_context(connect(path, NOBODY)) for _ in range(8)]
                begun = [asyncio.ensure_future(send(link, LENGTH.pack(size) + bytes(size - 1))) for link in links]
                told = [asyncio.ensure_future(heard(link)) for link in links]
                done, _ = await asyncio.wait(told, timeout=PATIENCE_S, return_when=asyncio.FIRST_COMPLETED)
                assert f"bytes of {quotas.USER_BYTES_MAX}, the most for one user" in refused(done.pop().result())
                for uid in (NOBODY, SOMEBODY, 0):
                    assert isinstance(await pinged(path, uid), Result), "a small request is always heard"
                for task in (*begun, *told):
                    task.cancel()
                await asyncio.gather(*begun, *told, return_exceptions=True)

    asyncio.run(body())


def test_bytes_of_requests_are_counted_until_they_are_answered() -> None:
    counted = Admission()
    most = quotas.OTHERS_BYTES_MAX // quotas.USER_BYTES_MAX
    for uid in range(60_000, 60_000 + most):
        counted.hold(uid, quotas.USER_BYTES_MAX)
    with pytest.raises(RefusedError, match="the most for all of them"):
        counted.hold(NOBODY, 1)
    counted.hold(0, quotas.USER_BYTES_MAX)
    counted.let_go(60_000, quotas.USER_BYTES_MAX)
    counted.hold(NOBODY, 1)


def test_a_connection_without_a_request_is_hung_up_on_with_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_server, "IDLE_S", 0.05)

    async def body() -> None:
        async with server() as path:
            with connect(path, os.geteuid()) as link:
                assert "nothing was asked on this connection" in refused(await heard(link))

    asyncio.run(body())


@pytest.mark.parametrize("begun", [b"\0", LENGTH.pack(100), LENGTH.pack(100) + b"half"])
def test_a_request_that_was_begun_must_come_to_its_end(monkeypatch: pytest.MonkeyPatch, begun: bytes) -> None:
    monkeypatch.setattr(control_server, "REQUEST_S", 0.05)

    async def body() -> None:
        async with server() as path:
            with connect(path, os.geteuid()) as link:
                await send(link, begun)
                assert "a request was begun" in refused(await heard(link))

    asyncio.run(body())


def test_who_waits_for_an_answer_may_wait_as_long_as_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_server, "IDLE_S", 0.05)
    monkeypatch.setattr(control_server, "REQUEST_S", 0.05)

    async def body() -> None:
        async with server() as path:
            with connect(path, os.geteuid()) as waiting, connect(path, os.geteuid()) as idle:
                await ask(waiting, "wait")
                await heard(idle)  # its limit is over, and so would be the other's
                with pytest.raises(BlockingIOError):
                    waiting.recv(1)

    asyncio.run(body())


def test_requests_one_after_another_on_one_connection_are_served() -> None:
    async def body() -> None:
        async with server() as path:
            with connect(path, os.geteuid()) as link:
                for _ in range(3):
                    await ask(link, "ping")
                    assert isinstance(await heard(link), Result)
                await ask(link, "wait")
                await ask(link, "ping")
                assert "another request came before the answer" in refused(await heard(link))

    asyncio.run(body())


def test_a_client_that_was_hung_up_on_hears_why_at_its_next_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_server, "IDLE_S", 0.05)

    def late(path: Path) -> str:
        with Control.open(path) as agent:
            with socket.socket(fileno=os.dup(agent.fileno())) as link:
                link.recv(1, socket.MSG_PEEK)  # the agent has said why
            with pytest.raises(AgentRefusedError) as told:
                agent.ask("ping")
        return str(told.value)

    async def body() -> None:
        async with server() as path:
            assert "nothing was asked on this connection" in await asyncio.to_thread(late, path)

    asyncio.run(body())


def test_a_client_waits_for_its_turn_while_many_others_wait(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    with ExitStack() as held, socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen(4)
        full = 0
        while not full:
            waiting = held.enter_context(socket.socket(socket.AF_UNIX))
            waiting.setblocking(False)
            full = waiting.connect_ex(str(path))
        assert full == errno.EAGAIN
        with ThreadPoolExecutor() as threads:
            asking = threads.submit(Control.open, path)
            with pytest.raises(TimeoutError):
                asking.result(0.2)
            held.enter_context(listener.accept()[0])
            asking.result(PATIENCE_S).close()
