"""What agents say to each other on the bulk lane. One message is one or two ZeroMQ frames: the msgpack of a message below, and,
for `Chunk` alone, the raw bytes.

A snapshot travels as a *transfer*: `Offer`, then chunks, never more than the receiver has given credit for, so that a slow disk
or link holds back the sender and nobody's memory fills. Transfer numbers are the sender's own and never reused in one life.
"""

from __future__ import annotations

from typing import Final

import msgspec

VERSION: Final = 1
"""Of this lane. Unequal versions do not talk: the peer's state says so on both robots."""

CHUNK_SIZE: Final = 256 << 10
"""Bytes: at 1 Gbit/s a beat or a vote behind one chunk waits 2 ms (16 MB chunks: 442 ms)."""

CREDIT_CHUNKS: Final = 8
"""Chunks that may be under way unacknowledged: 2 MiB keeps a 1 Gbit/s link with 10 ms of delay busy."""


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """First on every new connection.

    Attributes:
        boot: the sender's boot counter, see `agent.ballot`.
        beat_key: 32 random bytes; the sender's beats to this receiver are authenticated with it from now on.
        links: the sender's beat addresses, as a hint for the status only.
    """

    version: int
    team: str
    robot: str
    boot: int
    beat_key: bytes


class Word(msgspec.Struct, frozen=True, tag="word"):
    """A message of the core that must not be lost while the connection stands."""

    body: bytes


class Offer(msgspec.Struct, frozen=True, tag="offer"):
    """A snapshot of ``size`` bytes comes; wait for credit."""

    transfer: int
    component: str
    epoch: int
    generation: int
    sequence: int
    size: int


class Chunk(msgspec.Struct, frozen=True, tag="chunk"):
    """Bytes ``index * CHUNK_SIZE`` onward; they stand in the second frame."""

    transfer: int
    index: int


class Credit(msgspec.Struct, frozen=True, tag="credit"):
    """Chunks with an index below ``below`` may be sent."""

    transfer: int
    below: int


class Refuse(msgspec.Struct, frozen=True, tag="refuse"):
    """The receiver gives the transfer up and says why; nothing of it is kept."""

    transfer: int
    why: str


class Cancel(msgspec.Struct, frozen=True, tag="cancel"):
    """The sender gives the transfer up: it was superseded, or its component is gone."""

    transfer: int


Message = Hello | Word | Offer | Chunk | Credit | Refuse | Cancel

_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def encode(message: Message) -> bytes:
    """The message's bytes."""
    return _encoder.encode(message)


def decode(body: bytes | memoryview) -> Message | None:
    """The message, or None for bytes that are none; never raises."""
    try:
        return _decoder.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None
