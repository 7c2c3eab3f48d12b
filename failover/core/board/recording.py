"""What a recording of a board says: names of its channels, their JSON Schemas, and each put as a message.

A recording is an MCAP file. Each item of each robot is a channel `/ROBOT/ITEM` of JSON messages. The channel's metadata have the
item's declaration, so that a replay can make it again. All channels of robots that declare an item alike share a schema.

Times are nanoseconds since 1970 by the calendar of the machine that recorded, as it stood when the recording began: a calendar
that is set meanwhile changes nothing. *log time*: the instant at which the recorder read the value. *publish time*: log time
minus the age that the board told then, so the latest instant at which the value can have been produced.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

import msgspec
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from checkpoint.errors import UNDECODABLE
from failover.core.board import layout
from failover.core.board.ages import NO_ERROR_BOUND, NS_PER_US, UNBOUNDED_NS
from failover.core.board.item_types import Opaque, Type, canonical, parse, size_of
from failover.core.board.item_values import Values, values_of
from failover.core.board.items import BANKS_MAX, BANKS_MIN, PERIOD_MAX, check_name, type_digest
from failover.core.board.json_values import of_json, plain, says_all, schema_of
from failover.core.board.layout import Record, Wanted
from failover.core.wire.names import check_robot
from failover.errors import ItemError, NameFormatError, RecordingError, ValueMisfitError

FORMAT: Final = "1"
"""Version of all that stands here; another one is refused."""
FORMAT_KEY: Final = "failover.format"
"""Of a channel's metadata; a channel without it is no item."""

ROBOTS_TOPIC: Final = "failover/robots"
DECISIONS_TOPIC: Final = "failover/decisions"
"""No item is called so: topics of items begin with "/"."""

T = TypeVar("T")


class Robot(Struct, frozen=True):
    """One robot in a message of `ROBOTS_TOPIC`.

    Attributes:
        state: see `failover.core.board.layout.STATES`.
        age_us: since its newest frame; -1: there was none.
    """

    name: str
    state: str
    age_us: int
    rank: int


class Robots(Struct, frozen=True):
    """A message of `ROBOTS_TOPIC`. ``here``: the robot that recorded."""

    here: str
    robots: tuple[Robot, ...]


class Put(Struct, frozen=True):
    """A message: one put of one item.

    Attributes:
        value: as `failover.core.board.json_values` writes it; None where its bytes are no value of the type.
        number: of the put at the board that was recorded.
        age_us: since it was produced, at least; rounded down.
        age_max_us: at most; rounded up. Left out where no bound is known.
        stale: it may be older than the item's bound.
        raw: its bytes in base64, where ``value`` does not say all of them. Else left out.
    """

    value: Any
    number: int
    age_us: int
    stale: bool
    age_max_us: int | UnsetType = UNSET
    raw: str | UnsetType = UNSET

    @property
    def error_us(self) -> int:
        """How much older than ``age_us`` it may be; `NO_ERROR_BOUND`: not known."""
        if self.age_max_us is UNSET:
            return NO_ERROR_BOUND
        return min(max(self.age_max_us - self.age_us, 0), NO_ERROR_BOUND)


encode: Final = msgspec.json.Encoder().encode
_decode: Final = msgspec.json.Decoder().decode
_decode_put: Final = msgspec.json.Decoder(Put).decode
_decode_robots: Final = msgspec.json.Decoder(Robots).decode


# --- Channels --------------------------------------------------------------------------------------------------------


class Channel(Struct, frozen=True):
    """Whose item a channel has, and how it is declared. ``private``: its robot sent it to no other."""

    robot: str
    wanted: Wanted
    private: bool = False

    @property
    def kind(self) -> Type:
        return parse(self.wanted.text)

    @property
    def topic(self) -> str:
        return topic_of(self.robot, self.wanted.name)

    @property
    def declared(self) -> Channel:
        """The same without what an item gets when it is added: equal for an item that is removed and added alike."""
        return replace(self, wanted=replace(self.wanted, id=0, flags=self.wanted.flags & ~layout.ADDED))


def topic_of(robot: str, item: str) -> str:
    """The name of an item's channel."""
    return f"/{robot}/{item}"


def channel_of(robot: str, record: Record, private: bool) -> Channel:
    """The channel of an item; one of bytes where the declaration says no type, or one that does not fit (`misfit_of`)."""
    fields = {name: getattr(record, name) for name in Wanted.__struct_fields__}
    if not record.text or misfit_of(record):
        octets = Opaque("bytes", record.size)
        fields |= {"text": canonical(octets), "kind": layout.BYTES, "digest": type_digest(octets)}
    return Channel(robot, Wanted(**fields), private)


def misfit_of(record: Record) -> str:
    """Why the text of a declaration cannot be the type of the item's values; "": it can, or there is none."""
    if not record.text:
        return ""
    try:
        kind = parse(record.text)
    except ItemError as error:
        return str(error)
    code = layout.KINDS.index(kind.kind) if isinstance(kind, Opaque) else layout.STRUCT
    if code != record.kind:
        return f"{record.text[:80]} is a type of kind {layout.KINDS[code]}, and the table says {layout.KINDS[record.kind]}"
    if size_of(kind) != record.size:
        return f"{record.text[:80]} has {size_of(kind)} bytes, and the table says {record.size}"
    return ""


_NUMBERS: Final = ("id", "banks", "period", "phase", "bound_ns", "flags")


def metadata_of(channel: Channel) -> dict[str, str]:
    """What an MCAP channel says of itself besides its topic: text → text."""
    wanted = channel.wanted
    said = {FORMAT_KEY: FORMAT, "robot": channel.robot, "item": wanted.name, "type": wanted.text}
    said |= {"private": "1"} if channel.private else {}
    return said | {name: str(getattr(wanted, name)) for name in _NUMBERS}


def read_channel(metadata: Mapping[str, str]) -> Channel | None:
    """The channel of such metadata; None: it is no item's.

    Raises:
        RecordingError: it is of another version, or damaged.
    """
    version = metadata.get(FORMAT_KEY)
    if version is None:
        return None
    if version != FORMAT:
        raise RecordingError(
            f"it was recorded in format {version[:20]!r}, and this release reads format {FORMAT}; use the one that recorded it"
        )
    try:
        numbers = {name: _number(metadata, name) for name in _NUMBERS}
        check_name(metadata["item"])
        kind = parse(metadata["type"])
        robot = check_robot(metadata["robot"])
        if numbers["phase"] >= numbers["period"]:
            raise ItemError(f"phase {numbers['phase']} of a period of {numbers['period']} rounds", "phase")
    except (KeyError, ItemError, NameFormatError) as error:
        said = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        raise RecordingError(f"damaged: the declaration of {metadata.get('item', 'an item')[:80]!r}: {said}") from None
    code = layout.KINDS.index(kind.kind) if isinstance(kind, Opaque) else layout.STRUCT
    wanted = Wanted(
        name=metadata["item"], size=size_of(kind), kind=code, digest=type_digest(kind), text=canonical(kind), **numbers
    )
    return Channel(robot, wanted, metadata.get("private") == "1")


_LIMITS: Final = {
    "id": (0, 2**32 - 1),
    "banks": (BANKS_MIN, BANKS_MAX),
    "period": (1, PERIOD_MAX),
    "phase": (0, PERIOD_MAX - 1),
    "bound_ns": (0, UNBOUNDED_NS),
    "flags": (0, 2**32 - 1),
}


def _number(metadata: Mapping[str, str], name: str) -> int:
    text = metadata[name]
    least, most = _LIMITS[name]
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 20 else -1
    if not least <= number <= most:
        raise ItemError(f"{name} {text[:40]!r} is no number from {least} to {most}", name)
    return number


class Schema(Struct, frozen=True):
    """Of messages: its name, and its text in an encoding."""

    name: str
    content: bytes
    encoding: str = "jsonschema"


def schema_name(channel: Channel) -> str:
    """Of an item's schema: two items of one name that are declared otherwise have two."""
    return f"failover.board.{channel.wanted.name}.{channel.wanted.digest & 0xFFFF_FFFF:08x}"


def item_schema(channel: Channel) -> Schema:
    """The schema of an item's messages."""
    whole = {"type": "integer", "minimum": 0}
    value = schema_of(channel.kind)
    properties = ({} if value is None else {"value": value}) | {
        "number": whole | {"description": "of the put"},
        "age_us": whole | {"description": "since it was produced, at least"},
        "age_max_us": whole | {"description": "at most; left out where no bound is known"},
        "stale": {"type": "boolean", "description": "it may be older than its bound"},
        "raw": {"type": "string", "contentEncoding": "base64", "description": "the value's bytes, where JSON does not say all"},
    }
    required = ["value", "number", "age_us", "stale"]
    name = schema_name(channel)
    return Schema(name, encode({"title": name, "type": "object", "properties": properties, "required": required}))


def _schema(content: dict[str, Any]) -> Schema:
    return Schema(content["title"], encode(content))


ROBOTS_SCHEMA: Final = _schema(
    {
        "title": "failover.Robots",
        "type": "object",
        "properties": {
            "here": {"type": "string"},
            "robots": {
                "type": "array",
                "items": {
                    "type": "object",
                    "properties": {
                        "name": {"type": "string"},
                        "state": {"type": "string", "enum": list(layout.STATES)},
                        "age_us": {"type": "integer", "description": "since its newest frame; -1: there was none"},
                        "rank": {"type": "integer"},
                    },
                },
            },
        },
    }
)

LOG_SCHEMA: Final = _schema(
    {
        "title": "foxglove.Log",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {
                    "sec": {"type": "integer", "minimum": 0},
                    "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
                },
            },
            "level": {"type": "integer", "description": "1 debug, 2 info, 3 warning, 4 error, 5 fatal"},
            "message": {"type": "string"},
            "name": {"type": "string", "description": "the robot that decided, and the component"},
            "file": {"type": "string"},
            "line": {"type": "integer", "minimum": 0},
        },
    }
)
"""Foxglove's own schema of a line of a log. Source: foxglove-sdk, schemas/jsonschema/Log.json."""

INFO, WARNING = 2, 3
NS_PER_S: Final = 1_000_000_000


def log_of(line: Mapping[str, Any], at_ns: int) -> dict[str, Any]:
    """A line of the answer to ``why`` as a message of `LOG_SCHEMA`: one that begins another epoch is a warning."""
    component = line.get("component") or ""
    return {
        "timestamp": {"sec": at_ns // NS_PER_S, "nsec": at_ns % NS_PER_S},
        "level": INFO if line.get("epoch_before") == line.get("epoch") else WARNING,
        "message": str(line.get("did") or ""),
        "name": f"{line.get('robot')} {component}".strip(),
        "file": "",
        "line": 0,
    }


# --- Messages --------------------------------------------------------------------------------------------------------


class Coder:
    """Values of one item: bytes of the board ⇄ a message."""

    def __init__(self, channel: Channel) -> None:
        self._place = channel.topic
        self._kind = channel.kind
        self._values: Values = values_of(self._kind)
        self._is_plain = says_all(self._kind)

    def put_of(self, octets: bytes, number: int, age_ns: int, age_max_ns: int, stale: bool) -> Put:
        """The message of a put. Whatever bytes a writer put, the message holds them all."""
        value: msgspec.Raw | None = None
        try:
            there = self._values.unpack(octets)
            told = plain(there)
            value = msgspec.Raw(encode(told))
            if self._is_plain:
                is_all = told == there and self._values.pack(there) == octets
            else:
                is_all = self._values.pack(of_json(self._kind, _decode(value), self._place)) == octets
        except (ValueMisfitError, TypeError, UnicodeError, RecursionError, struct.error):  # what msgpack can say and JSON cannot
            is_all = False
        return Put(
            value,
            number,
            age_ns // NS_PER_US,
            stale,
            UNSET if age_max_ns == UNBOUNDED_NS else -(-age_max_ns // NS_PER_US),
            UNSET if is_all else binascii.b2a_base64(octets, newline=False).decode(),
        )

    def octets_of(self, put: Put) -> bytes:
        """The value's bytes.

        Raises:
            RecordingError: it is no value of the type.
        """
        try:
            if put.raw is UNSET:
                octets = self._values.pack(of_json(self._kind, put.value, self._place))
            else:
                octets = binascii.a2b_base64(put.raw, strict_mode=True)
        except (ValueMisfitError, ValueError, RecursionError) as error:  # `raw` that is no base64, or no ASCII
            raise RecordingError(f"damaged: put {put.number} of {self._place}: {error}") from None
        most = size_of(self._kind)
        least = 0 if isinstance(self._kind, Opaque) else most
        if not least <= len(octets) <= most:
            raise RecordingError(f"damaged: put {put.number} of {self._place} has {len(octets)} bytes, not {least} to {most}")
        return octets


def read_put(content: bytes, topic: str) -> Put:
    """A message of an item's channel.

    Raises:
        RecordingError: it is none.
    """
    return _read(_decode_put, content, topic[:80])


def read_robots(content: bytes) -> Robots:
    """A message of `ROBOTS_TOPIC`.

    Raises:
        RecordingError: it is none.
    """
    return _read(_decode_robots, content, ROBOTS_TOPIC)


def _read(decode: Callable[[bytes], T], content: bytes, topic: str) -> T:
    try:
        return decode(content)
    except UNDECODABLE as error:
        raise RecordingError(f"damaged: a message of {topic}: {error}") from None
