"""Any declared type with any value: the restored value is the same."""

from __future__ import annotations

import datetime as dt
import pathlib
import uuid
from collections import deque
from dataclasses import field, make_dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from failover.state import Schema
from tests.failover.state.models import Cell, Faults, Mode, Pose
from tests.failover.state.sameness import carried, same

Case = tuple[Any, st.SearchStrategy[Any], bool]
"""A declaration, its values, and whether they can be keys."""

FLOATS = st.floats(allow_nan=True)
TEXTS = st.text(st.characters(codec=None), max_size=8)
ZONES = st.sampled_from([None, dt.UTC, dt.timezone(dt.timedelta(minutes=-90)), dt.timezone(dt.timedelta(hours=1), "CET")])

ATOMS: list[Case] = [
    (type(None), st.none(), True),
    (bool, st.booleans(), True),
    (int, st.integers() | st.integers(1 << 60, 1 << 68), True),
    (float, FLOATS | st.integers(-5, 5), False),
    (complex, st.complex_numbers(), False),
    (str, TEXTS, True),
    (bytes, st.binary(max_size=20) | st.binary(min_size=4095, max_size=4097), True),
    (bytearray, st.builds(bytearray, st.binary(max_size=20)), False),
    (Decimal, st.decimals(), False),
    (Fraction, st.fractions(), True),
    (uuid.UUID, st.uuids(), True),
    (dt.datetime, st.datetimes(timezones=ZONES, allow_imaginary=True) | st.datetimes(), True),
    (dt.date, st.dates(), True),
    (dt.time, st.times(timezones=ZONES), True),
    (dt.timedelta, st.timedeltas(), True),
    (pathlib.Path, st.builds(pathlib.Path, st.text("abc/.\udcffü", max_size=9)), True),
    (Mode, st.sampled_from(Mode), True),
    (Faults, st.sampled_from([Faults(0), Faults.HEAT, Faults.HEAT | Faults.LINK]), True),
    (Cell, st.builds(Cell, st.integers(-9, 9), st.integers()), True),
    (Pose, st.builds(Pose, FLOATS, FLOATS, st.integers(0, 3)), False),
]


DTYPES = ["<f8", ">f4", "<i2", "|u1", "|b1", "<c8", "<M8[ms]", "<U3", "|S4", "|V3", "<i4,>f8", "(2,2)<f8"]


@st.composite
def arrays(draw: st.DrawFn) -> np.ndarray[Any, Any]:
    """Any kept dtype, with random bytes in it."""
    dtype = np.dtype(
        draw(st.sampled_from(["<f8", ">f4", "<i2", "|u1", "|b1", "<c8", "<M8[ms]", "<U3", "|S4", "|V3", "<i4,>f8", "(2,2)<f8"]))
    )
    shape = draw(st.lists(st.integers(0, 5), max_size=3).map(tuple) | st.just((700,)))
    made = np.zeros(shape, dtype)
    if made.dtype.kind not in "bU" and made.nbytes:
        flat = made.reshape(-1).view(np.uint8)
        flat[:] = np.frombuffer(draw(st.binary(min_size=16, max_size=16)) * (flat.size // 16 + 1), np.uint8)[: flat.size]
    return draw(st.sampled_from([made, np.asfortranarray(made)]))


ATOMS.append((np.ndarray, arrays(), False))


def lists_of(case: Case) -> st.SearchStrategy[Case]:
    declared, values, _ = case
    return st.sampled_from(
        [
            (list[declared], st.lists(values, max_size=4), False),  # type: ignore[valid-type]
            (deque[declared], st.lists(values, max_size=4).map(lambda found: deque(found, 9)), False),  # type: ignore[valid-type]
            (tuple[declared, ...], st.lists(values, max_size=4).map(tuple), case[2]),  # type: ignore[valid-type]
            (declared | None, st.none() | values, case[2]),
        ]
    )


def keyed_by(pair: tuple[Case, Case]) -> st.SearchStrategy[Case]:
    (key, keys, is_key), (declared, values, is_inner_key) = pair
    if not is_key:
        return st.just((tuple[key, declared], st.tuples(keys, values), is_inner_key and is_key))  # type: ignore[valid-type]
    return st.sampled_from(
        [
            (dict[key, declared], st.dictionaries(keys, values, max_size=4), False),  # type: ignore[valid-type]
            (set[key], st.sets(keys, max_size=4), False),  # type: ignore[valid-type]
            (frozenset[key], st.frozensets(keys, max_size=4), True),  # type: ignore[valid-type]
        ]
    )


def either(pair: tuple[Case, Case]) -> Case:
    (left, lefts, is_left), (right, rights, is_right) = pair
    return (left | right, lefts | rights, is_left and is_right)


def record_of(members: list[Case]) -> Case:
    """A new dataclass with these fields."""
    fields = [(f"field_{index}", case[0], field()) for index, case in enumerate(members)]
    cls = make_dataclass("Made", fields, slots=len(members) % 2 == 0)
    return (cls, st.builds(cls, *(case[1] for case in members)), False)


CASES: st.SearchStrategy[Case] = st.recursive(
    st.sampled_from(ATOMS),
    lambda inner: (
        inner.flatmap(lists_of)
        | st.tuples(inner, inner).flatmap(keyed_by)
        | st.lists(inner, min_size=1, max_size=3).map(record_of)
    ),
    max_leaves=6,
)


def equal_records(left: Any, right: Any) -> bool:
    """Made classes are equal field by field, everything else as ``same`` says."""
    if type(left) is type(right) and type(left).__name__ == "Made":
        return all(equal_records(getattr(left, name), getattr(right, name)) for name in type(left).__dataclass_fields__)
    if type(left) is type(right) and isinstance(left, list | tuple | deque):
        return len(left) == len(right) and all(map(equal_records, left, right))
    if type(left) is type(right) and isinstance(left, dict):
        return list(left) == list(right) and all(equal_records(left[key], right[key]) for key in left)
    return same(left, right)


@settings(max_examples=250, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_every_value_of_every_type_comes_back_as_it_was(data: st.DataObject) -> None:
    declared, values, _ = data.draw(CASES)
    value = data.draw(values)
    schema = Schema.of(declared, name="kept")
    encoded = carried(schema.encode(value))
    decoded = schema.decode(encoded)
    assert equal_records(decoded.value, value)
    assert decoded.notes == ()
    assert carried(schema.encode(decoded.value)).data == encoded.data or "set" in schema.description


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_migration_that_changes_nothing_changes_nothing(data: st.DataObject) -> None:
    declared, values, _ = data.draw(CASES)
    value = data.draw(values)
    encoded = carried(Schema.of(declared, name="kept").encode(value))
    migrating = Schema.of(declared, name="kept", version=2, migrations={1: lambda state: state})
    assert equal_records(migrating.decode(encoded).value, value)


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | FLOATS
    | TEXTS
    | st.binary(max_size=9)
    | st.datetimes()
    | st.decimals()
    | arrays(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(TEXTS | st.integers(), inner, max_size=4) | st.tuples(inner, inner)
    ),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(PLAIN)
def test_whatever_is_plain_needs_no_declaration(value: Any) -> None:
    schema = Schema.of(Any, name="kept")
    assert same(schema.decode(carried(schema.encode(value))).value, value)


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.tuples(st.sampled_from(ATOMS), st.sampled_from(ATOMS)).map(either), st.data())
def test_either_of_two_types_comes_back_as_the_one_it_was(case: Case, data: st.DataObject) -> None:
    value = data.draw(case[1])
    schema = Schema.of(case[0], name="kept")
    assert same(schema.decode(carried(schema.encode(value))).value, value)
