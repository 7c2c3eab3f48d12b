"""The board live for Foxglove, Lichtblick and other programs of the Foxglove WebSocket protocol. The only ``foxglove`` import.

The server is the SDK's. It speaks the protocol in threads of its own; the board is read by the thread that calls `Stream.run`. A
program that subscribes to an item gets the newest value at once, then each put. It can put nothing.

Source: Foxglove WebSocket protocol, subprotocol ``foxglove.sdk.v1``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Final

from failover.core.board.recording import Schema
from failover.errors import RecordingError

if TYPE_CHECKING:
    from failover.recording.follower import Follower

WISHES_MAX: Final = 4096
"""Subscriptions that wait to be answered; of more, those that have waited longest are answered with the next put."""


def check_address(address: str, unsafe: bool) -> None:
    """Refuse an address at which others than users of this machine can listen.

    Raises:
        RecordingError: it is none, or not this machine's alone and ``unsafe`` does not allow it.
    """
    try:
        where = ip_address(address)
    except ValueError:
        raise RecordingError(f"{address[:60]!r} is no IP address; 127.0.0.1 is this machine alone") from None
    if not where.is_loopback and not unsafe:
        raise RecordingError(
            f"refused to listen at {address}: the protocol knows no users and no encryption, so all who reach this machine would "
            "read the board; forward the port with ssh -L, or give --unsafe-listen"
        )


class LiveServer:
    """A server, which is a `failover.recording.stream.Sink`; a context manager.

    Attributes:
        port: at which it listens.
    """

    def __init__(self, name: str, address: str, port: int, follower: Follower) -> None:
        """Listen; ``port`` 0: at any.

        Raises:
            RecordingError: the port is taken, or the library is missing.
        """
        try:
            import foxglove
        except ImportError:
            raise RecordingError(
                "to serve Foxglove needs the library foxglove-sdk, which is not installed: pip install 'failover[foxglove]'"
            ) from None
        self._foxglove: Any = foxglove
        self._follower = follower
        self._context: Any = foxglove.Context()
        self._channels: list[Any] = []
        self._items: dict[str, tuple[str, str]] = {}
        self._numbers: dict[str, int] = {}
        self._wishes: deque[str] = deque(maxlen=WISHES_MAX)
        try:
            self._server = self._foxglove.start_server(
                name=name, host=address, port=port, context=self._context, server_listener=self
            )
        except (RuntimeError, OSError) as error:
            raise RecordingError(f"cannot listen at {address}, port {port}: {error}; give another port") from error
        self.port = int(self._server.port)

    def __enter__(self) -> LiveServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    # --- As a sink ---

    def channel(self, topic: str, schema: Schema | None, metadata: Mapping[str, str]) -> int:
        """Advertise a channel; one of the same topic, which is declared otherwise, is no longer there."""
        if topic in self._numbers:
            self._channels[self._numbers[topic]].close()
        text = None if schema is None else self._foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.content)
        self._channels.append(
            self._foxglove.Channel(topic, schema=text, message_encoding="json", metadata=dict(metadata), context=self._context)
        )
        if "item" in metadata:
            self._items[topic] = (metadata["robot"], metadata["item"])
        self._numbers[topic] = len(self._channels) - 1
        return self._numbers[topic]

    def add(self, channel: int, log_ns: int, _publish_ns: int, _sequence: int, content: bytes) -> None:
        """Send a message to those that have subscribed."""
        self._channels[channel].log(content, log_time=log_ns)

    # --- As a listener, in the server's threads ---

    def on_subscribe(self, _client: object, channel: Any) -> None:
        self._wishes.append(channel.topic)

    def on_unsubscribe(self, _client: object, _channel: Any) -> None:
        """Nothing: the SDK sends only what is subscribed to."""

    def fulfil(self) -> None:
        """Have the next look give the newest values of what was subscribed to."""
        while self._wishes:
            item = self._items.get(self._wishes.popleft())
            if item is not None:
                self._follower.again(*item)
