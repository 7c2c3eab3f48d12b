"""JSON objects that a person types into a connection: where each one ends; pure.

An object may be spread over lines, and several may come at once. Its end is the brace that closes its first one.
"""

from __future__ import annotations

from typing import Final

from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.errors import EnvelopeError

_QUOTE: Final = ord('"')
_ESCAPE: Final = ord("\\")
_OPEN: Final = ord("{")
_CLOSE: Final = ord("}")


class Typed:
    """What has come over one connection and is no whole object yet."""

    def __init__(self) -> None:
        self._held = bytearray()
        self._at = 0
        self._depth = 0
        self._is_text = False
        self._is_escaped = False

    def take(self, content: bytes) -> list[bytes]:
        """The objects that this completes.

        Raises:
            EnvelopeError: something else than an object begins, or it is too long; the connection is of no use any more.
        """
        self._held += content
        found: list[bytes] = []
        while self._at < len(self._held):
            byte = self._held[self._at]
            self._at += 1
            if not self._depth and byte != _OPEN:
                if not chr(byte).isspace():
                    raise EnvelopeError(f'a message begins with {{, not with {chr(byte)!r}: write {{"verb": "read"}}')
                del self._held[: self._at]
                self._at = 0
            elif self._next(byte):
                found.append(bytes(self._held[: self._at]))
                del self._held[: self._at]
                self._at = 0
        if len(self._held) > MESSAGE_SIZE_MAX:
            raise EnvelopeError(f"the message has more than {MESSAGE_SIZE_MAX} bytes and no end")
        return found

    def _next(self, byte: int) -> bool:
        """Whether this byte ends the object."""
        if self._is_escaped:
            self._is_escaped = False
        elif self._is_text:
            self._is_escaped = byte == _ESCAPE
            self._is_text = byte != _QUOTE
        elif byte == _QUOTE:
            self._is_text = True
        elif byte in (_OPEN, _CLOSE):
            self._depth += 1 if byte == _OPEN else -1
            return not self._depth
        return False
