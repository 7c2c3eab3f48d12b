"""A message's fields ⇄ Avro's single-object encoding; ``ENVELOPE.md`` has the schema.

This is the only ``fastavro`` import; it comes with the extra ``avro``, and is loaded with the first message in Avro.

``body``, ``ok`` and unknown fields travel as JSON text: their schema is a driver's own, and a recursive one would let a few bytes
nest deeper than the library's stack is.

Source: the Avro specification 1.11, "Single object encoding"; CRC-64-AVRO is its fingerprint of a schema.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from typing import Any, Final

from failover.errors import EnvelopeError

MARK: Final = b"\xc3\x01"
_FINGERPRINT_SIZE: Final = 8

_TEXT_OR_NONE: Final = ["null", "string"]
_HOP: Final = {
    "type": "record",
    "name": "Hop",
    "fields": [
        {"name": "who", "type": "string"},
        {"name": "came", "type": "long"},
        {"name": "left", "type": ["null", "long"]},
    ],
}
_FAULT: Final = {
    "type": "record",
    "name": "Fault",
    "fields": [{"name": "kind", "type": "string"}, {"name": "sentence", "type": "string"}],
}
_TYPES: Final[dict[str, Any]] = {
    "to": "string",
    "verb": "string",
    "body": _TEXT_OR_NONE,
    "id": "string",
    "from": "string",
    "by": "string",
    "boot": "long",
    "seq": "long",
    "after": "long",
    "had": "long",
    "reliable": "boolean",
    "deadline_ms": ["null", "double"],
    "epoch": "long",
    "hops": {"type": "array", "items": _HOP},
    "re": "string",
    "ok": _TEXT_OR_NONE,
    "error": ["null", _FAULT],
    "rest": {"type": "map", "values": "string"},
}
SCHEMA: Final[dict[str, Any]] = {
    "type": "record",
    "name": "Envelope",
    "namespace": "failover",
    "fields": [{"name": name, "type": kind} for name, kind in _TYPES.items()],
}

_MISREAD: Final = (EOFError, ValueError, LookupError, TypeError, OverflowError, struct.error)
"""What the library raises at bytes that are none of its own."""


READS_MAX: Final = 1 << 15
"""Reads of one message: the library reads a number byte by byte. All known fields, the most hops, and 2,000 further fields."""


class _Read:
    """Bytes as the library reads a file; it is never given more than there are, nor for ever in small pieces."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0
        self._reads = 0

    @property
    def left(self) -> int:
        return len(self._content) - self._at

    def read(self, size: int) -> bytes:
        if not 0 <= size <= self.left:
            raise EOFError(f"{size} bytes are announced, and {self.left} are left")
        self._reads += 1
        if self._reads > READS_MAX:
            raise EOFError(f"it holds too many fields: send what has more than {READS_MAX // 16:,} as JSON")
        self._at += size
        return self._content[self._at - size : self._at]


class _Written:
    """Bytes as the library writes a file."""

    def __init__(self) -> None:
        self.content = bytearray(MARK)

    def write(self, content: bytes) -> int:
        self.content += content
        return len(content)


@functools.cache
def _library() -> tuple[Any, Any, bytes]:
    """fastavro, the schema as it wants it, and that schema's fingerprint."""
    try:
        import fastavro
        from fastavro.schema import fingerprint, to_parsing_canonical_form
    except ImportError as error:
        raise EnvelopeError(
            "the message is Avro, and the library fastavro is not installed here: pip install 'failover[avro]', or send JSON"
        ) from error
    mark = bytes.fromhex(fingerprint(to_parsing_canonical_form(SCHEMA), "CRC-64-AVRO"))
    return fastavro, fastavro.parse_schema(SCHEMA), mark


def write(fields: Mapping[str, Any]) -> bytes:
    """A message's bytes; ``fields``: all of `SCHEMA`.

    Raises:
        EnvelopeError: a number is beyond 64 bits, or the library is missing.
    """
    fastavro, schema, mark = _library()
    written = _Written()
    written.content += mark
    try:
        fastavro.schemaless_writer(written, schema, fields)
    except _MISREAD as error:
        raise EnvelopeError(f"the message cannot be written as Avro: {error}") from error
    return bytes(written.content)


def read(content: bytes) -> dict[str, Any]:
    """All fields of a message, those in JSON as their text.

    Raises:
        EnvelopeError: these bytes are none, or not in the one form that `write` gives, or the library is missing.
    """
    fastavro, schema, mark = _library()
    begin = len(MARK) + _FINGERPRINT_SIZE
    if content[:begin] != MARK + mark:
        other = content[len(MARK) : begin].hex() if content.startswith(MARK) else "none"
        raise EnvelopeError(f"the message is Avro of another schema (fingerprint {other}, and not {mark.hex()}); send JSON")
    reading = _Read(content[begin:])
    try:
        fields: dict[str, Any] = fastavro.schemaless_reader(reading, schema, None)
    except _MISREAD as error:
        raise EnvelopeError(f"the message cannot be read: {error}") from error
    if reading.left or write(fields) != content:
        raise EnvelopeError("the message has more bytes than its fields: a field is there twice, or something follows")
    return fields
