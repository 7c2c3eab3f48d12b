"""A message ⇄ bytes: JSON, msgpack or Avro, told apart by the first byte; ``ENVELOPE.md`` is normative.

Fields may come in any order. Fields that this version does not know are kept and passed on. A message by hand needs three:
``{"to": "engine", "verb": "set", "body": {"duty": 1}}``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final, Literal

import msgspec
from msgspec import UNSET, Struct, UnsetType

from failover.errors import EnvelopeError

MESSAGE_SIZE_MAX: Final = 1 << 20
"""Bytes of a message: an image of a camera; what is larger travels as a file."""

DEPTH_MAX: Final = 32
"""Tables and lists within each other."""

ELEMENTS_MAX: Final = 1 << 16
"""Values of one message: it is decoded within milliseconds."""

INTEGER_MAX: Final = 1 << 53
STAMP_MAX: Final = (1 << 63) - 1
"""Larger integers are not the same in every language; who needs them writes them as text. Source: RFC 8259, section 6."""

TEXT_MAX: Final = 512
"""Characters of ``to``, ``verb``, ``id``, ``from``, ``by``, ``re`` and of a name in ``hops``: tables keep thousands of them."""

VERSION_SIZE_MAX: Final = 16
SPEAKS: Final = "@"
"""Between a verb and the version of the receiver's verbs that the caller speaks: in no verb of a driver."""

FEW: Final = 64
"""Numbers of a body that is small whatever they are."""

HOPS_MAX: Final = 16
"""Processes that pass on a message; more is a circle of names."""

Encoding = Literal["json", "msgpack", "avro"]


class Hop(Struct, frozen=True, array_like=True, gc=False):
    """One process that passed the message on: when it came and when it left, in ns of that process's own clock.

    A stamp above `INTEGER_MAX`, a machine that runs for 104 days, is written as text.
    """

    who: str
    came: int | str
    left: int | str | None = None

    @property
    def came_ns(self) -> int:
        """When it came."""
        return int(self.came)

    @property
    def left_ns(self) -> int | None:
        """When it left; None: it has not."""
        return None if self.left is None else int(self.left)


class Fault(Struct, frozen=True, gc=False):
    """Why a message was not carried out. ``kind``: one word for programs; ``sentence``: for people."""

    kind: str
    sentence: str = ""


class Envelope(Struct, frozen=True, omit_defaults=True, gc=False, rename={"sender": "from", "rest": "\x7frest"}):
    """A message, or the answer to one.

    Attributes:
        to: a name of any kind; of an answer: the asking message's sender.
        verb: what to do; body: with what.
        id: by which the answer names it. re: whose answer it is.
        sender: ``from`` on the wire. by: the person for whom it is done.
        boot, seq: the sender's life and the message's number in it, see `failover.core.messaging.mailbox`.
        after: the number of the message that must be handled before. reliable: it is sent until it is answered.
        had: the sender has all answers up to this number, and will not ask for them again.
        deadline_ms: how long from now on it is worth being handled.
        epoch: the highest one of the receiver that the sender has heard of; of an answer: the receiver's own. 0: it has none.
        hops: who passed it on.
        ok, error: of an answer: the result or why there is none.
        rest: fields that this version does not know.
    """

    to: str = ""
    verb: str = ""
    body: Any = UNSET
    id: str = ""
    sender: str = ""
    by: str = ""
    boot: int = 0
    seq: int = 0
    after: int = 0
    had: int = 0
    reliable: bool = False
    deadline_ms: float | None = None
    epoch: int = 0
    hops: tuple[Hop, ...] = ()
    re: str = ""
    ok: Any | UnsetType = UNSET
    error: Fault | UnsetType = UNSET
    rest: Mapping[str, Any] = {}


_REST: Final = "\x7frest"
_KNOWN: Final = frozenset(field.encode_name for field in msgspec.structs.fields(Envelope)) - {_REST}
_from_json = msgspec.json.Decoder(Envelope).decode
_to_json = msgspec.json.Encoder().encode
_to_msgpack = msgspec.msgpack.Encoder().encode
_JSON_BLANKS: Final = b" \t\r\n"
_AVRO: Final = b"\xc3"


def encode(envelope: Envelope, encoding: Encoding = "json") -> bytes:
    """The message's bytes; unknown fields go with it, and never replace a known one."""
    if encoding == "json" and not envelope.rest:
        return _to_json(envelope)
    fields = msgspec.to_builtins(envelope)
    rest = fields.pop(_REST, None) or {}
    if encoding == "avro":
        return _to_avro(fields, rest)
    fields = {**rest, **fields}
    return _to_json(fields) if encoding == "json" else _to_msgpack(fields)


def encoding_of(content: bytes) -> Encoding:
    """How a message was written that `decode` has read."""
    first = content[:1]
    return "avro" if first == _AVRO else "json" if first == b"{" or first in _JSON_BLANKS else "msgpack"


def decode(content: bytes) -> Envelope:
    """The message of these bytes.

    Raises:
        EnvelopeError: they are none; says why.
    """
    if len(content) > MESSAGE_SIZE_MAX:
        raise EnvelopeError(
            f"the message has {len(content)} bytes, {MESSAGE_SIZE_MAX} are the most; send the name of a file instead"
        )
    content = content.lstrip(_JSON_BLANKS)
    return _own(content) or _any(content)


def _own(content: bytes) -> Envelope | None:
    """The message, if these are exactly the bytes that `encode` writes in JSON: then no field is unknown or there twice."""
    try:
        envelope = _from_json(content)
        if envelope.rest or _to_json(envelope) != content:
            return None
    except (msgspec.MsgspecError, UnicodeError, ValueError, RecursionError):
        return None  # why, the other way says
    if envelope.body is not UNSET and not _is_flat(envelope.body):
        check([envelope.body])
    if envelope.ok is not UNSET and not _is_flat(envelope.ok):
        check([envelope.ok])
    check_head(envelope)
    return envelope


def _any(content: bytes) -> Envelope:
    """The message, by hand or from another program."""
    fields = _fields(content)
    check(fields)
    unknown = fields.keys() - _KNOWN
    for key in unknown:
        if not key.isprintable():
            raise EnvelopeError(f"the message has a field {key!r}: names of fields are visible characters")
    try:
        envelope = msgspec.convert(fields, Envelope)
    except msgspec.ValidationError as error:
        raise EnvelopeError(f"the message has a field of another kind than documented: {error}") from error
    check_head(envelope)
    if not unknown:
        return envelope
    return msgspec.structs.replace(envelope, rest={key: value for key, value in fields.items() if key in unknown})


def _fields(content: bytes) -> dict[str, Any]:
    """All fields, each once."""
    first = content[:1]
    try:
        if first == b"{":
            fields = _json(content)
        elif first and (0x80 <= first[0] <= 0x8F or first[0] in (0xDE, 0xDF)):
            fields = msgspec.msgpack.decode(content)
            if _to_msgpack(fields) != content:
                _count_once(content, fields)
        elif first == _AVRO:
            fields = _from_avro(content)
        else:
            raise EnvelopeError(f"the message begins with {first!r}: it is neither a JSON object nor a msgpack map")
    except (msgspec.DecodeError, UnicodeError, ValueError) as error:
        raise EnvelopeError(f"the message cannot be read: {error}") from error
    except RecursionError as error:
        raise EnvelopeError(f"the message is nested deeper than {DEPTH_MAX}") from error
    return fields  # type: ignore[no-any-return]


def _json(content: bytes) -> Any:
    """A value, in which no field is there twice."""
    value = msgspec.json.decode(content)
    if _to_json(value) != content:  # not written by an encoder like ours
        json.loads(content, object_pairs_hook=_once)
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for place, name in enumerate(names) if name in names[:place])
        raise EnvelopeError(f"the message has the field {twice!r} twice")
    return fields


def _count_once(content: bytes, fields: object) -> None:
    """Of msgpack: as many keys as maps announce."""
    if _announced(content) != sum(len(one) for one in _containers(fields) if isinstance(one, dict)):
        raise EnvelopeError("the message has a field twice")


def _to_avro(fields: dict[str, Any], rest: Mapping[str, Any]) -> bytes:
    from failover.core.messaging import avro

    said = {"deadline_ms": None, "error": None} | fields
    for name in ("to", "verb", "id", "from", "by", "re"):
        said.setdefault(name, "")
    for name in ("boot", "seq", "after", "had", "epoch"):
        said.setdefault(name, 0)
    for name in ("body", "ok"):
        said[name] = _to_json(fields[name]).decode() if name in fields else None
    if said["error"] is not None:
        said["error"] = {"sentence": "", **said["error"]}
    said["reliable"] = said.get("reliable", False)
    said["hops"] = [
        {"who": who, "came": int(came), "left": None if left is None else int(left)} for who, came, left in fields.get("hops", ())
    ]
    said["rest"] = {name: _to_json(one).decode() for name, one in rest.items()}
    return avro.write(said)


def _from_avro(content: bytes) -> dict[str, Any]:
    from failover.core.messaging import avro

    fields = avro.read(content)
    for name in ("body", "ok", "error"):
        if fields[name] is None:
            del fields[name]
    for name in ("body", "ok"):
        if name in fields:
            fields[name] = _json(fields[name].encode())
    fields["hops"] = [
        [hop["who"], _stamp(hop["came"]), None if hop["left"] is None else _stamp(hop["left"])] for hop in fields["hops"]
    ]
    rest = {name: _json(one.encode()) for name, one in fields.pop("rest").items()}
    if twice := rest.keys() & _KNOWN:
        raise EnvelopeError(f"the message has the field {min(twice)!r} twice")
    return rest | fields


_SIZES: Final = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}
"""First byte of a number → bytes that follow. Source: the msgpack specification."""

_LENGTHS: Final = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
"""First byte of bytes and texts → bytes of their length."""


def _announced(content: bytes) -> int:
    """The keys that all maps of a valid msgpack message announce together, those that come twice counted twice."""
    at = announced = 0
    while at < len(content):
        first = content[at]
        at += 1
        if 0x80 <= first <= 0x8F:
            announced += first & 0x0F
        elif 0xA0 <= first <= 0xBF:
            at += first & 0x1F
        elif first in (0xDE, 0xDF):
            width = 2 if first == 0xDE else 4
            announced += int.from_bytes(content[at : at + width])
            at += width
        elif first in (0xDC, 0xDD):
            at += 2 if first == 0xDC else 4
        elif first in _LENGTHS:
            width = _LENGTHS[first]
            at += width + int.from_bytes(content[at : at + width])
        elif 0xC7 <= first <= 0xC9 or 0xD4 <= first <= 0xD8:
            raise EnvelopeError("the message holds a msgpack extension; times and such travel as text")
        else:
            at += _SIZES.get(first, 0)
    return announced


def _containers(value: object) -> list[Any]:
    """All tables and lists, outermost first."""
    found: list[Any] = []
    level: list[object] = [value]
    while level:
        inner: list[object] = []
        for one in level:
            if isinstance(one, dict):
                found.append(one)
                inner.extend(one.values())
            elif isinstance(one, list):
                found.append(one)
                inner.extend(one)
        level = inner
    return found


def _is_flat(value: object) -> bool:
    """Whether `check` would find nothing in it, by a short look: most bodies are a few numbers."""
    if type(value) is not dict:
        return value is None or value is True or value is False
    for key, one in value.items():
        kind = type(one)
        if kind is float:
            if one - one != 0:  # neither finite
                return False
        elif kind is int:
            if not -INTEGER_MAX <= one <= INTEGER_MAX:
                return False
        elif kind is not bool and one is not None:
            return False
        if type(key) is not str or not key.isascii():
            return False
    return len(value) < ELEMENTS_MAX


def check(fields: object) -> None:
    """Refuse what is too deep, too much, or not the same number in every language.

    Raises:
        EnvelopeError: says which.
    """
    if _is_flat(fields):
        return
    level: list[object] = [fields]
    count = 0
    for _ in range(DEPTH_MAX + 1):
        inner: list[object] = []
        for one in level:
            if isinstance(one, str):
                if not one.isascii():
                    _check_text(one)
            elif isinstance(one, int):
                if not -INTEGER_MAX <= one <= INTEGER_MAX:
                    raise EnvelopeError(f"the message holds the integer {one}: above 2^53 it must be written as text")
            elif isinstance(one, float):
                if not math.isfinite(one):
                    raise EnvelopeError("the message holds a number that is not finite")
            elif isinstance(one, dict):
                for key in one:
                    if not isinstance(key, str):
                        raise EnvelopeError("the message has a field whose name is no text")
                    if not key.isascii():
                        _check_text(key)
                inner.extend(one.values())
            elif isinstance(one, list):
                inner.extend(one)
            elif one is not None:
                raise EnvelopeError(f"the message holds {type(one).__name__}, which JSON does not have; write it as text")
        count += len(inner)
        if count > ELEMENTS_MAX:
            raise EnvelopeError(f"the message holds more than {ELEMENTS_MAX} values")
        if not inner:
            return
        level = inner
    raise EnvelopeError(f"the message is nested deeper than {DEPTH_MAX}")


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise EnvelopeError("the message holds half of a character (a lone surrogate)") from error


def check_head(envelope: Envelope) -> None:
    """Raises EnvelopeError: a name, number or hop of it is none that a message may have."""
    names = envelope.to + envelope.verb + envelope.id + envelope.sender + envelope.by + envelope.re
    if not names.isascii():
        _check_text(names)
    if len(names) > TEXT_MAX:  # seldom: then each by itself
        for text in (envelope.to, envelope.verb, envelope.id, envelope.sender, envelope.by, envelope.re):
            if len(text) > TEXT_MAX:
                raise EnvelopeError(f"the message has the name {text[:40]!r}… of {len(text)} characters; {TEXT_MAX} are the most")
    if not 0 <= envelope.boot | envelope.seq | envelope.after | envelope.had | envelope.epoch < INTEGER_MAX:
        for number in (envelope.boot, envelope.seq, envelope.after, envelope.had, envelope.epoch):
            if number < 0:
                raise EnvelopeError("the message has a negative boot, seq, after, had or epoch")
            if number > INTEGER_MAX:
                raise EnvelopeError(f"the message holds the integer {number}: above 2^53 it must be written as text")
    if envelope.deadline_ms is not None and not -INTEGER_MAX <= envelope.deadline_ms <= INTEGER_MAX:
        raise EnvelopeError(f"the message has the deadline_ms {envelope.deadline_ms}: 2^53 ms are the most; none: leave it out")
    check_hops(envelope.hops)


def check_hops(hops: tuple[Hop, ...]) -> None:
    """Raises EnvelopeError: no message was passed on like this."""
    if len(hops) > HOPS_MAX:
        raise EnvelopeError(f"the message was passed on {len(hops)} times, {HOPS_MAX} are the most: names lead in a circle")
    for hop in hops:
        if len(hop.who) > TEXT_MAX:
            raise EnvelopeError(f"the message has a hop whose name has {len(hop.who)} characters; {TEXT_MAX} are the most")
        for stamp in (hop.came, hop.left):
            if isinstance(stamp, int):
                if not -INTEGER_MAX <= stamp <= INTEGER_MAX:
                    raise EnvelopeError(f"the message holds the integer {stamp}: above 2^53 it must be written as text")
            elif isinstance(stamp, str) and not (
                stamp.isascii() and stamp.isdigit() and len(stamp) < 20 and int(stamp) <= STAMP_MAX
            ):
                raise EnvelopeError(f"the message has the stamp {stamp[:40]!r}: write nanoseconds, from 2^53 on as text")


def is_version(said: object) -> bool:
    """Whether it names a version of verbs, as it stands behind `SPEAKS`."""
    return isinstance(said, str) and len(said) <= VERSION_SIZE_MAX and said.isascii() and said.replace(".", "").isalnum()


# --- Answers and hops -------------------------------------------------------------------------------------------------


def check_size(envelope: Envelope, room: int, encoding: Encoding = "json") -> None:
    """Refuse what every receiver refuses unread, before it is sent again and again.

    Args:
        room: bytes that the message still needs, for what its sender writes into it.
        encoding: in which it leaves; in JSON, too, where its receiver cannot read that.

    Raises:
        EnvelopeError: it is too large, or a name in it is.
    """
    check_head(envelope)
    if _is_small(envelope):
        return
    if (size := max(len(encode(envelope, one)) for one in {"json", encoding}) + room) > MESSAGE_SIZE_MAX:
        raise EnvelopeError(f"the message has {size} bytes, {MESSAGE_SIZE_MAX} are the most; send the name of a file instead")


def _is_small(envelope: Envelope) -> bool:
    """Whether it has a few numbers for a body: then it has some kilobytes at most, in any encoding."""
    body = envelope.body
    if envelope.ok is not UNSET or envelope.rest:
        return False
    return body is UNSET or (type(body) is dict and len(body) <= FEW and sum(map(len, body)) <= TEXT_MAX and _is_flat(body))


def encode_answer(said: Envelope, encoding: Encoding = "json") -> bytes:
    """An answer's bytes, in JSON where the encoding cannot hold it.

    Where these are more than a message has: those of a refusal of the kind ``bad_result``.
    """
    try:
        content = encode(said, encoding)
    except EnvelopeError:  # a number that Avro has no room for
        encoding, content = "json", encode(said)
    if len(content) <= MESSAGE_SIZE_MAX:
        return content
    why = f"its answer has {len(content)} bytes, and a message has {MESSAGE_SIZE_MAX} at most: have it return the name of a file"
    fault = Fault("bad_result", f"it was carried out, and {why}")
    return encode(msgspec.structs.replace(said, ok=UNSET, error=fault, rest={}), encoding)


def answer(asked: Envelope, ok: Any) -> Envelope:
    """That a message was carried out, with its result."""
    return Envelope(to=asked.sender, re=asked.id, boot=asked.boot, seq=asked.seq, ok=ok)


def refusal(asked: Envelope, kind: str, sentence: str) -> Envelope:
    """That it was not, and why."""
    return Envelope(to=asked.sender, re=asked.id, boot=asked.boot, seq=asked.seq, error=Fault(kind, sentence))


def came(envelope: Envelope, who: str, now_ns: int) -> Envelope:
    """The message with a hop of this process.

    Raises:
        EnvelopeError: so many have passed it on that it goes in a circle.
    """
    if len(envelope.hops) >= HOPS_MAX:
        raise EnvelopeError(f"the message to {envelope.to!r} was passed on {HOPS_MAX} times: names lead in a circle")
    return msgspec.structs.replace(envelope, hops=(*envelope.hops, Hop(who, _stamp(now_ns))))


def left(envelope: Envelope, now_ns: int) -> Envelope:
    """The message as it leaves: the last hop gets its second stamp."""
    return msgspec.structs.replace(envelope, hops=left_hops(envelope, now_ns))


def left_hops(envelope: Envelope, now_ns: int) -> tuple[Hop, ...]:
    """The hops of a message that leaves."""
    *before, last = envelope.hops
    return (*before, Hop(last.who, last.came, _stamp(now_ns)))


def _stamp(now_ns: int) -> int | str:
    return now_ns if now_ns <= INTEGER_MAX else str(now_ns)
