"""Listens, and serves the page until it is told to end. The only import of uvicorn."""

from __future__ import annotations

import json
import logging
import socket
import ssl
from pathlib import Path
from typing import Final

import uvicorn

from failover.config.page import PageConfig
from failover.errors import PageError
from page.app import Page
from page.limits import CONNECTIONS_MAX, HEAD_SIZE_MAX, LIVE_SIZE_MAX

KEEP_ALIVE_S: Final = 20
SHUTDOWN_S: Final = 2
"""How long clients may take to hang up when the page ends."""

PING_S: Final = 20.0
"""Between two questions whether a client is still there, and how long its answer may take."""

WAITING_MAX: Final = 128
"""Connections that wait to be taken."""


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
            http="h11",
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
