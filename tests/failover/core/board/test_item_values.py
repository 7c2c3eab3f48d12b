"""Values of items as bytes: classes, dictionaries, numpy, contents without a layout; and what does not fit."""

from __future__ import annotations

import dataclasses
import math
import struct
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.core.board.item_types import NUMBERS, Array, Number, Record, Text, Type, canonical, parse, size_of
from failover.core.board.item_values import type_of, values_of
from failover.errors import ItemError, ValueMisfitError
from tests.failover.core.board.test_item_types import STRUCTS


@dataclasses.dataclass
class Pose:
    x: float
    y: Annotated[float, "f4"]


class Robot(msgspec.Struct):
    pose: Pose
    name: Annotated[str, "char[8]"]
    ok: bool
    v: tuple[float, float, float]
    raw: Annotated[bytes, "u1[4]"]
    seen: np.uint16
    near: Annotated[list[Pose], "{x:f8,y:f4}[2]"]
    limit: ClassVar[int] = 3


@dataclasses.dataclass(kw_only=True)
class Named:
    y: float
    x: float


class Pair(NamedTuple):
    a: int
    b: bool


ROBOT = Robot(Pose(1.5, -2.5), "häl", True, (1.0, 2.0, 3.0), b"\0\1\2\xff", 65535, [Pose(1.0, 2.0), Pose(3.0, 4.0)])  # type: ignore[arg-type]


def test_a_class_says_its_type_by_its_annotations() -> None:
    kind = type_of(Robot)
    assert canonical(kind) == "{pose:{x:f8,y:f4},name:char[8],ok:bool,v:f8[3],raw:u1[4],seen:u2,near:{x:f8,y:f4}[2]}"
    assert canonical(type_of(Pair)) == "{a:i8,b:bool}"


@pytest.mark.parametrize("value", [ROBOT, Named(x=1.0, y=2.0), Pair(-(1 << 63), False), Pose(0.5, 0.25)])
def test_an_object_comes_back_as_it_was(value: Any) -> None:
    kind = type_of(type(value))
    values = values_of(kind, type(value))
    octets = values.pack(value)
    assert len(octets) == size_of(kind)
    assert values.unpack(octets) == value
    assert values.unpack(memoryview(octets)) == value


def test_the_same_bytes_are_a_dictionary_where_no_class_is_given() -> None:
    octets = values_of(type_of(Robot), Robot).pack(ROBOT)
    plain = values_of(type_of(Robot))
    found = plain.unpack(octets)
    assert found["pose"] == {"x": 1.5, "y": -2.5}
    assert found["near"][1] == {"x": 3.0, "y": 4.0}
    assert plain.pack(found) == octets


def values_for(kind: Type) -> st.SearchStrategy[Any]:
    """Values of a type, as plain ones."""
    if isinstance(kind, Number):
        if kind.code == "bool":
            return st.booleans()
        if kind.code[0] == "f":
            return st.floats(width=32 if kind.code == "f4" else 64, allow_nan=False)
        bits = 8 * int(kind.code[1])
        return st.integers(0, (1 << bits) - 1) if kind.code[0] == "u" else st.integers(-(1 << bits - 1), (1 << bits - 1) - 1)
    if isinstance(kind, Text):
        letters = st.characters(exclude_characters="\0", exclude_categories=["Cs"])
        return st.text(letters, max_size=kind.size).filter(lambda text: len(text.encode()) <= kind.size)
    if isinstance(kind, Array):
        if kind.of == Number("u1"):
            return st.binary(min_size=kind.count, max_size=kind.count)
        return st.lists(values_for(kind.of), min_size=kind.count, max_size=kind.count)
    assert isinstance(kind, Record)
    return st.fixed_dictionaries({name: values_for(field) for name, field in kind.fields})


@settings(max_examples=40)
@given(st.data())
def test_any_value_of_any_type_comes_back(drawn: st.DataObject) -> None:
    kind = drawn.draw(STRUCTS)
    value = drawn.draw(values_for(kind))
    values = values_of(kind)
    octets = values.pack(value)
    assert len(octets) == size_of(kind)
    assert values.unpack(octets) == value
    assert values.pack(values.unpack(octets)) == octets


@given(st.data())
def test_bytes_of_anyone_are_read_as_some_value(drawn: st.DataObject) -> None:
    kind = drawn.draw(STRUCTS)
    values_of(kind).unpack(drawn.draw(st.binary(min_size=size_of(kind), max_size=size_of(kind))))


def test_padding_is_zero_also_where_numpy_leaves_it() -> None:
    dtype = np.dtype([("a", "u1"), ("b", "f8"), ("c", [("d", "u1"), ("e", "u2")], (2,))], align=True)
    kind = type_of(dtype)
    assert canonical(kind) == "{a:u1,b:f8,c:{d:u1,e:u2}[2]}"
    dirty = np.frombuffer(b"\xff" * dtype.itemsize, dtype)[0]
    packed = values_of(kind, dtype).pack(dirty)
    assert packed == values_of(kind).pack(values_of(kind).unpack(b"\xff" * dtype.itemsize))
    assert packed.count(0) == 7 + 2 * 1 + 0 + (dtype.itemsize - 24)
    assert values_of(kind, dtype).unpack(packed)["b"].tobytes() == b"\xff" * 8


def test_a_numpy_array_is_an_item() -> None:
    dtype = np.dtype(("f4", (2, 3)))
    kind = type_of(dtype)
    assert canonical(kind) == "f4[2][3]"
    values = values_of(kind, dtype)
    array = np.arange(6, dtype="f4").reshape(2, 3)
    assert (values.unpack(values.pack(array)) == array).all()
    with pytest.raises(ValueMisfitError, match=r"the shape \(3, 2\), not \(2, 3\)"):
        values.pack(array.T)


def test_a_dtype_that_is_not_laid_out_as_c_does_is_refused() -> None:
    with pytest.raises(ItemError, match="align=True"):
        type_of(np.dtype([("a", "u1"), ("b", "f8")]))
    with pytest.raises(ItemError, match="is no type of an item"):
        type_of(np.dtype(">f4"))


@pytest.mark.parametrize(
    ("text", "value", "said"),
    [
        ("{x:f4,y:f4}", {"x": 1.0}, "without a field y"),
        ("{x:f4,y:f4}", {"x": 1.0, "z": 2.0}, "'z' is no field of it; its fields are x, y"),
        ("{x:f4,y:f4}", {"x": 1.0, "y": 2.0, "z": 2.0}, "'z' is no field"),
        ("{x:f4,y:f4}", [1.0, 2.0], "no table of the fields x, y"),
        ("{x:f4,y:f4}", {"x": "a", "y": 1}, "field x: 'a' is no f4"),
        ("{x:f4}", {"x": 1e300}, "field x: 1e+300 is no f4"),
        ("{x:i1}", {"x": 128}, "field x: 128 is no i1"),
        ("{x:i1}", {"x": 1.5}, "field x: 1.5 is no i1"),
        ("{p:{x:u8}}", {"p": {"x": -1}}, "field p.x: -1 is no u8"),
        ("{x:bool}", {"x": "no"}, "field x: 'no' is neither true nor false"),
        ("{n:char[4]}", {"n": "häll"}, "field n: 'häll' is 5 bytes long, of at most 4"),
        ("{n:char[4]}", {"n": "a\0b"}, "a text with a zero in it"),
        ("{n:char[4]}", {"n": 4}, "field n: 4 is no text"),
        ("{v:f4[3]}", {"v": [1, 2]}, "field v: [1, 2] is 2 values, not 3"),
        ("{v:f4[3]}", {"v": [1, 2, None]}, "field v[2]: None is no f4"),
        ("{v:f4[3]}", {"v": "abc"}, "field v: 'abc' is no list of 3"),
        ("{v:{a:f4}[2]}", {"v": [{"a": 1}, {"a": "b"}]}, "field v[1].a: 'b' is no f4"),
        ("{v:u1[3]}", {"v": [1, 2, 300]}, "not 3 bytes"),
        ("f4", None, "None is no f4"),
        ("bytes[4]", b"12345", "a value of 5 bytes; the item holds 4"),
        ("bytes[4]", "1234", "give bytes"),
        ("msgpack[4]", list(range(9)), "a value of 10 bytes; the item holds 4"),
        ("json[64]", object(), "cannot be said in json"),
    ],
)
def test_a_value_that_does_not_fit_is_named_with_its_field(text: str, value: Any, said: str) -> None:
    with pytest.raises(ValueMisfitError) as caught:
        values_of(parse(text)).pack(value)
    assert said in str(caught.value)


@given(st.recursive(st.one_of(st.none(), st.integers(), st.floats(), st.text(max_size=4), st.binary(max_size=4)), st.lists))
def test_any_object_is_packed_or_refused_in_a_sentence(value: Any) -> None:
    for text in ("{x:f4,b:bool}", "{v:f4[3]}", "{n:char[4],r:u1[2]}", "f8", "msgpack[64]", "json[64]", "bytes[3]"):
        for said in (value, {"x": value, "b": value}, {"v": value}, {"n": value, "r": value}):
            try:
                octets = values_of(parse(text)).pack(said)
            except ValueMisfitError as error:
                sentence = str(error)
                assert sentence != ""
            else:
                values_of(parse(text)).unpack(octets)


def test_numbers_that_are_not_finite_are_refused_where_the_item_says_so() -> None:
    kind = parse("{x:f4,v:f8[2]}")
    values_of(kind).pack({"x": math.nan, "v": [0, math.inf]})
    for value in ({"x": math.nan, "v": [0, 0]}, {"x": 0, "v": [0, -math.inf]}):
        with pytest.raises(ValueMisfitError, match="is refused: the item is declared with finite = true"):
            values_of(kind, finite=True).pack(value)
    dtype = np.dtype([("x", "f4"), ("y", "f4")])
    with pytest.raises(ValueMisfitError, match="not finite"):
        values_of(type_of(dtype), dtype, finite=True).pack((1.0, math.nan))


def test_a_class_of_another_type_is_refused_with_both_types() -> None:
    with pytest.raises(ItemError, match=r"declared as \{x:f4,y:f4\}, and Pose means \{x:f8,y:f4\}"):
        values_of(parse("{x:f4,y:f4}"), Pose)


class Loose(NamedTuple):
    a: str


@pytest.mark.parametrize("cls", [Loose, str, list, object, dict[str, float], tuple[float, int]])
def test_a_class_that_says_no_size_is_told_what_to_write(cls: Any) -> None:
    with pytest.raises(ItemError, match="says no size; write float, int, bool"):
        type_of(cls)


def test_contents_without_a_layout_are_checked_against_the_programs_class() -> None:
    values = values_of(parse("msgpack[64]"), Pose)
    assert values.unpack(values.pack(Pose(1.0, 2.0))) == Pose(1.0, 2.0)
    with pytest.raises(ValueMisfitError, match="are no msgpack that was expected"):
        values.unpack(b"\xc1")


def test_numbers_have_the_letters_of_struct() -> None:
    assert {code: struct.calcsize("<" + letter) for code, letter in NUMBERS.items()} == {
        code: size_of(Number(code)) for code in NUMBERS
    }
