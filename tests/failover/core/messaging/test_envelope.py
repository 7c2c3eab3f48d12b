"""Messages: fields in any order, unknown ones kept and passed on, and one sentence for what is none."""

from __future__ import annotations

import importlib.util
import json
import random
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import UNSET

from failover.core.messaging import envelope as module
from failover.core.messaging.envelope import (
    DEPTH_MAX,
    ELEMENTS_MAX,
    HOPS_MAX,
    MESSAGE_SIZE_MAX,
    TEXT_MAX,
    Encoding,
    Envelope,
    Hop,
    answer,
    came,
    decode,
    encode,
    left,
    refusal,
)
from failover.errors import EnvelopeError

HAS_AVRO = importlib.util.find_spec("fastavro") is not None
ENCODINGS: list[Encoding] = ["json", "msgpack", *(("avro",) if HAS_AVRO else ())]  # type: ignore[list-item]
needs_avro = pytest.mark.skipif(not HAS_AVRO, reason="needs fastavro: the extra avro")

DOCUMENT = (Path(module.__file__).parent / "ENVELOPE.md").read_text()

text = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
field = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf", "Zs", "Zl", "Zp", "Co", "Cn"]), min_size=1, max_size=8)
value = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 53), 1 << 53) | st.floats(allow_nan=False, allow_infinity=False) | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=8,
)
known = st.fixed_dictionaries(
    {"to": text, "verb": text},
    optional={
        "body": value,
        "id": text,
        "from": text,
        "by": text,
        "seq": st.integers(0, 1 << 53),
        "reliable": st.booleans(),
        "ok": value,
    },
)
unknown = st.dictionaries(field.filter(lambda name: name not in module._KNOWN), value, max_size=3)


@settings(max_examples=150, deadline=None)
@given(known, unknown, st.randoms(), st.sampled_from(ENCODINGS), st.sampled_from(ENCODINGS))
def test_fields_come_in_any_order_and_unknown_ones_are_passed_on(
    fields: dict[str, Any], rest: dict[str, Any], rolled: random.Random, first: Encoding, then: Encoding
) -> None:
    order = list({**rest, **fields}.items())
    rolled.shuffle(order)
    content = json.dumps(dict(order)).encode() if first == "json" else msgspec.msgpack.encode(dict(order))
    if first == "avro":
        content = encode(decode(content), "avro")  # its schema has the order
    assert module.encoding_of(content) == first
    read = decode(content)
    assert read.rest == rest
    assert read == decode(json.dumps({**fields, **rest}).encode())
    passed = left(came(read, "robot1/ns", 1), 2)
    again = decode(encode(passed, then))
    assert again == passed
    assert (again.rest, again.hops) == (rest, (Hop("robot1/ns", 1, 2),))
    if then == "avro":
        return
    written = msgspec.json.decode(encode(read)) if then == "json" else msgspec.msgpack.decode(encode(read, then))
    assert {name: one for name, one in written.items() if name in fields}.items() <= fields.items() or written == {
        **fields,
        **rest,
    }


@settings(max_examples=150, deadline=None)
@given(
    st.binary(max_size=60)
    | st.builds(lambda one: b"{" + one, st.binary(max_size=40))
    | st.builds(lambda one: b"\x83" + one, st.binary(max_size=40))
)
def test_no_bytes_raise_anything_but_a_sentence(content: bytes) -> None:
    sentence = "the message"
    try:
        decode(content)
    except EnvelopeError as error:
        sentence = str(error)
    assert sentence.startswith("the message")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "neither a JSON object nor a msgpack map"),
        (b"[1]", "neither a JSON object"),
        (b"\xc3\x01", "Avro of another schema" if HAS_AVRO else r"pip install 'failover\[avro\]'"),
        (b'{"to":"a"', "cannot be read"),
        (b'{"to":"a","to":"b"}', "'to' twice"),
        (b'{"to":"a","body":{"x":1,"x":1}}', "'x' twice"),
        (b"\x82\xa2to\xa1a\xa2to\xa1b", "a field twice"),
        (b"\x81\xa4body\x82\xa1x\x01\xa1x\xca\x00\x00\x00\x00", "a field twice"),
        (b'{"body":1e999}', "the message"),
        (b'{"body":NaN}', "cannot be read"),
        (b"\x81\xa4body\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00", "not finite"),
        (b'{"body":9007199254740993}', "above 2^53"),
        (b'{"to":5}', "another kind than documented"),
        (b'{"seq":-1}', "negative"),
        (b'{"deadline_ms":"soon"}', "another kind"),
        (b'{"deadline_ms":1e308}', "2^53 ms are the most"),
        (b'{"verb":"set","deadline_ms":-1e308}', "2^53 ms are the most"),
        (b'{"to":"\xff"}', "cannot be read"),
        (b'{"a\\nb":1}', "visible characters"),
        (b'{"\\u0000rest":{"to":"x"}}', "visible characters"),
        (b'{"\\u007frest":{"to":"x"}}', "visible characters"),
        (b'{"hops":[["a","x",null]]}', "the stamp"),
        (b'{"hops":[["a","9223372036854775808",null]]}', "the stamp"),
        (b'{"from":"' + b"-1" * 257 + b'"}', "of 514 characters; 512 are the most"),
        (b'{"verb":"set","id":"' + b"x" * 513 + b'"}', "of 513 characters"),
        (b'{"hops":[["' + b"x" * 513 + b'",1,2]]}', "a hop whose name has 513 characters"),
        (b"\x81\x01\x02", "no text"),
        (b"\x81\xa4body\xc4\x01x", "the message"),
        (b"\x81\xa4body\xd6\xff\x00\x00\x00\x00", "the message"),
        (b'{"body":' + b"[" * (DEPTH_MAX + 1) + b"]" * (DEPTH_MAX + 1) + b"}", f"deeper than {DEPTH_MAX}"),
        (b'{"body":' + b"[" * 200_000 + b"]" * 200_000 + b"}", f"deeper than {DEPTH_MAX}"),
        (b'{"body":[' + b"1," * ELEMENTS_MAX + b"1]}", f"more than {ELEMENTS_MAX}"),
        (b'{"body":"' + b"x" * MESSAGE_SIZE_MAX + b'"}', "are the most"),
    ],
    ids=lambda one: one[:24] if isinstance(one, str) else repr(one[:24]),
)
def test_what_is_no_message_gets_a_sentence(content: bytes, why: str) -> None:
    with pytest.raises(EnvelopeError, match=why.replace("^", r"\^")):
        decode(content)


def test_three_lines_by_hand_are_a_message() -> None:
    read = decode(b'\n{"verb": "set",\n "body": {"duty": 0.4},\n "to": "engine"}\n')
    assert (read.to, read.verb, read.body, read.rest) == ("engine", "set", {"duty": 0.4}, {})


def test_float32_and_wide_numbers_of_other_encoders_are_read() -> None:
    assert decode(b"\x82\xa4body\xca\x3f\x00\x00\x00\xa3seq\xcd\x00\x05").body == 0.5


def test_stamps_of_a_machine_that_runs_for_long_stay_exact() -> None:
    long_ns = (1 << 53) + 1
    read = decode(encode(left(came(Envelope("a"), "r", long_ns), long_ns + 2)))
    assert (read.hops[0].came_ns, read.hops[0].left_ns) == (long_ns, long_ns + 2)
    assert read.hops[0].came == str(long_ns)


def test_a_circle_of_names_ends() -> None:
    one = Envelope("a")
    for number in range(HOPS_MAX):
        one = left(came(one, "r", number), number)
    with pytest.raises(EnvelopeError, match="in a circle"):
        came(one, "r", 99)


def test_an_answer_names_what_it_answers_and_none_is_an_answer_too() -> None:
    asked = Envelope("engine", "read", id="x", sender="robot1/mission", boot=3, seq=4)
    assert decode(encode(answer(asked, None))).ok is None
    assert decode(encode(Envelope("a"))).ok is UNSET
    refused = decode(encode(refusal(asked, "busy", "retry")))
    assert (refused.to, refused.re, refused.boot, refused.seq, refused.error) == (
        "robot1/mission",
        "x",
        3,
        4,
        module.Fault("busy", "retry"),
    )


# --- Avro -------------------------------------------------------------------------------------------------------------

CANONICAL = (
    '{"name":"failover.Envelope","type":"record","fields":[FIELDS]}',
    '{"name":"failover.Hop","type":"record","fields":[{"name":"who","type":"string"},{"name":"came","type":"long"},'
    '{"name":"left","type":["null","long"]}]}',
    '{"name":"failover.Fault","type":"record","fields":[{"name":"kind","type":"string"},{"name":"sentence","type":"string"}]}',
)


def canonical() -> bytes:
    """The schema in the form whose fingerprint counts, written here once more."""
    whole, hop, fault = CANONICAL
    texts = '["null","string"]'
    kinds = {
        **dict.fromkeys(("to", "verb", "id", "from", "by", "re"), '"string"'),
        **dict.fromkeys(("boot", "seq", "after", "had", "epoch"), '"long"'),
        "body": texts,
        "ok": texts,
        "reliable": '"boolean"',
        "deadline_ms": '["null","double"]',
        "hops": f'{{"type":"array","items":{hop}}}',
        "error": f'["null",{fault}]',
        "rest": '{"type":"map","values":"string"}',
    }
    first = ["to", "verb", "body", "id", "from", "by", "boot", "seq", "after", "had", "reliable", "deadline_ms", "epoch"]
    order = [*first, "hops", "re", "ok", "error", "rest"]
    return whole.replace("FIELDS", ",".join(f'{{"name":"{name}","type":{kinds[name]}}}' for name in order)).encode()


def crc_64_avro(content: bytes) -> bytes:
    """As the specification defines it, a bit at a time."""
    empty = value = 0xC15D213AA4D7A795
    for byte in content:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (empty if value & 1 else 0)
    return value.to_bytes(8, "little")


@needs_avro
def test_an_avro_message_begins_with_the_fingerprint_of_the_schema() -> None:
    assert encode(Envelope("a"), "avro")[:10] == b"\xc3\x01" + crc_64_avro(canonical())


@needs_avro
@pytest.mark.parametrize(
    "asked",
    [
        Envelope("a", "b", None, rest={"note": [1, {"x": None}]}, deadline_ms=0.5),
        Envelope("a", ok=None, re="x", boot=1 << 53, hops=(Hop("r", str((1 << 53) + 1), None), Hop("s", 3, 4))),
        Envelope(error=module.Fault("busy")),
        Envelope(body="ä" * 70_000),
    ],
    ids=["rest", "stamps", "error", "text"],
)
def test_what_is_absent_null_and_large_stays_so_in_avro(asked: Envelope) -> None:
    assert decode(encode(asked, "avro")) == asked
    assert decode(encode(asked, "avro")).body is asked.body or asked.body


def bad_avro() -> list[tuple[bytes, str]]:
    """Bytes that begin as Avro, and why they are no message."""
    if not HAS_AVRO:
        return []
    from failover.core.messaging import avro

    begin = encode(Envelope(), "avro")[:10]
    empty = avro.read(encode(Envelope(), "avro"))
    whole = encode(Envelope("a", rest={"x": 1}), "avro")
    twice = whole[:-6] + b"\x04" + b"\x02x\x021" * 2 + b"\x00"
    return [
        (begin, "cannot be read"),
        (whole[:-1], "cannot be read"),
        (whole + b"\x00", "more bytes than its fields"),
        (begin + b"\xff\xff\xff\xff\xff\xff\xff\xff\x7f", "cannot be read"),
        (begin + b"\x01" * 40, "cannot be read"),
        (begin[:4] + b"\x00" + begin[5:], "another schema"),
        (twice, "twice"),
        (avro.write({**empty, "rest": {"to": '"x"'}}), "'to' twice"),
        (avro.write({**empty, "rest": {"\x7frest": "{}"}}), "visible characters"),
        (avro.write({**empty, "body": '{"x":1,"x":1}'}), "'x' twice"),
        (avro.write({**empty, "body": "nonsense"}), "cannot be read"),
        (avro.write({**empty, "body": "[" * 100_000 + "]" * 100_000}), f"deeper than {DEPTH_MAX}"),
        (avro.write({**empty, "body": "9007199254740993"}), "above 2\\^53"),
        (avro.write({**empty, "seq": -1}), "negative"),
        (avro.write({**empty, "deadline_ms": float("inf")}), "not finite"),
        (avro.write({**empty, "hops": [{"who": "", "came": 1, "left": None}] * 20_000}), "too many fields"),
    ]


@needs_avro
@pytest.mark.parametrize(("content", "why"), bad_avro(), ids=lambda one: one if isinstance(one, str) else repr(one[10:24]))
def test_what_is_no_message_in_avro_gets_a_sentence(content: bytes, why: str) -> None:
    with pytest.raises(EnvelopeError, match=why):
        decode(content)


@needs_avro
@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=80), st.randoms())
def test_no_avro_raises_anything_but_a_sentence(content: bytes, rolled: random.Random) -> None:
    whole = bytearray(encode(Envelope("a", "b", {"x": 1}, rest={"y": 2}, hops=(Hop("r", 1, 2),), deadline_ms=2.0), "avro"))
    for byte in content[:4]:
        whole[rolled.randrange(10, len(whole))] = byte
    for odd in (bytes(whole[:10]) + content, bytes(whole)):
        sentence = "the message"
        try:
            decode(odd)
        except EnvelopeError as error:
            sentence = str(error)
        assert sentence.startswith("the message")


@needs_avro
def test_an_answer_that_avro_has_no_room_for_leaves_as_json() -> None:
    said = Envelope("a", re="1", ok=None, hops=(Hop("r", str(1 << 63), None),))
    assert decode_fields(module.encode_answer(said, "avro"))["hops"] == [["r", str(1 << 63), None]]


def decode_fields(content: bytes) -> dict[str, Any]:
    found = json.loads(content)
    assert isinstance(found, dict)
    return found


def test_a_message_is_measured_in_each_encoding_in_which_it_may_leave() -> None:
    asked = Envelope("a", body={"floats": [0.5] * 65_000, "text": "x" * 500_000})
    module.check_size(asked, 0)
    with pytest.raises(EnvelopeError, match="are the most"):
        module.check_size(asked, 0, "msgpack")


def test_a_body_that_is_small_without_a_look_at_its_bytes_is() -> None:
    names = [f"{number:0{TEXT_MAX // module.FEW}d}"[: TEXT_MAX // module.FEW].replace("0", "\0") for number in range(module.FEW)]
    asked = Envelope("a", body=dict.fromkeys(names, -1.2345678901234567e-300))
    assert module._is_small(asked) and not module._is_small(Envelope("a", body={"x": ["y"]}))
    encodings = [one for one in get_args(module.Encoding) if one != "avro" or importlib.util.find_spec("fastavro") is not None]
    assert max(len(encode(asked, one)) for one in encodings) < 8 << 10


# --- The document ---------------------------------------------------------------------------------------------------------


def samples(kind: str) -> list[str]:
    return [part.partition("```")[0].strip() for part in DOCUMENT.split(f"```{kind}\n")[1:]]


def test_each_sample_of_the_document_is_read_and_written_as_it_says() -> None:
    messages = samples("json")
    assert len(messages) == 3
    for message in messages:
        read = decode(message.encode())
        assert decode(encode(read)) == decode(encode(read, "msgpack")) == read
        assert json.loads(encode(read)) == json.loads(message)
    (sample,) = samples("hex")
    assert encode(decode(messages[0].encode()), "msgpack") == bytes.fromhex(sample)


@needs_avro
def test_the_avro_of_the_document_is_what_is_written() -> None:
    from failover.core.messaging import avro

    assert [json.loads(one) for one in samples("avsc")] == [avro.SCHEMA]
    (sample,) = samples("avro")
    content = encode(decode(samples("json")[0].encode()), "avro")
    assert content == bytes.fromhex(sample) and f", {len(content)} bytes" in DOCUMENT


def test_the_document_names_every_field_and_limit() -> None:
    for name in module._KNOWN:
        assert f"| `{name}` |" in DOCUMENT
    for limit in (MESSAGE_SIZE_MAX, ELEMENTS_MAX, DEPTH_MAX, HOPS_MAX, TEXT_MAX):
        assert f" {limit:,} " in DOCUMENT
