"""What is served: the page, its WebSocket, orders, metrics. The only import of starlette.

Who may do what is the agent's to decide; here is decided who it is that asks, and that the question comes from our own page:

* On the loopback, Host must be the address that is listened at: a name of another site that leads here is refused, and so is
  localhost, which can be another user's program at the other family's address.
* A WebSocket and a POST must have our own Origin; a POST must be JSON, with the session's token.
* The cookie is HttpOnly and SameSite=Strict, and Secure under TLS. Nothing of another site is loaded or connected to.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import contextlib
import logging
import math
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from checkpoint.errors import UNDECODABLE
from failover.config import accounts
from failover.config.page import PageConfig
from failover.config.rights import is_loopback
from failover.errors import AgentRefusedError, FailoverError
from page import exposition
from page.agent_link import AgentLink, ask_once
from page.assets import Assets
from page.errors import TurnedAwayError
from page.feeds import Feed, Feeds
from page.limits import (
    ASKED_A_S,
    ASKED_AT_ONCE,
    BODY_S,
    BODY_SIZE_MAX,
    HEALTH_S,
    LIVE_SIZE_MAX,
    PAGE_SESSIONS_MAX,
    SESSIONS_OF_USER_MAX,
)
from page.loopback_user import uid_of
from page.orders import BOOT, Orders, Wish
from page.passwords import Passwords
from page.picture import of_items, of_tasks
from page.rate import Rates
from page.sessions import Session, Sessions
from page.viewers import People, Viewer

LOG: Final = logging.getLogger("failover.page")

COOKIE: Final = "failover"
SECURE_COOKIE: Final = "__Host-failover"
"""With the port after it: a browser gives a cookie of one port of a host to all its ports, where other robots' pages may be."""

TOKEN_HEADER: Final = "x-failover-token"

HEADERS: Final = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}
YEAR_S: Final = 365 * 24 * 3600

POLICY_VIOLATED: Final = 1008
TRY_AGAIN: Final = 1013
"""Close codes. Source: RFC 6455, 7.4.1; the IANA registry of WebSocket close codes."""

T = TypeVar("T")


class Login(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Name and password."""

    name: str
    password: str


class Risk(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question before ``promote``."""

    name: str
    robot: str = ""


class Page:
    """The application."""

    def __init__(self, config: PageConfig, port: int, socket: Path | None = None) -> None:
        """
        Args:
            port: at which it listens.
            socket: the agent's; None: the usual place.
        """
        host, _ = config.address
        self._server = (host, port)
        self._is_local = is_loopback(host)
        self._is_secure = bool(config.certificate)
        self._socket = socket
        self._assets = Assets()
        self._users = config.users
        self.sessions = Sessions()
        self._passwords = Passwords(config.users)
        self._asked = Rates(ASKED_A_S, ASKED_AT_ONCE)
        self._probe: asyncio.Task[bool] | None = None
        self._probed_s = 0.0
        self._feeds = Feeds(socket)
        self._people = People(self._feeds)
        self._orders = Orders(socket, self._people.changed)
        self._people.orders = self._orders
        self.app = Guarded(
            Starlette(
                routes=[
                    Route("/", self._served(self._index)),
                    Route("/assets/{name}", self._served(self._asset)),
                    Route("/session", self._served(self._session)),
                    Route("/login", self._served(self._login), methods=["POST"]),
                    Route("/logout", self._served(self._logout), methods=["POST"]),
                    Route("/orders", self._served(self._order), methods=["POST"]),
                    Route("/risks", self._served(self._risks), methods=["POST"]),
                    Route("/metrics", self._served(self._metrics)),
                    Route("/healthz", self._served(self._health)),
                    WebSocketRoute("/live", self._live),
                ],
                lifespan=self._lifespan,
            ),
            is_secure=self._is_secure,
        )

    @contextlib.asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        yield
        await self._orders.close()
        await self._feeds.close()
        self._passwords.close()

    def _served(self, answer: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
        """The same, with its errors as sentences."""

        async def serve(request: Request) -> Response:
            try:
                self._check_host(request)
                return await answer(request)
            except TurnedAwayError as error:
                again = {"retry-after": str(math.ceil(error.again_s))} if error.again_s else {}
                return _json({"error": str(error), "again_ms": math.ceil(error.again_s * 1000)}, error.status, again)
            except AgentRefusedError as error:
                return _json({"error": str(error)}, 409)
            except FailoverError as error:
                return _json({"error": str(error)}, 503)

        return serve

    # --- Who asks --------------------------------------------------------------------------------------------------

    def _check_host(self, asked: HTTPConnection) -> None:
        name, _ = _host(asked)
        own = f"[{self._server[0]}]" if ":" in self._server[0] else self._server[0]
        if self._is_local and name != own:
            raise TurnedAwayError(
                421, f"this page is at {own}, not at {name[:64]!r}: write {own} where your browser shows the address"
            )

    def _cookie(self, asked: HTTPConnection) -> str:
        return f"{SECURE_COOKIE if self._is_secure else COOKIE}-{_host(asked)[1]}"

    def _check_origin(self, asked: HTTPConnection) -> None:
        origin = asked.headers.get("origin", "")
        scheme = "https" if self._is_secure else "http"
        if origin != f"{scheme}://{asked.headers.get('host', '')}":
            raise TurnedAwayError(
                403, f"only this page itself may ask for that, and the request comes from {origin[:64] or 'no page'!r}"
            )

    def _local_user(self, asked: HTTPConnection) -> tuple[str, int | None] | None:
        """Who has connected, as the kernel tells; None where people log in. Root and this process's own user act as this process.

        Raises:
            TurnedAwayError: it cannot be told.
        """
        if self._users:
            return None
        uid = self._peer(asked)
        assert uid is not None, "PageConfig.check: without users it listens on the loopback"
        return accounts.name_of(uid) or f"uid {uid}", on_behalf_of(uid)

    def _peer(self, asked: HTTPConnection) -> int | None:
        """The user of this robot whose program has connected; None where other machines may connect.

        Raises:
            TurnedAwayError: it cannot be told.
        """
        if not self._is_local:
            return None
        client = asked.client
        uid = uid_of((client.host, client.port), self._server) if client is not None else None
        if uid is None:
            raise TurnedAwayError(403, "the kernel does not tell whose program has connected; connect from this robot itself")
        return uid

    def _place(self, asked: HTTPConnection) -> str:
        """From where it is asked, for limits: a user of this robot, or an address. Raises as `_peer`."""
        peer = self._peer(asked)
        return f"uid {peer}" if peer is not None else asked.client.host if asked.client else ""

    def _check_rate(self, asked: HTTPConnection) -> None:
        """Raises TurnedAwayError: it asks too often."""
        if wait_s := self._asked.wait_s(f"{asked.url.path} {self._place(asked)}"):
            raise TurnedAwayError(429, "too many requests in a short time", wait_s)

    def _known(self, asked: HTTPConnection) -> Session:
        """The session of a request.

        Raises:
            TurnedAwayError: there is none, or it is another user's. A browser gives the cookie to every port of this machine, so
                the user whose program has connected must be the same, too.
        """
        cookie = asked.cookies.get(self._cookie(asked), "")
        session = self.sessions.of(cookie) if cookie else None
        if session is None:
            raise TurnedAwayError(401, "no session: load the page anew")
        if self._peer(asked) != session.peer:
            raise TurnedAwayError(403, "this session is another user's: load the page anew")
        return session

    async def _posted(self, request: Request, kind: type[T]) -> tuple[Session, T]:
        """The session and the body of a POST that comes from our own page.

        Raises:
            TurnedAwayError: it does not.
        """
        self._check_origin(request)
        session = self._known(request)
        if not session.is_token(request.headers.get(TOKEN_HEADER, "")):
            raise TurnedAwayError(403, "the token of this session is missing: load the page anew")
        return session, await _body(request, kind)

    # --- Answers ----------------------------------------------------------------------------------------------------

    async def _index(self, _request: Request) -> Response:
        return Response(self._assets.index, media_type="text/html; charset=utf-8")

    async def _asset(self, request: Request) -> Response:
        asset = self._assets.get(request.path_params["name"])
        if asset is None:
            raise TurnedAwayError(404, "there is no such file; load the page anew")
        return Response(asset.content, media_type=asset.kind, headers={"cache-control": "public, max-age=31536000, immutable"})

    async def _session(self, request: Request) -> Response:
        """Who am I? Begins a session where no login is needed."""
        self._check_rate(request)
        try:
            return self._told(self._known(request))
        except TurnedAwayError:
            user = self._local_user(request)
        if user is None:
            raise TurnedAwayError(401, "log in")
        return await self._begun(request, *user)

    async def _begun(self, request: Request, user: str, uid: int | None) -> Response:
        """A session of a user for whom the agent answers: those whom it refuses take no place of others.

        Raises:
            FailoverError: it does not answer.
        """
        if uid is not None:
            await ask_once(self._socket, "ping", uid)
        session = self.sessions.begin(user, uid, self._peer(request))
        response = self._told(session)
        response.set_cookie(self._cookie(request), session.id, path="/", httponly=True, samesite="strict", secure=self._is_secure)
        return response

    def _told(self, session: Session) -> Response:
        return _json({"user": session.user, "token": session.token, "boot": BOOT, "login": bool(self._users)})

    async def _login(self, request: Request) -> Response:
        self._check_origin(request)
        wanted = await _body(request, Login)
        if not self._users:
            raise TurnedAwayError(404, "there is no login here: the kernel tells whose program has connected")
        await self._passwords.check(wanted.name, wanted.password, self._place(request), forgives=True)
        LOG.info("%s has logged in from %s", wanted.name, self._place(request))
        return await self._begun(request, wanted.name, self._account(wanted.name))

    def _account(self, name: str) -> int | None:
        account = self._users[name].account
        if not account:
            return None
        uid = accounts.uid_of(account)
        if uid is None:
            raise TurnedAwayError(403, f"page.toml: users.{name}: this robot has no account {account!r}")
        return on_behalf_of(uid)

    async def _logout(self, request: Request) -> Response:
        session, _ = await self._posted(request, dict[str, Any])
        self.sessions.end(session)
        return _json({})

    async def _order(self, request: Request) -> Response:
        session, wish = await self._posted(request, Wish)
        return _json({"number": self._orders.give(session, wish)}, 202)

    async def _risks(self, request: Request) -> Response:
        self._check_rate(request)
        session, wanted = await self._posted(request, Risk)
        told = await self._orders.risks(session, wanted.name, wanted.robot)
        return _json({"sentence": told.get("sentence", ""), "risks": told.get("risks", []), "to": told.get("to", "")})

    async def _metrics(self, request: Request) -> Response:
        self._check_rate(request)
        uid = await self._scraper(request)
        async with await AgentLink.open(self._socket) as link:
            status = await link.ask("status", uid)
            around = await self._feeds.around()
            may = await Feed(uid).rights(link, status, around, [])
        found = exposition.Exposition()
        exposition.of_team(found, status)
        exposition.of_components(found, status["components"])
        exposition.of_board(found, [*of_items(around.items, str(status["team"]), may).values()])
        exposition.of_tasks(found, [*of_tasks(around.tasks, status, around.owners, may).values()])
        exposition.of_page(found, len(self.sessions), self._orders.ended)
        return Response(found.text(), headers={"content-type": exposition.CONTENT_TYPE})

    async def _scraper(self, request: Request) -> int | None:
        """On whose behalf metrics are asked for: who has connected, or who a name and a password say."""
        user = self._local_user(request)
        if user is not None:
            return user[1]
        try:
            scheme, _, told = request.headers.get("authorization", "").partition(" ")
            name, _, password = base64.b64decode(told, validate=True).decode().partition(":")
        except (binascii.Error, UnicodeDecodeError):
            scheme = name = password = ""
        if scheme.lower() != "basic" or not name:
            raise TurnedAwayError(401, "metrics need a name and a password of page.toml (basic_auth of Prometheus)")
        await self._passwords.check(name, password, self._place(request), forgives=False)
        return self._account(name)

    async def _health(self, _request: Request) -> Response:
        """Anyone may ask: one question a second to the agent, however many ask us, and no word more than its answer."""
        now_s = time.monotonic()
        if self._probe is None or (self._probe.done() and now_s - self._probed_s > HEALTH_S):
            self._probe, self._probed_s = asyncio.create_task(self._answers()), now_s
        is_there = await asyncio.shield(self._probe)
        return _json({"agent": is_there}, 200 if is_there else 503)

    async def _answers(self) -> bool:
        """Whether the agent answers."""
        try:
            await ask_once(self._socket, "ping")
        except FailoverError:
            return False
        return True

    # --- Live -------------------------------------------------------------------------------------------------------

    async def _live(self, link: WebSocket) -> None:
        """One client, from its first word to its last."""
        wake = asyncio.Event()
        try:
            self._check_host(link)
            self._check_origin(link)
            session = self._known(link)
            if len(self._people.viewers) >= PAGE_SESSIONS_MAX:
                raise TurnedAwayError(503, f"{PAGE_SESSIONS_MAX} windows of this page are open, the most there may be")
            if self._people.windows_of(session) >= SESSIONS_OF_USER_MAX:
                raise TurnedAwayError(503, f"{SESSIONS_OF_USER_MAX} windows of {session.user} are open; close one of them")
            feed = self._feeds.take(session.uid, wake)
        except TurnedAwayError as error:
            await link.accept()  # a browser tells its script a reason only of a connection that was accepted
            await _closed(link, TRY_AGAIN if error.status == 503 else POLICY_VIOLATED, str(error))
            return
        viewer = Viewer(session, feed, self._people, wake, self._socket)
        await link.accept()
        self._people.viewers.add(viewer)
        session.live += 1
        self._people.changed()
        try:
            await self._conversed(link, viewer)
        finally:
            session.live -= 1
            session.seen_s = time.monotonic()
            self._people.viewers.discard(viewer)
            self._people.changed()
            self._feeds.give_back(feed, wake)
            await viewer.close()

    async def _conversed(self, link: WebSocket, viewer: Viewer) -> None:
        tasks = {
            asyncio.ensure_future(viewer.speak(link.send_text)),
            asyncio.ensure_future(viewer.listen(lambda: _heard(link))),
            asyncio.ensure_future(self._until_over(viewer.session)),
        }
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            error = task.exception()
            if isinstance(error, TurnedAwayError):
                await _closed(link, POLICY_VIOLATED, str(error))
            elif error is not None and not isinstance(error, WebSocketDisconnect | RuntimeError | OSError):
                raise error

    async def _until_over(self, session: Session) -> None:
        """Until the session has ended: by a logout in another window, or with time."""
        while not self.sessions.is_over(session):
            await asyncio.sleep(1)
        raise TurnedAwayError(401, "this session is over")


class Guarded:
    """Puts the headers of security on every answer, also on those of mistakes."""

    def __init__(self, app: ASGIApp, *, is_secure: bool) -> None:
        self._app = app
        self._headers = HEADERS | ({"strict-transport-security": f"max-age={YEAR_S}"} if is_secure else {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        await self._app(scope, receive, guarded)


def _host(asked: HTTPConnection) -> tuple[str, str]:
    """Name and port that the client believes to ask; at the end of a tunnel the port is another one than ours."""
    said = asked.headers.get("host", "")
    name, separator, port = said.rpartition(":")
    return (name, port) if separator and port.isascii() and port.isdigit() else (said, "")


def on_behalf_of(uid: int) -> int | None:
    """On whose behalf the agent is asked: None for root and our own user, for whom we ask as ourselves."""
    return None if uid in (0, os.geteuid()) else uid


async def _heard(link: WebSocket) -> str:
    message = await link.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1000))
    text = message.get("text")
    if text is None or len(text) > LIVE_SIZE_MAX:
        raise TurnedAwayError(400, "a message that no page of ours sends")
    return str(text)


async def _closed(link: WebSocket, code: int, reason: str) -> None:
    with contextlib.suppress(RuntimeError, OSError):
        await link.close(code, reason.encode()[:REASON_SIZE_MAX].decode(errors="ignore"))


REASON_SIZE_MAX: Final = 120
"""Bytes of a close reason. Source: RFC 6455, 5.5: 125 with the code."""


async def _body(request: Request, kind: type[T]) -> T:
    """What was posted.

    Raises:
        TurnedAwayError: it is too large, too slow, or not what our page posts.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise TurnedAwayError(415, "write application/json")
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for piece in request.stream():
                content += piece
                if len(content) > BODY_SIZE_MAX:
                    raise TurnedAwayError(413, f"more than {BODY_SIZE_MAX} bytes")
    except ClientDisconnect:
        raise TurnedAwayError(400, "the request ended in its middle") from None
    except TimeoutError:
        raise TurnedAwayError(408, f"the request did not end within {BODY_S:.0f} s") from None
    try:
        return msgspec.json.decode(bytes(content), type=kind)
    except UNDECODABLE as error:
        raise TurnedAwayError(400, f"a request that no page of ours sends: {error}") from error


def _json(value: dict[str, Any], status: int = 200, headers: dict[str, str] | None = None) -> Response:
    return Response(msgspec.json.encode(value), status, {"content-type": "application/json", **(headers or {})})
