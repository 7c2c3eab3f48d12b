"""The vote record as bytes, for the agent to make durable."""

from __future__ import annotations

import msgspec

from checkpoint.errors import UNDECODABLE
from failover.core.types import VoteRecord
from failover.errors import RulesError

_encoder = msgspec.json.Encoder()
_decoder: msgspec.json.Decoder[VoteRecord] = msgspec.json.Decoder(VoteRecord)


def encode(vote_record: VoteRecord) -> bytes:
    """JSON, so that a person in trouble can read it."""
    return _encoder.encode(vote_record)


def decode(body: bytes) -> VoteRecord:
    """The vote record that ``encode`` wrote; b"" is that of a robot that never voted.

    Raises:
        RulesError: anything else.
    """
    if not body:
        return VoteRecord()
    try:
        return _decoder.decode(body)
    except UNDECODABLE as error:
        raise RulesError(
            f"cannot read the vote record: {error}; restore it, or start this robot as new with an empty state"
        ) from error
