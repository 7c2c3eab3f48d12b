"""The values of a driver's stream, as another process gets them; they come on when the driver runs on at another robot."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Final

import msgspec
from msgspec import UNSET

from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Encoding, Envelope
from failover.core.messaging.mailbox import MOVED, MS
from failover.drivers.actor import LEASE_NS
from failover.drivers.route import Route
from failover.drivers.sending import MOVED_NS, SECOND_NS, decoded, refused
from failover.errors import CallRefusedError, EnvelopeError

ASK_NS: Final = LEASE_NS // 3
"""Between two times that the stream is asked for: two may be lost."""

SILENT_PERIODS: Final = 3
SILENT_NS: Final = SECOND_NS
"""A stream that is silent for three of its periods, and for a second, is asked for again, wherever the driver is then."""

LINGER_MS: Final = 100
"""How long the farewell of a stream may take to leave."""


class Streaming:
    """One stream of one driver; a context manager, whose end tells the driver to send no more."""

    def __init__(self, route: Route, asked: Envelope, name: str, encoding: Encoding) -> None:
        """
        Args:
            route: for this stream alone; closed with it.
            asked: the ``_subscribe`` that asks for it.
            encoding: of what is asked, and so of the values.
        """
        self._route = route
        self._asked = asked
        self._name = name
        self._encoding = encoding
        self._again_ns = 0
        self._heard_ns = 0
        self._look_ns = 0
        self._silent_ns = SILENT_NS

    def __enter__(self) -> Streaming:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(EnvelopeError):
            farewell = msgspec.structs.replace(self._asked, verb="_unsubscribe", id="")
            self._route.way.send(envelopes.encode(farewell, self._encoding))
        self._route.close(LINGER_MS)

    def values(self) -> Iterator[Any]:
        """One after the other, without end.

        Raises:
            CallRefusedError: the driver has no such stream any more, or fails at it, or may not be called.
        """
        route = self._route
        while True:
            now_ns = route.now_ns()
            if now_ns >= self._again_ns:
                self._ask(now_ns)
            content = route.way.await_message(max(min(self._again_ns, self._heard_ns + self._silent_ns) - now_ns, MS))
            now_ns = route.now_ns()
            if content is not None:
                self._heard_ns = now_ns
                value = decoded(content)
                if value is not None and self._is_value(value):
                    yield None if value.ok is UNSET else value.ok
            elif route.way.is_lost:
                self._look(now_ns)
                if route.way.await_open(max(self._again_ns - route.now_ns(), MS), -1):
                    self._again_ns = 0
            elif now_ns >= self._heard_ns + self._silent_ns:
                self._look(now_ns)

    def _ask(self, now_ns: int) -> None:
        epoch = self._route.place.record.epoch
        content = envelopes.encode(msgspec.structs.replace(self._asked, epoch=epoch), self._encoding)
        self._heard_ns = now_ns
        if self._route.way.await_sent(content, SECOND_NS):
            self._again_ns = now_ns + ASK_NS
        else:
            self._look(self._route.now_ns())

    def _look(self, now_ns: int) -> None:
        """The driver may be elsewhere: it is asked there at once, else where it was, a little later."""
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + MOVED_NS
            if self._route.look_again():
                self._again_ns = 0
                return
        self._again_ns = self._look_ns

    def _is_value(self, value: Envelope) -> bool:
        """Whether a message that came is one of the stream's; others are answers to `_ask`."""
        if value.verb == self._name:
            if value.error is not UNSET:
                raise refused(value)
            return True
        if value.error is not UNSET:
            if value.error.kind == "no_message" and self._encoding != "json":
                self._encoding, self._again_ns = "json", 0
            elif value.error.kind in MOVED:
                self._look(self._route.now_ns())
            elif value.error.kind == "denied":
                raise refused(value)
        elif value.re == self._asked.id:
            rate_hz = value.ok
            if not isinstance(rate_hz, int | float) or rate_hz <= 0:
                path = self._route.path
                raise CallRefusedError(f"{path} has no stream {self._name!r}, or sends it to too many already", "unknown_verb")
            self._silent_ns = max(SILENT_NS, int(SILENT_PERIODS * SECOND_NS / rate_hz))
        return False
