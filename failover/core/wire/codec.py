"""The bytes of what robots say: sizes of heartbeats and their entries, ranges of their numbers, the replication link's messages.

A heartbeat leaves in a team frame, which authenticates it (`failover.core.frames.frame`). The replication link's messages are
plain msgpack; their transport authenticates them. ``PROTOCOL.md`` says what both mean.
"""

from __future__ import annotations

import functools
from hashlib import blake2b

import msgspec

from checkpoint.errors import UNDECODABLE
from failover.core.types import EPOCH_MAX, GRACE_MS_MAX, PEERS_MAX
from failover.core.wire.messages import RETURNED, Beat, Bulk, Entry, Promise
from failover.core.wire.names import COMPONENT_SIZE_MAX, ROBOT_SIZE_MAX, text_size
from failover.errors import FailoverError

NUMBER_MAX = 1 << 62
DIGEST_SIZE_MAX = 32
"""Beyond these a number is a mistake; believing it would leave no room to count on."""

_encoder = msgspec.msgpack.Encoder()
_bulk_decoder: msgspec.msgpack.Decoder[Bulk] = msgspec.msgpack.Decoder(Bulk)


def encode_bulk(message: Bulk) -> bytes:
    """The message's bytes."""
    return _encoder.encode(message)


def decode_bulk(body: bytes | memoryview) -> Bulk | None:
    """The message, or None for bytes that are none. Never raises."""
    try:
        return _bulk_decoder.decode(body)
    except (*UNDECODABLE, FailoverError):
        return None


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


def is_sound(beat: Beat) -> bool:
    """Whether a beat's numbers lie in the ranges that ``PROTOCOL.md`` gives."""
    return (
        0 < beat.boot < NUMBER_MAX
        and beat.counter < NUMBER_MAX
        and 0 <= beat.settled <= beat.counter > 0
        and beat.total >= 0
        and (not beat.entries or all(is_sound_entry(entry) for entry in beat.entries))
        and RETURNED <= beat.grace_ms <= GRACE_MS_MAX
        and (not beat.promises or all(_sound_promise(promise) for promise in beat.promises))
    )


def _sound_promise(promise: Promise) -> bool:
    is_counted = 0 < promise.boot < NUMBER_MAX and 0 < promise.counter < NUMBER_MAX
    return is_counted and text_size(promise.robot) <= ROBOT_SIZE_MAX and 0 < promise.ms <= GRACE_MS_MAX


def is_sound_entry(entry: Entry) -> bool:
    """The same of what a beat says of a component."""
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
