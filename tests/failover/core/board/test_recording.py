"""Messages and channels of a recording: whatever bytes a program put come back; whatever a file says is read or refused."""

from __future__ import annotations

import json
import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.board import recording
from failover.core.board.ages import NO_ERROR_BOUND, UNBOUNDED_NS
from failover.core.board.item_types import parse, size_of
from failover.core.board.item_values import values_of
from failover.core.board.items import Item
from failover.core.board.layout import wanted_of
from failover.core.board.recording import Channel, Coder
from failover.errors import RecordingError

TYPES = ("f4", "{x:f4,y:f8,n:u4}", "{on:bool,mark:u1[3],name:char[5]}", "i8[3]", "bytes[40]", "msgpack[40]", "json[40]")


def channel(text: str, robot: str = "robot2", name: str = "ball") -> Channel:
    kind = parse(text)
    size = size_of(kind) if text.startswith(("bytes", "msgpack", "json")) else 0
    return Channel(robot, wanted_of(Item(name, kind, size=size, bound_ms=120, period=3, phase=1), 5))


@given(text=st.sampled_from(TYPES), content=st.binary(max_size=40))
def test_any_bytes_come_back(text: str, content: bytes) -> None:
    there = channel(text)
    if not text.endswith("[40]"):
        size = size_of(there.kind)
        content = content[:size] + bytes(max(size - len(content), 0))
    coder = Coder(there)
    message = recording.encode(coder.put_of(content, 7, 1_999, 5_001, False))
    assert coder.octets_of(recording.read_put(json.dumps(json.loads(message)).encode(), there.topic)) == content


def test_bytes_stand_beside_the_value_only_where_json_does_not_say_them() -> None:
    coder = Coder(channel("{x:f4,n:u4}"))
    pack = values_of(parse("{x:f4,n:u4}")).pack
    plain = coder.put_of(pack({"x": 1.5, "n": 3}), 1, 0, 0, False)
    assert json.loads(recording.encode(plain)) == {
        "value": {"x": 1.5, "n": 3}, "number": 1, "age_us": 0, "stale": False, "age_max_us": 0
    }  # fmt: skip
    odd = json.loads(recording.encode(coder.put_of(pack({"x": math.nan, "n": 3}), 1, 0, 0, False)))
    assert odd["value"] == {"x": None, "n": 3} and odd["raw"]


def test_ages_stay_bounds_when_they_are_rounded() -> None:
    put = Coder(channel("f4")).put_of(bytes(4), 1, 1_999, 2_001, True)
    assert (put.age_us, put.age_max_us, put.error_us, put.stale) == (1, 3, 2, True)
    unknown = Coder(channel("f4")).put_of(bytes(4), 1, 1_999, UNBOUNDED_NS, False)
    assert b"age_max_us" not in recording.encode(unknown)
    assert recording.read_put(recording.encode(unknown), "x").error_us == NO_ERROR_BOUND


@pytest.mark.parametrize("text", TYPES)
def test_a_channel_comes_back_from_its_metadata(text: str) -> None:
    there = channel(text)
    assert recording.read_channel(recording.metadata_of(there)) == there
    private = Channel("r", there.wanted, True)
    assert recording.read_channel(recording.metadata_of(private)) == private
    schema = json.loads(recording.item_schema(there).content)
    assert schema["title"] == recording.schema_name(there) and schema["type"] == "object"
    assert ("value" in schema["properties"]) == (not text.startswith(("msgpack", "json")))


def test_a_channel_of_something_else_is_none() -> None:
    assert recording.read_channel({"topic": "x"}) is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({recording.FORMAT_KEY: "2"}, "format '2', and this release reads format 1"),
        ({"type": "f5"}, "no type"),
        ({"type": ""}, "no type"),
        ({"item": "a/b"}, "cannot name an item"),
        ({"robot": ""}, "cannot name a robot"),
        ({"banks": "99"}, "banks '99' is no number from 2 to 8"),
        ({"period": "-1"}, "period '-1'"),
        ({"phase": "3"}, "phase 3 of a period of 3"),
        ({"bound_ns": "9" * 30}, "bound_ns"),
    ],
)
def test_a_declaration_that_cannot_be_is_refused(change: dict[str, str], said: str) -> None:
    with pytest.raises(RecordingError, match=said):
        recording.read_channel(recording.metadata_of(channel("f4")) | change)


def test_a_missing_word_of_a_declaration_is_named() -> None:
    metadata = recording.metadata_of(channel("f4"))
    del metadata["banks"]
    with pytest.raises(RecordingError, match="there is no 'banks'"):
        recording.read_channel(metadata)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"value":1}',
        b'{"value":1,"number":"x","age_us":1,"stale":false}',
        b"[" * 100_000,
        b"\xff\xfe",
        b'{"value":"\xff","number":1,"age_us":1,"stale":false,"raw":"\xff"}',
    ],
)
def test_a_message_that_is_none_is_refused(content: bytes) -> None:
    with pytest.raises(RecordingError, match="damaged: a message of /r/i"):
        recording.read_put(content, "/r/i")


@pytest.mark.parametrize(
    "said",
    [
        {"value": "x"},
        {"value": 1e999},
        {"value": None},
        {"value": 1.0, "raw": "??"},
        {"value": 1.0, "raw": "AAAA"},
        {"value": 1.0, "raw": "é"},
    ],
)
def test_a_value_of_another_type_is_refused(said: dict[str, object]) -> None:
    put = msgspec.convert({"number": 3, "age_us": 1, "stale": False} | said, recording.Put)
    with pytest.raises(RecordingError, match="put 3 of /robot2/ball"):
        Coder(channel("{x:f4}")).octets_of(put)


def test_a_decision_that_begins_an_epoch_is_a_warning() -> None:
    line = {"robot": "r2", "component": "/lab/r1/mapper", "did": "takes over", "epoch_before": 1, "epoch": 2}
    log = recording.log_of(line, 1_795_732_554_214_410_712)
    assert log["level"] == recording.WARNING and log["name"] == "r2 /lab/r1/mapper" and log["message"] == "takes over"
    assert log["timestamp"] == {"sec": 1_795_732_554, "nsec": 214_410_712}
    assert recording.log_of(line | {"epoch": 1}, 0)["level"] == recording.INFO
