"""Listens, and serves the page until it is told to end. The only import of uvicorn."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import ssl
from collections import Counter
from pathlib import Path
from typing import ClassVar, Final

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from failover.config.page import PageConfig
from failover.config.rights import is_loopback
from failover.errors import PageError
from page.app import Page
from page.limits import CONNECTIONS_MAX, CONNECTIONS_OF_ONE_MAX, HEAD_S, HEAD_SIZE_MAX, LIVE_SIZE_MAX
from page.loopback_user import uid_of

KEEP_ALIVE_S: Final = round(HEAD_S)
SHUTDOWN_S: Final = 2
"""How long clients may take to hang up when the page ends."""

PING_S: Final = 20.0
"""Between two questions whether a client is still there, and how long its answer may take."""

WAITING_MAX: Final = 128
"""Connections that wait to be taken."""


class FairProtocol(H11Protocol):  # type: ignore[misc]  # uvicorn's types are not read
    """HTTP; hangs up on a client that sends no whole head in time, and on the connections of one client beyond a limit."""

    _open: ClassVar[Counter[str]] = Counter()
    _whose = ""
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Count it, and wait for the first head."""
        super().connection_made(transport)
        self._whose = self._client()
        self._open[self._whose] += 1
        if self._open[self._whose] > CONNECTIONS_OF_ONE_MAX:
            transport.abort()
        else:
            self._late = self.loop.call_later(HEAD_S, transport.close)

    def handle_events(self) -> None:
        """Wait for the rest of a head, however slowly it comes, and for the next one."""
        super().handle_events()
        if self.conn.their_state is not h11.IDLE:
            self._be_patient()
        elif self._late is None:
            self._late = self.loop.call_later(HEAD_S, self.transport.close)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """It is no connection of ours from here on."""
        self._leave()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count it no more."""
        self._leave()
        super().connection_lost(exc)

    def _client(self) -> str:
        """A user of this robot, or an address."""
        host = self.client[0] if self.client else ""
        if self.client is None or self.server is None or self.server[1] is None or not is_loopback(host):
            return host
        return f"uid {uid_of(self.client, (self.server[0], self.server[1]))}"

    def _be_patient(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    def _leave(self) -> None:
        self._be_patient()
        if self._whose:
            self._open[self._whose] -= 1
            if not self._open[self._whose]:
                del self._open[self._whose]
            self._whose = ""


def serve(config: PageConfig, agent: Path | None, *, as_json: bool) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        agent: its control socket; None: the usual place.
        as_json: say where it listens as one JSON object.

    Raises:
        PageError: it may not listen there, or cannot; or the certificate cannot be used.
    """
    config.check()
    tls = _tls(config)
    listening = _listening(*config.address)
    port = int(listening.getsockname()[1])
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    page = Page(config, port, agent)
    server = uvicorn.Server(
        uvicorn.Config(
            page.app,
            loop="asyncio",
            http=FairProtocol,
            ws="websockets-sansio",
            ws_max_size=LIVE_SIZE_MAX * 4,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
            lifespan="on",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=CONNECTIONS_MAX,
            h11_max_incomplete_event_size=HEAD_SIZE_MAX,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=SHUTDOWN_S,
        )
    )
    server.config.load()
    server.config.ssl = tls
    host = config.address[0]
    place = f"{'https' if tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}/"
    if as_json:
        print(json.dumps({"address": host, "port": port, "url": place}), flush=True)
    else:
        print(f"the page is at {place}, until Ctrl-C", flush=True)
    server.run(sockets=[listening])


def _tls(config: PageConfig) -> ssl.SSLContext | None:
    if not config.certificate:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(config.certificate, config.key)
    except (OSError, ssl.SSLError) as error:
        raise PageError(f"cannot use the certificate {config.certificate} with the key {config.key}: {error}") from error
    return context


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listening.bind((host, port))
        listening.listen(WAITING_MAX)
    except OSError as error:
        listening.close()
        raise PageError(f"cannot listen at {host}, port {port}: {error.strerror}; give another one with --listen") from error
    return listening
