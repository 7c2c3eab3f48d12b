"""Values that cannot be kept are refused by name, when declared or when committed, with a cure."""

from __future__ import annotations

import collections
import datetime as dt
import io
import os
import queue
import re
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import pytest

from checkpoint.segment import layout
from failover.errors import FailoverError, FitError, KeepError, SchemaError, StateError, StateFormatError
from failover.state import MISSING, Field, Formerly, Pickled, Schema
from failover.state.wire import DATA_SIZE_MAX, DEPTH_MAX, NAME_SIZE_MAX, REGION_COUNT_MAX
from tests.failover.state.models import Cell, Derived, Mode, Node, Pose, Settings
from tests.failover.state.sameness import moved, resumed


@dataclass
class Busy:
    pose: Pose
    lock: threading.Lock


@dataclass
class Deep:
    inner: list[Busy]


@dataclass
class Unresolved:
    pose: Nowhere  # type: ignore[name-defined] # noqa: F821 - that is the point


@dataclass
class Twice:
    a: int
    b: Annotated[int, Formerly("a")]


class SpecialPose(Pose):
    pass


class Kilometres(float):
    pass


@pytest.mark.parametrize(
    ("declared", "sentence"),
    [
        (
            Busy,
            r"cannot keep kept\.lock: .*lock.* a lock belongs to the threads of one process; make it anew at each start",
        ),
        (Deep, r"cannot keep kept\.inner\[\]\.lock: "),
        (dict[str, socket.socket], r"cannot keep kept\[\]: a socket\.socket cannot be kept"),
        (Callable[[], int], r"cannot keep kept: collections\.abc\.Callable\[\[\], int\] is not a type that we know"),
        (Kilometres, r"cannot keep kept: a tests\.failover\.state\.test_refusals\.Kilometres cannot be kept"),
        (Unresolved, r"cannot keep kept: an annotation of Unresolved cannot be resolved: name 'Nowhere' is not defined; define"),
        (Twice, r"cannot keep kept\.a: the name is declared twice"),
        ("Pose", r"cannot keep kept: its annotation 'Pose' is still text"),
        (MISSING, r"cannot keep kept: it has neither an annotation nor a default"),
        (list[Any] | Mode | type, r"cannot keep kept: a builtins\.type cannot be kept"),
        (Pose | NamedTuple("Pose", [("x", int)]), r"cannot keep kept: two types of Pose \| Pose have one name"),  # type: ignore[operator]
        (collections.ChainMap, r"cannot keep kept: a collections\.ChainMap cannot be kept"),
    ],
)
def test_what_cannot_be_kept_is_refused_when_it_is_declared(declared: Any, sentence: str) -> None:
    with pytest.raises(SchemaError, match=f"^{sentence}"):
        Schema.of(declared, name="kept")


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (threading.Lock, "it holds a lock: a lock belongs to the threads of one process; make it anew at each start"),
        (threading.Event, "it holds an Event: a lock belongs to the threads"),
        (
            threading.Thread,
            "it holds a Thread: a running one cannot move to another process; keep the values that it works on, and start",
        ),
        (lambda: Path(os.devnull).open(), "it holds a TextIOWrapper: an open file .*; keep its path and position, and open it"),  # noqa: SIM115 - it is closed below
        (io.BytesIO, r"it holds a BytesIO: keep its bytes, getvalue\(\)"),
        (socket.socket, "it holds a socket: a connection belongs to one process; keep the address, and connect anew"),
        (lambda: (number for number in range(3)), "it holds a generator: its position cannot be read; keep the numbers"),
        (lambda: lambda: 3, "it holds a function: code is no data; keep a name or a member of an Enum, and look the function up"),
        (lambda: int, "it holds a type: code is no data; .* look the class up by it"),
        (lambda: memoryview(b"x"), r"it holds a memoryview: keep the array or bytearray that it looks into, or bytes\(it\)"),
        (queue.Queue, "it holds a Queue: it has locks inside; keep a collections.deque"),
        (lambda: re.compile("x"), "it holds a Pattern: keep its text"),
        (lambda: np.random.RandomState(1), r"it holds a RandomState: keep the numpy.random.Generator over it"),
    ],
)
def test_what_is_found_in_a_dict_is_refused_with_what_to_do(make: Callable[[], Any], sentence: str) -> None:
    value = make()
    with pytest.raises(KeepError, match=rf"^cannot keep kept\['parts'\]\[1\]: {sentence}"):
        Schema.of(dict, name="kept").encode({"parts": [0, value]})
    if hasattr(value, "close"):
        value.close()


def test_a_type_that_is_made_of_itself_is_refused() -> None:
    endless = type("TypeAliasType", (), {})()  # ``type Endless = list[Endless]``, as Python 3.12 has it
    endless.__value__ = list[endless]  # type: ignore[valid-type]
    for declare in (lambda: Schema.of(endless, name="kept"), lambda: Schema.of_fields({"x": Field(endless)}, name="kept")):
        with pytest.raises(
            SchemaError, match="cannot keep kept: a type in it is made of itself without end; put a class between"
        ):
            declare()


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        (Field(threading.Lock), r"mapper\.it: "),
        (Field(np.ndarray, dtype="O", shape=(3,)), r"mapper\.it: dtype object holds Python objects"),
        (Field(np.ndarray, dtype="nonsense"), r"mapper\.it: data type 'nonsense' not understood"),
        (Field(np.ndarray, shape=(-1,)), r"mapper\.it: its shape \(-1,\) has a negative length"),
        (Field(), r"mapper\.it: it has neither"),
    ],
)
def test_a_component_names_the_field_that_cannot_be_kept(field: Field, sentence: str) -> None:
    with pytest.raises(SchemaError, match=f"^cannot keep {sentence}"):
        Schema.of_fields({"it": field}, name="mapper")


@pytest.mark.parametrize(
    ("declared", "value", "sentence"),
    [
        (
            Pose,
            Pose(1, "north"),  # type: ignore[arg-type]
            r"kept\.y: it holds a str, declared float; assign a value of the declared type, or change the declaration",
        ),
        (list[Pose], [Pose(), Cell(1, 2)], r"kept\[1\]: it holds a Cell, declared Pose"),
        (list[Pose], [SpecialPose()], r"kept\[0\]: it holds a SpecialPose, declared Pose"),
        (list[int], (1, 2), r"kept: it holds a tuple, declared list\[int\]"),
        (int, 1.0, r"kept: it holds a float, declared int"),
        (int, np.float64(1), r"kept: it holds a float64, declared int"),
        (bool, 1, r"kept: it holds an int, declared bool"),
        (str, b"x", r"kept: it holds a bytes, declared str"),
        (tuple[int, int], (1, 2, 3), r"kept: it holds a tuple, declared tuple\[int, int\]; it has 3 elements"),
        (dict[str, int], {1: 2}, r"kept\[key #0\]: it holds an int, declared str"),
        (int | None, "x", r"kept: it holds a str, declared int \| None"),
        (list[int] | list[str], [1, "a"], r"kept\[1\]: it holds a str, declared int"),
        (Any, {"a": Pose()}, r"kept\['a'\]: nothing but its own type \(Pose\) would say what it is; declare the type"),
        (Any, [object()], r"kept\[0\]: nothing but its own type \(object\)"),
        (Settings, {}, r"kept: it has no 'rate', declared Settings"),
        (Settings, {"rate": 1.0, "colour": 2}, r"kept\.colour: it was set but is no declared field of Settings"),
        (np.ndarray, np.array([object()]), r"kept: it holds a ndarray, declared array; dtype object holds Python objects"),
        (
            np.ndarray,
            np.zeros(1, np.longdouble),
            r"kept: .* is not the same on every machine; convert it, for example",
        ),
        (np.ndarray, np.zeros(1, [(("title", "a"), "i4")]), r"kept: .* dtype has titles beside its names"),
        (np.ndarray, np.ma.masked_array([1]), r"kept: it holds a MaskedArray, declared array; keep numpy.asarray"),
        (np.ndarray, [1], r"kept: it holds a list, declared array"),
        (dt.datetime, dt.datetime(2026, 1, 1, tzinfo=type("Zone", (dt.tzinfo,), {})()), r"kept: .*; its time zone is neither"),
        (dt.datetime, dt.date(2026, 1, 1), r"kept: it holds a date, declared datetime"),
        (
            collections.defaultdict[str, int],
            collections.defaultdict(lambda: 3),
            r"kept: it holds a defaultdict.*its default_factory is not <class 'int'>",
        ),
    ],
)
def test_a_value_that_cannot_be_kept_is_refused_by_name(declared: Any, value: Any, sentence: str) -> None:
    schema = Schema.of(declared, name="kept")
    with pytest.raises(KeepError, match=f"^cannot keep {sentence}"):
        schema.encode(value)


def test_an_endless_integer_is_refused() -> None:
    with pytest.raises(KeepError, match="kept: it holds an int, declared int; integers of 1048576 bits and more"):
        resumed(int, 1 << (1 << 20))


def test_what_was_set_but_not_declared_is_refused_by_name() -> None:
    value = Derived(2.0)
    value.remembered = 3  # type: ignore[attr-defined]
    with pytest.raises(KeepError, match=r"kept\.remembered: it was set but is no declared field of Derived, and would be"):
        resumed(Derived, value)


class Base:
    __slots__ = ("cache",)


@dataclass(slots=True)
class Above(Base):
    count: int = 0


class Loose(msgspec.Struct, dict=True):
    count: int = 0


class Named(NamedTuple("Named", [("count", int)])):
    pass


@pytest.mark.parametrize("cls", [Above, Loose, Named])
def test_what_lies_beside_the_fields_is_refused_by_name(cls: Any) -> None:
    value = cls(count=3)
    assert resumed(cls, value) == value
    value.cache = 1
    with pytest.raises(KeepError, match=r"kept\.cache: it was set but is no declared field"):
        resumed(cls, value)


def test_a_value_that_changes_while_it_is_committed_is_refused() -> None:
    value: dict[Any, Any] = {}

    class Meddler(threading.local):
        """Its conversion, in the middle of the commit, changes what is committed."""

        def __reduce__(self) -> tuple[Any, ...]:
            value["more"] = 1
            return (int, ())

    value.update({"a": Meddler(), "b": 2})
    with pytest.raises(KeepError, match=r"kept: another thread changes it meanwhile \(dictionary changed size"):
        Schema.of(dict[str, Annotated[Any, Pickled()]], name="kept").encode(value)


def test_a_field_that_was_never_set_is_refused_by_name() -> None:
    value = Derived(2.0)
    del value.area
    with pytest.raises(KeepError, match=r"cannot keep kept: .*no attribute 'area'; set every field before a commit"):
        resumed(Derived, value)


def test_endless_nesting_is_refused() -> None:
    node = Node("end")
    for _ in range(DEPTH_MAX + 1):
        node = Node("more", node)
    with pytest.raises(KeepError, match=f"nested deeper than {DEPTH_MAX}; keep a flat list and indices"):
        resumed(Node, node)


def test_nesting_up_to_the_limit_is_kept() -> None:
    value: list[Any] = []
    for _ in range(DEPTH_MAX):
        value = [value]
    assert resumed(list, value) == value


def test_immutable_values_that_hold_themselves_are_refused() -> None:
    cell = Cell(1, 2)
    object.__setattr__(cell, "row", cell)
    with pytest.raises(KeepError, match=r"kept\.row: it holds a Cell, declared int"):
        resumed(Cell, cell)


def test_a_state_that_is_too_large_besides_its_arrays_is_refused() -> None:
    with pytest.raises(
        KeepError, match=f"kept: {DATA_SIZE_MAX + 59} bytes besides its arrays are more than {DATA_SIZE_MAX}; keep long"
    ):
        Schema.of(str, name="kept").encode("x" * (DATA_SIZE_MAX + 17))


def test_too_many_arrays_are_refused() -> None:
    assert REGION_COUNT_MAX == layout.MAX_REGIONS - 1
    with pytest.raises(KeepError, match=rf"kept\[{REGION_COUNT_MAX}\]: more than {REGION_COUNT_MAX} arrays of 4096 bytes"):
        Schema.of(list[bytes], name="kept").encode([bytes(4096)] * (REGION_COUNT_MAX + 1))


def test_an_array_at_too_long_a_path_is_refused_by_it() -> None:
    assert NAME_SIZE_MAX == layout.MAX_NAME_SIZE
    value: dict[str, Any] = {"x": np.zeros(1000)}
    for _ in range(50):
        value = {"x": value}
    with pytest.raises(KeepError, match=r"cannot keep kept\['x'\].*…: its name is longer than 224 bytes; keep it at a shorter"):
        resumed(Any, value)


def test_errors_are_of_one_family_and_know_the_place() -> None:
    for kind in (SchemaError, KeepError, FitError, StateFormatError):
        assert issubclass(kind, StateError) and issubclass(kind, FailoverError)
    with pytest.raises(StateError) as caught:
        resumed(list[Pose], [Pose(), Pose(1, None)])  # type: ignore[arg-type]
    assert caught.value.place == "kept[1].y"


def test_there_is_no_first_value_without_a_default() -> None:
    with pytest.raises(SchemaError, match=r"kept has no default to start from"):
        Schema.of(int, name="kept").fresh()
    with pytest.raises(SchemaError, match=r"mapper\.pose has no default to start from"):
        Schema.of_fields({"pose": Field(Pose)}, name="mapper").fresh()


# --- Pickle ----------------------------------------------------------------------------------------------------------


class Odd:
    """No library made it; pickle takes it."""

    def __init__(self, size: int) -> None:
        self.size = size


@dataclass
class Loud:
    odd: Annotated[Odd, Pickled()]
    count: int = 0


@dataclass
class Quiet:
    odd: Any = None
    count: int = 0


def test_a_field_that_asks_for_it_is_pickled() -> None:
    assert resumed(Loud, Loud(Odd(3))).odd.size == 3
    schema = Schema.of_fields({"odd": Field(Odd, pickled=True)}, name="mapper")
    big = Odd(3)
    big.content = bytes(9000)  # type: ignore[attr-defined]
    encoded = schema.encode({"odd": big})
    assert [region.name for region in encoded.regions] == ["mapper.odd"]
    assert schema.decode(encoded).value["odd"].content == bytes(9000)


def test_pickled_bytes_are_refused_by_every_declaration_that_does_not_ask_for_them() -> None:
    for declared in (Quiet, dict, Any, dict[str, Any]):
        with pytest.raises(FitError, match=r"stored as a pickled, wanted|stored as a record"):
            moved(Loud, Loud(Odd(3)), declared)


def test_what_pickle_refuses_is_refused_by_name() -> None:
    with pytest.raises(KeepError, match=r"cannot keep kept\.odd: .*pickle says: cannot pickle"):
        resumed(Loud, Loud(threading.Lock()))  # type: ignore[arg-type]


@dataclass
class Later:
    odd: Annotated[Odd, Pickled()] = field(default_factory=lambda: Odd(1))


def test_plain_data_is_not_unpickled() -> None:
    with pytest.raises(FitError, match=r"kept\.odd: stored as 3 bytes|kept\.odd: stored as bytes"):
        moved(Quiet, Quiet(b"cos"), Later)
