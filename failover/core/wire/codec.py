"""A heartbeat ⇄ one authenticated datagram. ``PROTOCOL.md`` has the byte table.

An incoming datagram is untrusted until its code is checked, so nothing here raises for it: ``Receiver.open`` returns the
heartbeat, or a ``Refused`` that says why. The replication link's messages are plain msgpack; their transport authenticates them.
"""

from __future__ import annotations

import enum
import functools
import hmac
import struct
from dataclasses import dataclass, field
from hashlib import blake2b

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.types import EPOCH_MAX, PEERS_MAX
from failover.core.wire.messages import VERSION, Beat, Bulk, Entry
from failover.core.wire.names import COMPONENT_SIZE_MAX, ROBOT_SIZE_MAX, text_size
from failover.errors import FailoverError

FRAME_SIZE_MAX = 1_200
"""Bytes: passes every path of the Internet in one piece (RFC 9000, section 14.1)."""

KEY_SIZE_MIN = 16
"""Bytes of a key that is worth checking against."""

WINDOW = 64
"""Counters below the highest one that may still arrive, each once (RFC 4303, section 3.4.3)."""

KEYS_PER_SENDER = 2
"""The present key and the one before it, while a new one is being handed over."""

NUMBER_MAX = 1 << 62
DIGEST_SIZE_MAX = 32
"""Beyond these a number is somebody's mistake; believing it would leave no room to count on."""

MAGIC = b"fB"
"""Of a beat, its first two bytes."""

_HEADER = struct.Struct("<2sBxI8s")
_CODE_SIZE = 16
_BODY = _HEADER.size + _CODE_SIZE
_PERSON = b"failover-beat-1\x00"

BODY_SIZE_MAX = FRAME_SIZE_MAX - _BODY
"""Bytes left for the beat itself."""

_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Beat] = msgspec.msgpack.Decoder(Beat)
_bulk_decoder: msgspec.msgpack.Decoder[Bulk] = msgspec.msgpack.Decoder(Bulk)


class Reason(enum.StrEnum):
    """Why a frame was not believed."""

    NOT_OURS = "not a beat"
    VERSION = "another version"
    TEAM = "another team"
    UNKNOWN_KEY = "unknown key"
    FORGED = "wrong authentication code"
    MALFORMED = "not a well-formed beat"
    SENDER = "key of another sender"
    REPLAYED = "seen before, or too old"
    EARLIER_LIFE = "from an earlier life of its sender"


@dataclass(frozen=True, slots=True)
class Refused:
    """A frame that was not believed.

    Attributes:
        sender: known only where the code was right.
        counter: of a beat that was seen before, or is too old.
    """

    reason: Reason
    sender: str = ""
    counter: int = field(default=0, compare=False)


def seal(beat: Beat, team: str, key: bytes) -> bytes:
    """The datagram for one beat. ``Speaker`` keeps beats small enough; at most ``FRAME_SIZE_MAX`` bytes."""
    header = _HEADER.pack(MAGIC, VERSION, key_number(key), team_tag(team))
    body = _encoder.encode(beat)
    assert len(body) <= BODY_SIZE_MAX, f"a beat of {len(body)} bytes does not fit a frame"
    return header + _code(key, header, body) + body


def encode_bulk(message: Bulk) -> bytes:
    """The message's bytes."""
    return _encoder.encode(message)


def decode_bulk(body: bytes | memoryview) -> Bulk | None:
    """The message, or None for bytes that are none. Never raises."""
    try:
        return _bulk_decoder.decode(body)
    except (*UNDECODABLE, FailoverError):
        return None


@functools.lru_cache(2 * PEERS_MAX)
def key_number(key: bytes) -> int:
    """Which key a frame was sealed with: the receiver finds it without trying all."""
    return int.from_bytes(blake2b(key, digest_size=4, person=b"failover-key-id\x00").digest(), "little")


@functools.cache
def team_tag(team: str) -> bytes:
    """Eight bytes that tell this team's frames from a neighbour's."""
    return blake2b(team.encode(), digest_size=8, person=b"failover-team-1\x00").digest()


def entry_size(entry: Entry) -> int:
    """Bytes of one entry inside a beat."""
    return len(_encoder.encode(entry))


def beat_size(beat: Beat) -> int:
    """Bytes of the beat inside a frame."""
    return len(_encoder.encode(beat))


def _code(key: bytes, header: bytes, body: bytes) -> bytes:
    return blake2b(header + body, digest_size=_CODE_SIZE, key=key[:64], person=_PERSON).digest()


class _Window(Struct):
    """Which beats of one sender were seen: all of earlier lives, all up to ``highest`` that ``seen`` (bit i: highest - i) has."""

    boot: int = 0
    highest: int = 0
    seen: int = 0

    def take(self, boot: int, counter: int) -> Reason | None:
        """Note the beat, or say why it is none of today's."""
        if boot < self.boot:
            return Reason.EARLIER_LIFE
        if boot > self.boot:
            self.boot, self.highest, self.seen = boot, 0, 0
        ahead = counter - self.highest
        if ahead > 0:
            self.seen = ((self.seen << min(ahead, WINDOW)) | 1) & ((1 << WINDOW) - 1)
            self.highest = counter
            return None
        if -ahead >= WINDOW or self.seen >> -ahead & 1:
            return Reason.REPLAYED
        self.seen |= 1 << -ahead
        return None


class Receiver:
    """Opens the frames that reach one robot: right key, right sender, and each only once.

    A sender's boot count can only grow, and only in a frame whose code is right: nobody resets a window from outside.
    """

    def __init__(self, team: str) -> None:
        self._tag = team_tag(team)
        self._keys: dict[int, tuple[str, bytes]] = {}
        self._windows: dict[str, _Window] = {}

    def accept(self, sender: str, key: bytes) -> None:
        """From now on believe ``sender`` when it uses ``key``; its last but one key is forgotten.

        Raises:
            ValueError: the key is too short, or there are more senders than a team has robots.
        """
        if len(key) < KEY_SIZE_MIN:
            raise ValueError(f"a beat key of {len(key)} bytes for {sender}: use at least {KEY_SIZE_MIN} random bytes")
        if sender not in self._windows and len(self._windows) > PEERS_MAX:
            raise ValueError(f"no room for the beats of {sender}: at most {PEERS_MAX} robots share a team")
        number = key_number(key)
        self._keys.pop(number, None)
        self._keys[number] = (sender, key)
        self._windows.setdefault(sender, _Window())
        own = [number for number, (owner, _) in self._keys.items() if owner == sender]
        for old in own[:-KEYS_PER_SENDER]:
            del self._keys[old]

    def open(self, frame: bytes) -> Beat | Refused:
        """The beat inside, or why it is not believed. Never raises for any bytes."""
        if len(frame) > FRAME_SIZE_MAX or len(frame) <= _BODY:
            return Refused(Reason.NOT_OURS)
        magic, version, number, tag = _HEADER.unpack_from(frame)
        if magic != MAGIC:
            return Refused(Reason.NOT_OURS)
        if version != VERSION:
            return Refused(Reason.VERSION)
        if tag != self._tag:
            return Refused(Reason.TEAM)
        sender, key = self._keys.get(number, ("", b""))
        if not sender:
            return Refused(Reason.UNKNOWN_KEY)
        header, code, body = frame[: _HEADER.size], frame[_HEADER.size : _BODY], frame[_BODY:]
        if not hmac.compare_digest(code, _code(key, header, body)):
            return Refused(Reason.FORGED)
        return self._believe(sender, body)

    def _believe(self, sender: str, body: bytes) -> Beat | Refused:
        try:
            beat = _decoder.decode(body)
        except UNDECODABLE:
            return Refused(Reason.MALFORMED, sender)
        if beat.sender != sender:
            return Refused(Reason.SENDER, sender)
        if not _sound(beat):
            return Refused(Reason.MALFORMED, sender)
        refusal = self._windows[sender].take(beat.boot, beat.counter)
        return beat if refusal is None else Refused(refusal, sender, beat.counter)


def _sound(beat: Beat) -> bool:
    """Whether the numbers lie in the ranges that ``PROTOCOL.md`` gives."""
    return (
        0 < beat.boot < NUMBER_MAX
        and beat.counter < NUMBER_MAX
        and 0 <= beat.settled <= beat.counter > 0
        and beat.total >= 0
        and all(_sound_entry(entry) for entry in beat.entries)
    )


def _sound_entry(entry: Entry) -> bool:
    robots = (entry.primary, entry.standby, entry.yields_to)
    return (
        0 < text_size(entry.name) <= COMPONENT_SIZE_MAX
        and all(text_size(robot) <= ROBOT_SIZE_MAX for robot in robots)
        and 0 <= entry.epoch < EPOCH_MAX
        and 0 <= entry.born < EPOCH_MAX
        and 0 <= entry.generation < EPOCH_MAX * (PEERS_MAX + 1)
        and 0 <= entry.sequence < NUMBER_MAX
        and len(entry.digest) <= DIGEST_SIZE_MAX
    )
