"""What a table says of one name: who answers to it, where, and to which verbs."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.naming import names
from failover.core.naming.names import Kind
from failover.core.naming.tables import BODY_SIZE_MAX
from failover.errors import NameFormatError

ALIASES_MAX: Final = 8
ADDRESSES_MAX: Final = 8
"""One thing has a few of each."""

RecordKind = Literal["driver", "component", "robot", "program", "simulated"]


class Record(Struct, frozen=True, omit_defaults=True):
    """What stands behind a path.

    Attributes:
        path: in normal form, see `failover.core.naming.names`.
        addresses: where it takes messages: ``tcp://IP:port``, ``local://PATH``; the nearest first.
        aliases: free texts by which it may be called, too.
        verbs: name → what it takes and returns, as a JSON schema; {} for not said.
        versions: of its program, the active one first.
        owner: the user who may give orders about it.
        epoch: of the primary, for what moves between robots: the highest one wins a conflict.
        lease_s: how long it is believed at its origin without a sign of life; 0: as long as its process lives.
        labels: whatever its owner wants to be known.
    """

    path: str
    kind: RecordKind = "driver"
    addresses: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()
    verbs: Mapping[str, Any] = {}
    versions: tuple[str, ...] = ()
    owner: str = ""
    epoch: int = 0
    lease_s: float = 0
    labels: Mapping[str, str] = {}


_encode = msgspec.msgpack.Encoder().encode
_decoder = msgspec.msgpack.Decoder(Record)


def checked(record: Record) -> Record:
    """The record with path and aliases in normal form.

    Raises:
        NameFormatError: it cannot be registered; says why.
    """
    if len(record.aliases) > ALIASES_MAX or len(record.addresses) > ADDRESSES_MAX:
        raise NameFormatError(
            f"{record.path!r} cannot be registered: at most {ALIASES_MAX} aliases and {ADDRESSES_MAX} addresses"
        )
    aliases = tuple(dict.fromkeys(map(names.alias, record.aliases)))
    record = msgspec.structs.replace(record, path=names.path(record.path), aliases=aliases)
    if len(pack(record)) > BODY_SIZE_MAX:
        raise NameFormatError(
            f"{record.path!r} cannot be registered: its record takes more than {BODY_SIZE_MAX} bytes; shorten schemas and labels"
        )
    return record


def pack(record: Record) -> bytes:
    """A record as the body of an entry."""
    return _encode(record)


@functools.lru_cache(maxsize=8_192)
def unpack(body: bytes) -> Record | None:
    """The record of an entry's body; keys of later versions are left out of it, not of the table. None: it is no record."""
    try:
        return checked(_decoder.decode(body))
    except (*UNDECODABLE, NameFormatError):
        return None


def numeric(address: str) -> str:
    """An address of a record as names of that kind are compared; "" if it has no IP and port."""
    try:
        name = names.parse(address)
    except NameFormatError:
        return ""
    return name.text if name.kind is Kind.ADDRESS else ""
