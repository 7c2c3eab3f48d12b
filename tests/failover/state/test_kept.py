"""Kept values come back as they were: same types, same values, same bits."""

from __future__ import annotations

import array
import collections
import datetime as dt
import ipaddress
import math
import pathlib
import struct
import uuid
import zoneinfo
from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Any, Final, Literal, NewType, Optional

import msgspec
import numpy as np
import pytest

from failover.state import MISSING, Field, Schema
from tests.failover.state import models
from tests.failover.state.models import (
    Bits,
    Box,
    Cell,
    Derived,
    Faults,
    FrozenSlotted,
    FrozenTrack,
    Level,
    Mission,
    Mode,
    Node,
    Pose,
    Reading,
    Settings,
    Slotted,
    Track,
    Word,
)
from tests.failover.state.sameness import carried, resumed, same

ODD_NAN = struct.unpack("<d", b"\x01\x02\x03\x04\x05\x06\xf8\xff")[0]
BERLIN = zoneinfo.ZoneInfo("Europe/Berlin")
RECORDS = np.dtype([("id", "<u4"), ("at", [("x", "<f8"), ("y", ">f4")]), ("cov", "<f8", (2, 2)), ("name", "U7")])
Metres = NewType("Metres", float)

KEPT: list[tuple[Any, Any]] = [
    (None, None),
    (bool, True),
    (int, -(1 << 63)),
    (int, (1 << 64) - 1),
    (int, 1 << 64),
    (int, -(1 << 63) - 1),
    (int, -(10**400)),
    (int, True),
    (int, np.int16(-3)),
    (float, 0.1),
    (float, -0.0),
    (float, math.inf),
    (float, -math.inf),
    (float, ODD_NAN),
    (float, 5e-324),
    (float, 3),
    (float, 1 << 70),
    (float, np.float64(0.3)),
    (float, np.float32(0.3)),
    (complex, complex(-0.0, math.inf)),
    (complex, 2.5),
    (complex, np.complex64(1 + 2j)),
    (str, ""),
    (str, "grün \N{ROBOT FACE}\0"),
    (str, "bad\udcff name"),
    (bytes, b""),
    (bytes, b"\xff" * 4095),
    (bytes, b"\xfe" * 4096),
    (bytes, bytes(range(256)) * 100),
    (bytearray, bytearray(b"abc")),
    (bytearray, bytearray(10_000)),
    (dt.datetime, dt.datetime(2026, 11, 21, 8, 0, 0, 123456)),
    (dt.datetime, dt.datetime(1, 1, 1)),
    (dt.datetime, dt.datetime(2026, 11, 21, tzinfo=dt.UTC)),
    (dt.datetime, dt.datetime(2026, 11, 21, tzinfo=dt.timezone(dt.timedelta(hours=-3, microseconds=1)))),
    (dt.datetime, dt.datetime(2026, 11, 21, tzinfo=dt.timezone(dt.timedelta(hours=1), "CET"))),
    (dt.datetime, dt.datetime(2026, 10, 25, 2, 30, tzinfo=BERLIN)),
    (dt.datetime, dt.datetime(2026, 10, 25, 2, 30, tzinfo=BERLIN, fold=1)),
    (dt.date, dt.date(2026, 2, 28)),
    (dt.time, dt.time(23, 59, 59, 999999, tzinfo=dt.UTC, fold=1)),
    (dt.timedelta, dt.timedelta(days=-3, seconds=2, microseconds=1)),
    (dt.timezone, dt.UTC),
    (zoneinfo.ZoneInfo, BERLIN),
    (Decimal, Decimal("1.10")),
    (Decimal, Decimal("-0E-8")),
    (Decimal, Decimal("sNaN123")),
    (Decimal, Decimal("1E+999999")),
    (Fraction, Fraction(-(10**30), 7)),
    (slice, slice(1, None, -(1 << 70))),
    (msgspec.UnsetType, msgspec.UNSET),
    (int | msgspec.UnsetType, msgspec.UNSET),
    (ipaddress.IPv4Address, ipaddress.ip_address("192.168.7.11")),
    (ipaddress.IPv6Interface, ipaddress.ip_interface("fe80::1%eth0/64")),
    (ipaddress.IPv4Network, ipaddress.ip_network("10.0.0.0/8")),
    (array.array, array.array("d", [0.1, -0.0])),
    (array.array, array.array("H", range(5000))),
    (list[array.array], [array.array("b")]),
    (uuid.UUID, uuid.UUID(int=7)),
    (pathlib.Path, pathlib.Path("/a/b\udcff/ü")),
    (pathlib.PurePath, pathlib.PurePath(".")),
    (pathlib.PureWindowsPath, pathlib.PureWindowsPath("C:/x")),
    (range, range(0, 1 << 80, 3)),
    (Mode, Mode.HALT),
    (Level, Level.HIGH),
    (Word, Word.NO),
    (Faults, Faults.HEAT | Faults.LINK),
    (Faults, Faults(0)),
    (Bits, Bits.A | Bits(64)),
    (Literal["a", 1, True], True),
    (Literal["a", 1, True], 1),
    (Literal[Mode.IDLE, "IDLE"], Mode.IDLE),
    (Metres, 2.5),
    (Annotated[int, "pixels"], 3),
    (Final[int], 3),
    (Optional[int], None),  # noqa: UP045 - as programs write it
    (int | str | None, "x"),
    (bool | float, 1.5),
    (float | int | str, 3),
    (list[int] | list[str], ["a"]),
    (list[int] | list[str], []),
    (Pose | Cell, Cell(1, 2)),
    (Pose | Slotted | None, Slotted(Pose(1, 2, 3))),
    (Mode | str, "IDLE"),
    (Mode | str, Mode.IDLE),
    (tuple[int, str, None], (1, "a", None)),
    (tuple[int, ...], (1, 2, 1 << 65)),
    (tuple[()], ()),
    (list[float], [0.5, ODD_NAN, 2, 1 << 64]),
    (list[list[list[int]]], [[[1], []], [], [[2, 3]]]),
    (set[str], {"a", "b", "ü"}),
    (frozenset[Cell], frozenset({Cell(1, 2), Cell(2, 1)})),
    (collections.deque[int], collections.deque([1, 2, 3], 3)),
    (collections.deque[int], collections.deque(maxlen=None)),
    (dict[str, int], {"b": 1, "a": 2, "$array": 3}),
    (dict[str, int], {"bad\udcff": 1}),
    (dict[int, str], {3: "c", -1: "a"}),
    (dict[float, int], {math.inf: 1, 0.5: 2}),
    (dict[Cell, Pose], {Cell(1, 2): Pose(1, 2, 3)}),
    (dict[Mode, list[int]], {Mode.HALT: [1]}),
    (dict[str | int, int], {"1": 1, 1: 2}),
    (dict[tuple[int, int] | None, bool], {(1, 2): True, None: False}),
    (collections.OrderedDict[str, int], collections.OrderedDict([("b", 1), ("a", 2)])),
    (collections.Counter[str], collections.Counter("hello")),
    (collections.defaultdict[str, list[int]], collections.defaultdict(list, {"a": [1]})),
    (Sequence[int], (1, 2)),
    (Sequence[int], [1, 2]),
    (Mapping[str, float], {"a": 0.5}),
    (Pose, Pose(1.5, -0.0, ODD_NAN)),
    (FrozenSlotted, FrozenSlotted(Cell(1, 2), ("a",))),
    (Slotted, Slotted(Pose(), {Cell(0, 0)})),
    (Box[int], Box(3, [4])),
    (Box[Pose], Box(Pose(1, 2, 3), [Pose()])),
    (Box[int] | Box[str], Box("a")),
    (Node, Node("a", Node("b"), [Node("c", None, [Node("d")])])),
    (Reading, Reading(0.5, (1, 2))),
    (Settings, {"rate": 0.5}),
    (Settings, {"rate": 0.5, "label": "x"}),
    (Track, Track(3, [(0.5, 1.5)])),
    (FrozenTrack, FrozenTrack(7, "x")),
    (list[Track | FrozenTrack], [FrozenTrack(7), Track(1)]),
    (np.ndarray, np.arange(12, dtype=">i2").reshape(3, 4)),
    (np.ndarray, np.array(3.5)),
    (np.ndarray, np.zeros((0, 5), "f4")),
    (np.ndarray, np.asfortranarray(np.arange(6000.0).reshape(60, 100))),
    (np.ndarray, np.arange(100)[::-3]),
    (np.ndarray, np.array(["a", "bcd"])),
    (np.ndarray, np.array([b"a", b"bcd"])),
    (np.ndarray, np.array(["2026-11-21", "NaT"], "M8[ns]")),
    (np.ndarray, np.array([1, 2], "m8[25s]")),
    (np.ndarray, np.array([True, False])),
    (np.ndarray, np.array([1 + 2j], "c8")),
    (np.ndarray, np.zeros(3, "V5")),
    (np.ndarray, np.zeros(50, RECORDS)),
    (np.ndarray, np.ones(500, np.dtype([("a", "i1"), ("b", "f8")], align=True))),
    (np.ndarray, np.zeros(3, np.dtype([]))),
    (np.ndarray[Any, np.dtype[np.float64]], np.linspace(0, 1, 1000)),
    (np.float32, np.float32(0.1)),
    (np.generic, np.datetime64("2026-11-21", "us")),
    (np.void, np.zeros(1, RECORDS)[0]),
    (dict[str, np.ndarray], {"a": np.zeros(3), "b": np.zeros(3000)}),
    (Any, {"a": [1, (2.5, None), {3, 4}], 5: {b"x": bytearray(b"y")}, "n": np.float32(1), "t": dt.timedelta(1)}),
    (Any, np.zeros((40, 40))),
    (list, [1, "a", (None, 2j), frozenset({1})]),
    (dict, {"a": {"b": {"c": 1 << 99}}, None: 0}),
    (object, "anything"),
]


def _told(part: object) -> str:
    """A part of a test's name, the same in each process: the order of a set is not."""
    return f"{{{str(sorted(part))[1:-1]}}}" if type(part) is set else repr(part)[:50]


@pytest.mark.parametrize(("annotation", "value"), KEPT, ids=_told)
def test_a_value_comes_back_as_it_was(annotation: Any, value: Any) -> None:
    assert same(resumed(annotation, value), value)


@pytest.mark.parametrize(("annotation", "value"), KEPT, ids=_told)
def test_the_same_value_gives_the_same_bytes(annotation: Any, value: Any) -> None:
    schema = Schema.of(annotation, name="kept")
    first, second = carried(schema.encode(value)), carried(schema.encode(value))
    assert first.data == second.data
    assert Schema.of(annotation, name="kept").fingerprint == schema.fingerprint


def test_a_whole_mission_comes_back_as_it_was() -> None:
    mission = Mission(
        Pose(1, 2, 3),
        Mode.DRIVE,
        Faults.HEAT,
        [Pose(), Cell(1, 2)],
        {(0, 0): np.zeros((64, 64)), (0, 1): np.zeros(3)},
        {"gain": 0.5, "limits": (1, 2)},
        (1, 2, 3),
        {"a": Track(1, [(0.5, 0.5)])},
    )
    assert same(resumed(Mission, mission), mission)


def test_no_constructor_runs_when_a_record_comes_back() -> None:
    value = Derived(3.0)
    assert value.root > 0, "a cached property lies beside the fields"
    found = resumed(Derived, value)
    assert (found.side, found.area) == (3.0, 9.0)
    assert "root" not in vars(found)


def test_a_struct_that_must_run_code_still_holds_what_was_stored() -> None:
    value = models.CheckedTrack(3)
    value.double = 77
    assert resumed(models.CheckedTrack, value) == value


def test_the_type_of_a_default_is_its_declaration() -> None:
    schema = Schema.of(MISSING, default={"count": 0}, name="counter")
    assert schema.decode(schema.encode({"count": 1 << 70})).value == {"count": 1 << 70}
    assert Schema.of(MISSING, default=Pose()).description == Schema.of(Pose).description


def test_a_default_is_copied_for_each_use() -> None:
    schema = Schema.of(list[int], default=[1])
    schema.fresh().append(2)
    assert schema.fresh() == [1]


def test_the_fields_of_a_component_are_kept_together() -> None:
    schema = Schema.of_fields(
        {"pose": Field(Pose, Pose()), "grid": Field(np.ndarray, shape=(64, 64), dtype="u1"), "best": Field(Pose | None, None)},
        name="mapper",
    )
    value = schema.fresh()
    assert value["grid"].shape == (64, 64)
    value["grid"][3, 3] = 7
    value["best"] = value["pose"]
    found = schema.decode(carried(schema.encode({**value, "besides": object()}))).value
    assert found["grid"][3, 3] == 7
    assert found["best"] is found["pose"]
    assert list(found) == ["pose", "grid", "best"]


def test_large_arrays_and_bytes_lie_in_regions_named_by_their_place() -> None:
    value = {"a": [np.zeros(512), np.zeros(511)], (1, "b"): b"x" * 4096, 3: {"long" * 40: np.zeros(600)}}
    encoded = Schema.of(dict, name="mission").encode(value)
    names = [region.name for region in encoded.regions]
    assert names[0] == "mission['a'][0]"
    assert names[1] == "mission[#1]"
    assert names[2].startswith("mission[3]['longlong") and names[2].endswith("…#0]")
    assert [region.memory.nbytes for region in encoded.regions] == [4096, 4096, 4800]
    assert len(encoded.data) < 4800, "the array just below lies inside"


def test_the_memory_of_a_region_is_the_arrays_own() -> None:
    grid = np.zeros((100, 100))
    (region,) = Schema.of(np.ndarray).encode(grid).regions
    grid[0, 0] = 1.0
    assert bytes(region.memory[:8]) == struct.pack("<d", 1.0)


def test_arrays_can_be_read_into_memory_of_the_callers_choice() -> None:
    schema = Schema.of(dict[str, np.ndarray], name="m")
    backing = np.zeros(1000)
    asked = []

    def allocate(name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
        asked.append((name, shape, dtype.str))
        return backing.reshape(shape)

    found = schema.decode(carried(schema.encode({"a": np.arange(1000.0).reshape(10, 100)})), allocate).value
    assert asked == [("m['a']", (10, 100), "<f8")]
    assert np.shares_memory(found["a"], backing) and backing[999] == 999.0


def test_what_is_read_can_be_written_to() -> None:
    for value in (np.zeros(3), np.zeros(3000), np.asfortranarray(np.ones((30, 40)))):
        resumed(np.ndarray, value)[...] = 1
