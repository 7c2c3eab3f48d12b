"""Bytes from an attacker: refused with a reason that names the place, in bounded memory and time, and nothing runs."""

from __future__ import annotations

import tracemalloc
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest

from failover.errors import FitError, StateError, StateFormatError
from failover.state import Encoded, Pickled, Region, Schema
from failover.state.wire import FORMAT
from tests.failover.state import models
from tests.failover.state.models import Cell, Mode, Node, Pose, Track
from tests.failover.state.sameness import forged

MEMORY_MAX = 4 << 20
"""Bytes that refusing a small state may take."""


def region(name: str, size: int) -> Region:
    return Region(name, memoryview(bytes(size)))


def array(dtype: Any, shape: Any, content: Any, order: Any = "C") -> dict[str, Any]:
    return {"$array": [dtype, shape, content, order]}


def refused(declared: Any, encoded: Encoded, sentence: str, kind: type[StateError] = FitError) -> None:
    """Expect a refusal that begins with a place and takes little memory."""
    schema = Schema.of(declared, name="kept")
    tracemalloc.start()
    try:
        with pytest.raises(kind, match=f"^{sentence}"):
            schema.decode(encoded)
        assert tracemalloc.get_traced_memory()[1] < MEMORY_MAX
    finally:
        tracemalloc.stop()


WHOLE = Schema.of(int, name="kept").encode(3).data


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "kept: not a whole state: Input data was truncated"),
        (WHOLE[:-1], "kept: not a whole state: Input data was truncated"),
        (WHOLE + b"\0", "kept: not a whole state: .*trailing"),
        (b"\x03", "kept: not a state of format 'failover.state/1' .it begins with int"),
        (
            WHOLE.replace(b"state/1", b"state/2"),
            "kept: not a state of format 'failover.state/1' .it begins with 'failover.state/2'",
        ),
        (WHOLE.replace(b"\xc4\x10", b"\xc5\0\x10"), "kept: damaged: doubled keys, or another spelling than ours"),
        (WHOLE[:-1] + b"\x82\xa1a\x01\xa1a\x02", "kept: damaged: doubled keys"),
        (WHOLE[:-1] + b"\xcd\x00\x03", "kept: damaged: .*another spelling"),
        (WHOLE[:-1] + b"\xca\0\0\0\0", "kept: damaged: .*another spelling"),
        (WHOLE[:-1] + b"\xdd\xff\xff\xff\xff", "kept: not a whole state"),
        (WHOLE[:-1] + b"\xdf\xff\xff\xff\xff", "kept: not a whole state"),
        (WHOLE[:-1] + b"\xc6\xff\xff\xff\xff", "kept: not a whole state"),
        (WHOLE[:-1] + b"\xdb\xff\xff\xff\xff", "kept: not a whole state"),
        (WHOLE[:-1] + b"\xa1\xff", "kept: not a whole state: .*utf-8"),
        (WHOLE[:-1] + b"\x91" * 1_000_000 + b"\x03", "kept: not a whole state: maximum recursion depth"),
        (WHOLE[:-1] + b"\x81\x80\x03", "kept: not a whole state: .*hashable"),
        (WHOLE[:-1] + b"\xd6\xff\0\0\0\0", "kept: (damaged|stored)"),
        (msgspec.msgpack.encode([FORMAT, 0, bytes(16), 3]), "kept: damaged: its version"),
        (msgspec.msgpack.encode([FORMAT, 1 << 40, bytes(16), 3]), "kept: damaged: its version"),
        (msgspec.msgpack.encode([FORMAT, 1, bytes(15), 3]), "kept: damaged: its version or its fingerprint"),
        (msgspec.msgpack.encode([FORMAT, 1, 3]), "kept: not a state of format"),
    ],
    ids=range(21),
)
def test_bytes_that_are_no_whole_state_are_refused(data: bytes, sentence: str) -> None:
    refused(int, Encoded(data), sentence, StateError)


@pytest.mark.parametrize(
    ("declared", "wire", "sentence"),
    [
        (int, msgspec.msgpack.Ext(5, b"x"), r"kept: stored as an unknown Ext, wanted int"),
        (int, {"$int": b"\x01"}, r"kept: stored as an int, wanted int \(not in its shortest form"),
        (int, {"$int": bytes(1 << 20)}, r"kept: stored as an int, wanted int \(not at most 131072 bytes"),
        (int, {"$code": "import os"}, r"kept: stored as a code, wanted int"),
        (Any, {"$code": "import os"}, r"kept: stored as a code, wanted Any"),
        (Any, {"$as": ["os.system", 1]}, r"kept: stored as an as, wanted Any"),
        (
            Pose | Track,
            {"$as": ["os.system", {}]},
            r"kept: stored as a record \(\), wanted Pose \| Track \(stored as 'os.system'\)",
        ),
        (Pose | Track, {"$as": "Pose"}, r"kept: .*not a label and a value"),
        (Mode, "__class__", r"kept: stored as str '__class__', wanted Mode"),
        (models.Faults, {"$tuple": ["HEAT", "__or__"]}, r"kept: stored as str '__or__', wanted Faults"),
        (models.Faults, {"$tuple": [1 << 40]}, r"kept: stored as a tuple, wanted Faults"),
        (models.Faults, {"$tuple": [1, "HEAT"]}, r"kept: stored as int 1, wanted Faults"),
        (Pose, {"x": 1.0, "__class__": "Cell", "y": 1.0, "heading": "x"}, r"kept\.heading: stored as str 'x'"),
        (Pose, {1: 2}, r"kept: stored as a record \(1\), wanted Pose"),
        (Pose, {("a",): 2, "x": 1.0, "y": []}, r"kept: stored as a record \(\('a',\), x, y\), wanted Pose"),
        (Pose, [1.0, 2.0, 3.0], r"kept: stored as a list of 3, wanted Pose"),
        (complex, {"$complex": [1.0, "x"]}, r"kept: stored as a complex, wanted complex"),
        (str, {"$str": b"\xff"}, r"kept: stored as bytes 1 bytes, wanted str \(not text"),
        (set[int], {"$set": [1, 1]}, r"kept: stored as a set, wanted set\[int\] \(an element twice"),
        (set, {"$set": [[1]]}, r"kept: stored as a set, wanted set\[Any\] \(unhashable"),
        (dict[int, int], {"$dict": [[1, 1], [1, 2]]}, r"kept\[1\]: stored as a dict, wanted dict\[int, int\] \(a key twice"),
        (dict, {"$dict": [[[], 1]]}, r"kept\[#0\]: stored as a dict, wanted dict\[Any, Any\] \(unhashable"),
        (dict, {"$dict": [[1]]}, r"kept: stored as a dict, wanted dict"),
        (dict, {"$map": [1]}, r"kept: stored as a map, wanted dict"),
        (dict, {"$map": {1: 1}}, r"kept: stored as a map, wanted dict"),
        (Any, {"$deque": [-1, []]}, r"kept: stored as a deque"),
        (Any, {"$deque": [1, [1, 2]]}, r"kept: stored as a deque"),
        (Any, {"$decimal": "9" * 200_000}, r"kept: .*more than 100000 digits"),
        (Any, {"$decimal": "1_0"}, r"kept: stored as a decimal, wanted Decimal \(not in the form that we write"),
        (Any, {"$decimal": "x"}, r"kept: stored as a decimal, wanted Decimal"),
        (Any, {"$fraction": [1, 0]}, r"kept: .*denominator"),
        (Any, {"$uuid": b"123"}, r"kept: stored as an uuid|kept: stored as a uuid"),
        (Any, {"$path": "a//b"}, r"kept: stored as a path, wanted Path \(not in the form"),
        (Any, {"$path": 3}, r"kept: stored as a path"),
        (Any, {"$zone": "../../etc/passwd"}, r"kept: stored as a zone"),
        (Any, {"$zone": "No/Such"}, r"kept: stored as a zone, wanted ZoneInfo"),
        (Any, {"$zone": "x" * 10_000}, r"kept: .*too long a name"),
        (Any, {"$datetime": ["2026-01-01T00:00:00", [1 << 60, None], 0]}, r"kept: stored as a datetime"),
        (Any, {"$datetime": ["2026-01-01", None, 0]}, r"kept: .*not in the form that we write"),
        (Any, {"$datetime": ["2026-01-01T00:00:00", None, 2]}, r"kept: stored as a datetime"),
        (Any, {"$timedelta": [1 << 62, 0, 0]}, r"kept: stored as a timedelta"),
        (Any, {"$timedelta": [0, 86400, 0]}, r"kept: .*not in the form"),
        (Any, {"$range": [0, 5, 0]}, r"kept: stored as a range"),
        (Any, {"$slice": [0, "5", None]}, r"kept: stored as a slice"),
        (Any, {"$unset": 1}, r"kept: stored as an unset|kept: stored as a unset"),
        (Any, {"$ipv4address": "192.168.7.011"}, r"kept: stored as an ipv4address"),
        (Any, {"$ipv4address": 3232237323}, r"kept: stored as an ipv4address"),
        (Any, {"$ipv4network": "10.0.0.1/8"}, r"kept: stored as an ipv4network"),
        (Any, {"$numbers": ["d", 8, b"1234567"]}, r"kept: .*7 bytes, no whole numbers"),
        (Any, {"$numbers": ["l", 4, b"1234"]}, r"kept: .*of 4 bytes a number, on this machine 8"),
        (Any, {"$numbers": ["u", 4, b"1234"]}, r"kept: stored as a numbers"),
        (Any, {"$numbers": ["d", 8, [1 << 40, "region"]]}, r"kept: stored in region 'region', which is missing"),
        (list[int], {"$same": ""}, r"kept: stored as the same object as kept, which is not part"),
        (list[list[int]], [{"$same": "[1]"}, []], r"kept\[0\]: stored as the same object as kept\[1\], which is not part"),
        (
            list[list[int]],
            [{"$same": ""}],
            r"kept\[0\]: stored as the same .* kept, which is list\[list\[int\]\], wanted list\[int\]",
        ),
        (list[Any], [[], {"$same": ["[0]"]}], r"kept\[1\]: stored as the same object as"),
        (tuple[int, int], {"$tuple": [1]}, r"kept: stored as a tuple, wanted tuple\[int, int\] \(1 elements"),
        (Annotated[Any, Pickled()], b"cos\nsystem\n(S'true'\ntR.", r"kept: stored as bytes"),
        (Any, {"$pickled": b"cos\nsystem\n(S'true'\ntR."}, r"kept: stored as a pickled, wanted Any"),
        (Annotated[Any, Pickled()], {"$pickled": b"garbage"}, r"kept: .*cannot be unpickled: UnpicklingError"),
    ],
)
def test_values_that_no_state_holds_are_refused(declared: Any, wire: Any, sentence: str) -> None:
    refused(declared, forged(wire), sentence)


RECORD = {"names": ["a", "b"], "formats": ["<f8", "<i4"], "offsets": [0, 8], "itemsize": 12}


@pytest.mark.parametrize(
    "wire",
    [
        array("|O", [1], bytes(8)),
        array("O", [1], bytes(8)),
        array("|O8", [1], bytes(8)),
        array("i4", [1], bytes(4)),
        array("<i4,<i4", [1], bytes(8)),
        array("(1000000,1000000)<i4", [1], bytes(8)),
        array("<f16", [1], bytes(16)),
        array("<i4, O", [1], bytes(12)),
        array("|V9999999", [1], b""),
        array("|S99999999999999999999", [1], b""),
        array("<U1000000", [0], b""),
        array("<M8[9999999999s]", [1], bytes(8)),
        array("<M8[0s]", [1], bytes(8)),
        array("<M8[generic]", [1], bytes(8)),
        array(3, [1], bytes(8)),
        array(["<f8"], [1], bytes(8)),
        array("<f8", [-1], b""),
        array("<f8", [-1, -1], bytes(8)),
        array("<f8", 3, bytes(24)),
        array("<f8", [2.0], bytes(16)),
        array("<f8", [True], bytes(8)),
        array("<f8", [1] * 33, bytes(8)),
        array("<f8", [1 << 40, 1 << 40], b""),
        array("<f8", [0, 1 << 62, 1 << 62], b""),
        array("|S0", [1 << 62, 8], b""),
        array("<f8", [1 << 61], b""),
        array("<f8", [3], bytes(23)),
        array("<f8", [3], bytes(25)),
        array("<f8", [3], "missing"),
        array("<f8", [3], None),
        array("<f8", [3], bytes(24), "K"),
        {"$array": ["<f8", [3], bytes(24)]},
        {"$array": None},
        array(RECORD | {"offsets": [0, 4]}, [1], bytes(12)),
        array(RECORD | {"offsets": [0, 9]}, [1], bytes(12)),
        array(RECORD | {"offsets": [-8, 0]}, [1], bytes(12)),
        array(RECORD | {"itemsize": 1 << 40}, [1], bytes(12)),
        array(RECORD | {"itemsize": 1 << 21}, [0], b""),
        array(RECORD | {"itemsize": -1}, [1], bytes(12)),
        array(RECORD | {"names": ["a", "a"]}, [1], bytes(12)),
        array(RECORD | {"names": ["a", ""]}, [1], bytes(12)),
        array(RECORD | {"names": ["a"]}, [1], bytes(12)),
        array(RECORD | {"names": [1, 2]}, [1], bytes(12)),
        array(RECORD | {"formats": ["<f8", "|O"]}, [1], bytes(12)),
        array(RECORD | {"titles": ["x", "y"]}, [1], bytes(12)),
        array({"base": "<f8", "shape": [1 << 40, 1 << 40]}, [1], bytes(12)),
        array({"base": "<f8", "shape": [-1]}, [1], bytes(12)),
        array({"base": {"base": {"base": "|O", "shape": [1]}, "shape": [1]}, "shape": [1]}, [1], bytes(8)),
        array("|b1", [2], b"\x01\x02"),
        array("<U1", [1], b"\0\0\x11\0"),
        array(">U1", [1], b"\0\x11\0\0"),
        array({"names": ["a"], "formats": ["|b1"], "offsets": [3], "itemsize": 4}, [1], b"\0\0\0\xff"),
        array({"names": ["a"], "formats": [{"base": "<U2", "shape": [2]}], "offsets": [0], "itemsize": 16}, [1], b"\xff" * 16),
        {"$scalar": ["|b1", b"\x07"]},
        {"$scalar": ["|O", bytes(8)]},
        {"$scalar": ["<f8", bytes(7)]},
        {"$scalar": [{"base": "<f8", "shape": [1]}, bytes(8)]},
        {"$scalar": None},
    ],
    ids=lambda wire: repr(wire)[:60],
)
def test_arrays_that_cannot_be_are_refused(wire: Any) -> None:
    refused(Any, forged(wire), r"kept: stored ")
    refused(dict[str, Any], forged({"$map": {"a": wire}}), r"kept\['a'\]: stored ")


def test_a_dtype_nested_without_end_is_refused() -> None:
    dtype: Any = "<f8"
    for _ in range(50):
        dtype = {"names": ["a"], "formats": [dtype], "offsets": [0], "itemsize": 8}
    refused(np.ndarray, forged(array(dtype, [1], bytes(8))), r"kept: .*dtype nested deeper than 8")


@pytest.mark.parametrize(
    ("declared", "wire", "size", "sentence"),
    [
        (np.ndarray, array("<f8", [600], "kept"), 4799, "kept: its region 'kept' holds 4799 bytes, wanted 4800"),
        (bytes, {"$bytes": [5000, "kept"]}, 4096, "kept: its region 'kept' holds 4096 bytes, wanted 5000"),
        (bytes, {"$bytes": [-1, "kept"]}, 4096, "kept: .*not a length and a region"),
        (bytes, {"$bytes": [1, "other"]}, 4096, "kept: stored in region 'other', which is missing"),
    ],
)
def test_a_region_that_does_not_fit_is_refused(declared: Any, wire: Any, size: int, sentence: str) -> None:
    refused(declared, forged(wire, region("kept", size)), sentence)


def test_a_region_is_used_once() -> None:
    """A small state must not ask for much memory by naming one region many times."""
    wire = [array("<f8", [600], "kept")] * 2
    refused(list, forged(wire, region("kept", 4800)), r"kept\[1\]: stored in region 'kept', which is missing or used twice")


def test_regions_that_cannot_be_are_refused() -> None:
    refused(list, forged([], region("a", 1), region("a", 2)), "kept: two regions have the same name", StateFormatError)
    many = [region(str(number), 1) for number in range(4097)]
    refused(list, forged([], *many), "kept: 4097 regions are more than", StateFormatError)


def test_nesting_below_the_stack_is_refused_by_its_place() -> None:
    wire: Any = {"name": "end"}
    for _ in range(150):
        wire = {"name": "more", "next": wire}
    refused(Node, forged(wire), r"kept\.next\.next.*: stored nested deeper than 100")
    nested: Any = []
    for _ in range(150):
        nested = [nested]
    refused(Any, forged(nested), r"kept\[0\]\[0\].*: stored nested deeper than 100")
    labelled: Any = 1
    for _ in range(150):
        labelled = {"$tuple": [labelled]}
    refused(Any, forged(labelled), r"kept\[0\]\[0\].*: stored nested deeper than 100")
    chained: Any = {}
    for _ in range(150):
        chained = {"$as": ["Node", chained]}
    refused(Node | Cell, forged(chained), r"kept: .*wanted Node")


def test_a_migration_never_sees_what_is_damaged() -> None:
    seen: list[Any] = []
    schema = Schema.of(Any, name="kept", version=2, migrations={1: seen.append})
    with pytest.raises(FitError, match=r"^kept\[1\]: stored"):
        schema.decode(forged([1, array("|O", [1], bytes(8))]))
    assert seen == []
