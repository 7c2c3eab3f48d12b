"""Messages: fields in any order, unknown ones kept and passed on, and one sentence for what is none."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

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
@given(known, unknown, st.randoms(), st.sampled_from(["json", "msgpack"]), st.sampled_from(["json", "msgpack"]))
def test_fields_come_in_any_order_and_unknown_ones_are_passed_on(
    fields: dict[str, Any], rest: dict[str, Any], rolled: random.Random, first: Encoding, then: Encoding
) -> None:
    order = list({**rest, **fields}.items())
    rolled.shuffle(order)
    content = json.dumps(dict(order)).encode() if first == "json" else msgspec.msgpack.encode(dict(order))
    read = decode(content)
    assert read.rest == rest
    assert read == decode(json.dumps({**fields, **rest}).encode())
    passed = left(came(read, "robot1/ns", 1), 2)
    again = decode(encode(passed, then))
    assert again == passed
    assert (again.rest, again.hops) == (rest, (Hop("robot1/ns", 1, 2),))
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
        (b"\xc3\x01", "Avro"),
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


def test_the_document_names_every_field_and_limit() -> None:
    for name in module._KNOWN:
        assert f"| `{name}` |" in DOCUMENT
    for limit in (MESSAGE_SIZE_MAX, ELEMENTS_MAX, DEPTH_MAX, HOPS_MAX, TEXT_MAX):
        assert f" {limit:,} " in DOCUMENT
