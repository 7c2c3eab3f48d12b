"""Compares two values in everything that a program could see, and makes round trips."""

from __future__ import annotations

import struct
from collections import defaultdict, deque
from decimal import Decimal
from typing import Any

import msgspec
import numpy as np

from failover.state import Encoded, Region, Schema
from failover.state.wire import FORMAT


def same(left: Any, right: Any) -> bool:
    """Equal in type, in value, in the bits of floats and in the order of entries, all the way down."""
    if type(left) is not type(right):
        return False
    if isinstance(left, np.ndarray | np.generic):
        return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()
    if isinstance(left, float):
        return struct.pack("<d", left) == struct.pack("<d", right)
    if isinstance(left, complex):
        return same(left.real, right.real) and same(left.imag, right.imag)
    if isinstance(left, list | tuple | deque):
        bound = getattr(left, "maxlen", None) == getattr(right, "maxlen", None)
        return bound and len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, set | frozenset):
        return left == right and {(type(inner), inner) for inner in left} == {(type(inner), inner) for inner in right}
    if isinstance(left, dict):
        factories = not isinstance(left, defaultdict) or left.default_factory is right.default_factory
        return factories and same(list(left.items()), list(right.items()))
    if hasattr(left, "__dict__") and type(left).__module__ == __name__.replace("sameness", "models"):
        return same(vars(left), vars(right))
    return repr(left) == repr(right) and (isinstance(left, Decimal) or bool(left == right))


def carried(encoded: Encoded) -> Encoded:
    """What another process would get: copies, and regions padded to whole pages."""
    padded = ((region.name, bytes(region.memory) + b"\xaa" * (-region.memory.nbytes % 4096)) for region in encoded.regions)
    return Encoded(bytes(encoded.data), tuple(Region(name, memoryview(content)) for name, content in padded))


def resumed(annotation: Any, value: Any) -> Any:
    """A value that was stored and read by the same declaration; nothing was worth a note."""
    schema = Schema.of(annotation, name="kept")
    decoded = schema.decode(carried(schema.encode(value)))
    assert decoded.notes == ()
    return decoded.value


def moved(old: Any, value: Any, new: Any, **declared: Any) -> Any:
    """What a value of one declaration becomes under another: (value, notes)."""
    stored = Schema.of(old, name="kept").encode(value)
    decoded = Schema.of(new, name="kept", **declared).decode(carried(stored))
    return decoded.value, decoded.notes


def forged(wire: Any, *regions: Region, version: int = 1) -> Encoded:
    """A state in our format that holds any wire value."""
    return Encoded(msgspec.msgpack.encode([FORMAT, version, bytes(16), wire]), regions)
