"""Values of items as JSON: said in full, read back, described by a schema."""

from __future__ import annotations

import math

import pytest

from failover.core.board.item_types import parse
from failover.core.board.json_values import of_json, plain, schema_of
from failover.errors import ValueMisfitError


def test_a_value_is_told_as_json_can_say_it() -> None:
    value = {"a": b"\0\xff", "b": (1.0, math.nan, math.inf), "c": [{"d": bytearray(b"x")}], 4: None}
    assert plain(value) == {"a": "00ff", "b": [1.0, None, None], "c": [{"d": "78"}], "4": None}


def test_hexadecimal_text_is_bytes_where_bytes_belong() -> None:
    kind = parse("{mark:u1[2],inner:{b:u1[1]}[2],text:char[4]}")
    value = {"mark": "00ff", "inner": [{"b": "01"}, {"b": "02"}], "text": "00"}
    assert of_json(kind, value, "x") == {"mark": b"\0\xff", "inner": [{"b": b"\1"}, {"b": b"\2"}], "text": "00"}
    with pytest.raises(ValueMisfitError, match=r"x\.inner\[1\]\.b: bytes are written in hexadecimal"):
        of_json(kind, value | {"inner": [{"b": "01"}, {"b": "zz"}]}, "x")


def test_a_schema_says_names_and_limits() -> None:
    schema = schema_of(parse("{x:f4,n:u1,v:i2[3],on:bool,name:char[8],mark:u1[6]}"))
    assert schema is not None
    assert schema["required"] == ["x", "n", "v", "on", "name", "mark"]
    assert schema["properties"] == {
        "x": {"type": "number"},
        "n": {"type": "integer", "minimum": 0, "maximum": 255},
        "v": {"type": "array", "items": {"type": "integer", "minimum": -32768, "maximum": 32767}, "minItems": 3, "maxItems": 3},
        "on": {"type": "boolean"},
        "name": {"type": "string"},
        "mark": {"type": "string", "description": "hexadecimal"},
    }


def test_a_schema_leaves_out_what_programs_that_look_on_refuse() -> None:
    assert schema_of(parse("msgpack[9]")) is schema_of(parse("f4[2][3]")) is schema_of(parse("{v:f4[2][2]}[3][2]")) is None
    inner = schema_of(parse("{grid:f4[2][3],x:f4}[4]"))
    assert inner is not None
    assert inner["items"] == {"type": "object", "properties": {"x": {"type": "number"}}, "required": ["grid", "x"]}
    assert schema_of(parse("{grid:f4[2][3]}")) == {"type": "object", "properties": {}, "required": ["grid"]}
