"""A client of etcd over its JSON gateway: leases, transactions, and users. Source: etcd.io/docs/v3.4/dev-guide/api_grpc_gateway.

Numbers of 64 bits travel as strings, keys and values as base64. A request that etcd does not answer in time may be carried out
all the same, and later: whoever asks compares revisions (`failover.core.election.coordinator`).
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import math
import ssl
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import msgspec

from agent.coordinator_config import CoordinatorConfig
from agent.errors import CoordinatorError
from checkpoint.errors import UNDECODABLE
from failover.core.election.coordinator import Answer, Grant, KeepAlive, Leased, Put, Request, Swap, Swapped

MS_A_SECOND: Final = 1_000
ANSWER_SIZE_MAX: Final = 16 << 20
UNAUTHORIZED: Final = 401
"""The status of an answer to a token that is over; etcd's tokens last for five minutes."""

BUSY: Final = 429
"""This status, and those from 500 on, are the endpoint's own trouble: another one may do better."""

STALE_TOKEN: Final = ("invalid auth token", "revision of auth store is old")
"""The second: of a token of kind jwt, once any account of etcd has changed."""

STALE_CONNECTION: Final = (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError)
"""etcd has closed a connection that was kept."""

NO_LEASE: Final = "requested lease not found"

BODY_SHOWN: Final = 200
"""Of an answer that is an error."""


class Etcd:
    """One etcd cluster, asked by one robot. ``patience_s``: for each step of a request, to each endpoint."""

    def __init__(self, config: CoordinatorConfig, patience_s: float) -> None:
        self._config, self._patience_s = config, patience_s
        self._endpoints = list(config.endpoints)
        self._connection: http.client.HTTPConnection | None = None
        self._token = ""

    def answer(self, request: Request) -> Answer:
        """Have etcd carry a request out.

        Raises:
            CoordinatorError: it did not, as far as is known.
        """
        try:
            return self._answer(request)
        except (KeyError, TypeError, AttributeError, OverflowError, *UNDECODABLE) as error:
            raise CoordinatorError(
                f"{self._endpoints[0]} does not answer as etcd does ({error!r}); check [coordinator]"
            ) from error

    def _answer(self, request: Request) -> Answer:
        match request:
            case KeepAlive(lease):
                told = self._ask("lease/keepalive", {"ID": str(lease)}).get("result", {})
                return Leased(lease if int(told.get("TTL", 0)) > 0 else 0)
            case Grant(ttl_ms):
                told = self._ask("lease/grant", {"TTL": str(math.ceil(ttl_ms / MS_A_SECOND))})
                return Leased(int(told["ID"]))
        try:
            return self._swap(request)
        except CoordinatorError as error:
            if NO_LEASE not in str(error):
                raise
            return Leased(0)

    def version(self) -> str:
        """Of the server that answers.

        Raises:
            CoordinatorError: none does.
        """
        return str(self._ask("maintenance/status", {}).get("version", "unknown"))

    def close(self) -> None:
        """Hang up."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None

    def _swap(self, request: Swap) -> Swapped:
        prefix = request.prefix.encode()
        last = prefix[:-1] + bytes((prefix[-1] + 1,))
        whole = {"request_range": {"key": _encoded(prefix), "range_end": _encoded(last)}}
        told = self._ask("kv/txn", {"success": [*map(_put, request.puts), whole]})
        *done, read = told["responses"]
        is_done = all(one["response_txn"].get("succeeded", False) for one in done)
        found = {}
        for one in read["response_range"].get("kvs", ()):
            found[_decoded(one["key"]).decode()] = _decoded(one.get("value", "")), int(one["mod_revision"])
        return Swapped(is_done, int(told["header"]["revision"]), found, int(told["header"]["cluster_id"]))

    def _ask(self, method: str, body: dict[str, Any]) -> dict[str, Any]:
        """The answer of the first endpoint that gives one. An earlier one may have carried the request out: revisions tell."""
        troubles = []
        for _ in range(len(self._endpoints)):
            try:
                return self._asked(method, body)
            except _RefusedError as error:
                if not error.is_of_the_endpoint:
                    raise CoordinatorError(f"etcd at {self._endpoints[0]} refuses {method}: {error}") from error
                troubles.append(f"{self._endpoints[0]}: {error}")
            except (OSError, http.client.HTTPException, KeyError, *UNDECODABLE) as error:
                troubles.append(f"{self._endpoints[0]}: {_words(error)}")
            self.close()
            self._endpoints.append(self._endpoints.pop(0))
        raise CoordinatorError(
            f"no etcd answers ({'; '.join(troubles)}); check [coordinator] endpoints, the network, and that a majority of etcd's "
            "members runs"
        )

    def _asked(self, method: str, body: dict[str, Any]) -> dict[str, Any]:
        had_token = bool(self._token)
        try:
            return self._authenticated(method, body)
        except _RefusedError as error:
            if not (error.is_token and had_token):
                self._token = "" if error.is_token else self._token
                raise
        self._token = ""
        return self._authenticated(method, body)

    def _authenticated(self, method: str, body: dict[str, Any]) -> dict[str, Any]:
        if self._config.user and not self._token:
            told = self._posted("auth/authenticate", {"name": self._config.user, "password": self._password()})
            self._token = str(told["token"])
        return self._posted(method, body)

    def _password(self) -> str:
        try:
            return Path(self._config.password_file).read_text(encoding="utf-8").rstrip("\n")
        except OSError as error:
            raise CoordinatorError(f"cannot read [coordinator] password_file {error.filename}: {error.strerror}") from error

    def _posted(self, method: str, body: dict[str, Any]) -> dict[str, Any]:
        was_kept = self._connection is not None and self._connection.sock is not None
        try:
            return self._exchanged(method, body)
        except STALE_CONNECTION:
            self.close()
            if not was_kept:
                raise
        return self._exchanged(method, body)

    def _exchanged(self, method: str, body: dict[str, Any]) -> dict[str, Any]:
        connection = self._connected()
        headers = {"Content-Type": "application/json"} | ({"Authorization": self._token} if self._token else {})
        connection.request("POST", f"/v3/{method}", msgspec.json.encode(body), headers)
        response = connection.getresponse()
        content = response.read(ANSWER_SIZE_MAX)
        if response.status != http.client.OK:
            raise _RefusedError(response.status, content)
        told: dict[str, Any] = msgspec.json.decode(content, type=dict[str, Any])
        return told

    def _connected(self) -> http.client.HTTPConnection:
        if self._connection is None:
            parts = urlsplit(self._endpoints[0])
            host, port = str(parts.hostname), parts.port
            if parts.scheme == "https":
                self._connection = http.client.HTTPSConnection(host, port, timeout=self._patience_s, context=self._context())
            else:
                self._connection = http.client.HTTPConnection(host, port, timeout=self._patience_s)
        return self._connection

    def _context(self) -> ssl.SSLContext:
        try:
            context = ssl.create_default_context(cafile=self._config.ca or None)
            if self._config.certificate:
                context.load_cert_chain(self._config.certificate, self._config.key)
        except OSError as error:
            files = ", ".join(filter(None, (self._config.ca, self._config.certificate, self._config.key)))
            raise CoordinatorError(f"[coordinator] one of the files {files} cannot be used: {_words(error)}") from error
        return context


class _RefusedError(Exception):
    """etcd has heard the request and says no."""

    def __init__(self, status: int, content: bytes) -> None:
        said = content.decode(errors="replace")
        with contextlib.suppress(AttributeError, *UNDECODABLE):
            said = str(msgspec.json.decode(content).get("error", said))
        super().__init__(f"{said[:BODY_SHOWN].strip()} (status {status})")
        self.is_token = status == UNAUTHORIZED or any(words in said for words in STALE_TOKEN)
        self.is_of_the_endpoint = status == BUSY or status >= http.client.INTERNAL_SERVER_ERROR


def _put(put: Put) -> dict[str, Any]:
    """A transaction within the transaction: what is compared here holds up nothing else."""
    compared = [
        {"key": _encoded(key), "target": "MOD", "result": "EQUAL", "mod_revision": str(revision)}
        for key, revision in put.compared
    ]
    done = {"request_put": {"key": _encoded(put.key), "value": _encoded(put.value), "lease": str(put.lease)}}
    return {"request_txn": {"compare": compared, "success": [done]}}


def _words(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else "") or str(error) or type(error).__name__


def _encoded(content: str | bytes) -> str:
    return base64.b64encode(content.encode() if isinstance(content, str) else content).decode()


def _decoded(content: str) -> bytes:
    return base64.b64decode(content)
