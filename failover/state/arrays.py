"""Kinds of plain memory: numpy arrays and scalars, bytes, bytearray.

Small ones are inside the state, those of ``Walk.inline_size`` bytes and more in regions. An array is ``{"$array": [dtype,
shape, bytes or region's name, order]}``; its dtype, byte order and memory order ("C" or "F") come back as they were, its
strides do not: a view with gaps is stored whole.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from failover.state.dtypes import SIZE_MAX, Dtype, DtypeError, checked_shape, lift_dtype, lower_dtype
from failover.state.kinds import Build, Kind, Walk
from failover.state.wire import SAME, Place, Wire, mark_of, text_of

ARRAY, SCALAR, BYTES, BYTEARRAY = "$array", "$scalar", "$bytes", "$bytearray"

Array = np.ndarray[Any, Any]


class ArrayKind(Kind):
    """numpy.ndarray, of any shape and dtype or of declared ones."""

    types = frozenset({np.ndarray})
    shapes = frozenset({ARRAY})

    def __init__(self, dtype: Dtype | None = None, shape: tuple[int, ...] | None = None) -> None:
        self._dtype = dtype
        self._shape = shape
        self.name = f"array{'' if dtype is None else f' of {dtype}'}{'' if shape is None else f' {shape}'}"

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not np.ndarray:
            cure = "keep numpy.asarray(it)" if isinstance(value, np.ndarray) else ""
            raise self.stranger(value, place, cure)
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        self._check(value, place)
        walk.meet_array(value, place)
        lowered = self._lower_dtype(value, place)
        flat, order = _flat(value)
        shape = list(value.shape)
        if flat.nbytes < walk.inline_size:
            return {ARRAY: [lowered, shape, flat.tobytes(), order]}
        return {ARRAY: [lowered, shape, walk.put_aside(flat, value.dtype.str, value.shape, place), order]}

    def _check(self, value: Array, place: Place) -> None:
        if (self._dtype is not None and value.dtype != self._dtype) or (self._shape is not None and value.shape != self._shape):
            is_now = f"array of {value.dtype} {value.shape}"
            raise self.stranger(value, place, f"it is an {is_now}: write into the declared one (``[...] =``), or declare it so")
        if value.ndim > 32:
            raise self.stranger(value, place, "more than 32 dimensions are not kept")

    def _lower_dtype(self, value: Array, place: Place) -> Wire:
        try:
            return lower_dtype(value.dtype)
        except DtypeError as error:
            raise self.stranger(value, place, str(error)) from error

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        if mark != ARRAY:
            raise self.misfit(wire, place)
        dtype, shape, content, order = self._checked(wire, place)
        if (self._dtype is not None and dtype != self._dtype) or (self._shape is not None and shape != self._shape):
            raise self.misfit(wire, place, f"it is of {dtype} {shape}")
        size = math.prod(shape) * dtype.itemsize
        memory = self._memory(content, size, build, place)
        stored_shape = shape if order == "C" else shape[::-1]
        array = build.allocate(text_of(place), stored_shape, dtype)
        if size:
            array.reshape(-1).view(np.uint8)[:] = np.frombuffer(memory, np.uint8)
        self._check_content(array, wire, place)
        value = array if order == "C" else array.T
        build.note_made(value, self, place)
        return value

    def _checked(self, wire: Wire, place: Place) -> tuple[Dtype, tuple[int, ...], Wire, str]:
        """The four parts of a stored array, each of them possible."""
        parts = wire[ARRAY]
        if type(parts) is not list or len(parts) != 4 or parts[3] not in ("C", "F"):
            raise self.misfit(wire, place, "not dtype, shape, content and order")
        try:
            dtype, shape = lift_dtype(parts[0]), checked_shape(parts[1])
        except DtypeError as error:
            raise self.misfit(wire, place, str(error)) from error
        if math.prod(length or 1 for length in shape) * dtype.itemsize > SIZE_MAX:
            raise self.misfit(wire, place, f"its shape {shape} overflows")
        return dtype, shape, parts[2], parts[3]

    def _check_content(self, array: Array, wire: Wire, place: Place) -> None:
        if not is_sound(array):
            raise self.misfit(wire, place, "its bytes are no truth values or no text")

    def _memory(self, content: Wire, size: int, build: Build, place: Place) -> memoryview:
        if type(content) is bytes and len(content) == size:
            return memoryview(content)
        if type(content) is bytes:
            raise self.misfit(content, place, f"its shape and dtype need {size}")
        return build.fetch(content, size, place)

    def description(self) -> str:
        return self.name if self._dtype is None else f"array of {lower_dtype(self._dtype)} {self._shape}"


def _flat(value: Array) -> tuple[memoryview, str]:
    """An array's bytes, in place where it has no gaps, and their order."""
    if value.flags.c_contiguous:
        order = "C"
    elif value.flags.f_contiguous:
        value, order = value.T, "F"
    else:
        value, order = np.ascontiguousarray(value), "C"
    if not value.size or not value.itemsize:
        return memoryview(b""), order
    return value.reshape(-1).view(np.uint8).data, order


ANY_ARRAY = ArrayKind()

LETTER_MAX = 0x10FFFF
"""The last code point of Unicode."""


def is_sound(array: Array) -> bool:
    """Whether every element is one: a truth value is 0 or 1, a letter a code point. Every other plain type takes any bytes."""
    dtype = array.dtype
    if dtype.names is not None:
        return all(is_sound(array[name]) for name in dtype.names)
    if dtype.kind == "b":
        return not array.size or int(array.view(np.uint8).max()) <= 1
    if dtype.kind == "U" and array.size and dtype.itemsize:
        letters = np.ascontiguousarray(array).reshape(-1).view(np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        return int(letters.max()) <= LETTER_MAX
    return True


def lower_scalar(value: Any, kind: Kind, place: Place) -> Wire:
    """A numpy scalar: its dtype and its bytes."""
    try:
        return {SCALAR: [lower_dtype(value.dtype), value.tobytes()]}
    except DtypeError as error:
        raise kind.stranger(value, place, str(error)) from error


def lift_scalar(wire: Wire, kind: Kind, place: Place) -> Any:
    """The numpy scalar of a wire value."""
    parts = wire[SCALAR]
    if type(parts) is not list or len(parts) != 2 or type(parts[1]) is not bytes:
        raise kind.misfit(wire, place, "not dtype and content")
    try:
        dtype = lift_dtype(parts[0])
    except DtypeError as error:
        raise kind.misfit(wire, place, str(error)) from error
    if dtype.subdtype is not None or dtype.itemsize != len(parts[1]):
        raise kind.misfit(wire, place, f"{len(parts[1])} bytes where {dtype} needs {dtype.itemsize}")
    holder = np.zeros(1, dtype)
    if dtype.itemsize:
        holder.view(np.uint8)[:] = np.frombuffer(parts[1], np.uint8)
    if not is_sound(holder):
        raise kind.misfit(wire, place, "its bytes are no truth value or no text")
    return holder[0]


class ScalarKind(Kind):
    """One numpy scalar type, or any of them."""

    shapes = frozenset({SCALAR})
    evident = True

    def __init__(self, cls: type) -> None:
        self.name = "numpy." + cls.__name__.rstrip("_")  # numpy 1 has bool_, numpy 2 has bool
        self._cls = cls
        self.types = frozenset({cls})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if not isinstance(value, self._cls):
            raise self.stranger(value, place)
        return lower_scalar(value, self, place)

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        if mark_of(wire) == SCALAR:
            scalar = lift_scalar(wire, self, place)
            if isinstance(scalar, self._cls):
                return scalar
        raise self.misfit(wire, place)


class BytesKind(Kind):
    """bytes; and bytearray, which is one object with a life of its own."""

    evident = True

    def __init__(self, cls: type[bytes] | type[bytearray]) -> None:
        self.name = cls.__name__
        self._cls = cls
        self._mark = BYTES if cls is bytes else BYTEARRAY
        self.types = frozenset({cls})
        self.shapes = frozenset({"bytes", BYTES} if cls is bytes else {BYTEARRAY})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not self._cls:
            if type(value) is np.bytes_ and self._cls is bytes:
                return self.lower(bytes(value), walk, place)
            raise self.stranger(value, place)
        if isinstance(value, bytearray):
            again = walk.meet(value, self, place)
            if again is not None:
                return again
            walk.meet_buffer(value, place)
        if len(value) >= walk.inline_size:
            return {self._mark: [len(value), walk.put_aside(memoryview(value), self.name, (len(value),), place)]}
        return bytes(value) if self._cls is bytes else {BYTEARRAY: bytes(value)}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME and self._cls is bytearray:
            return build.again(wire, self, place)
        if self._cls is bytes and type(wire) is bytes:
            return wire
        if mark != self._mark:
            raise self.misfit(wire, place)
        payload = wire[mark]
        if type(payload) is bytes and self._cls is bytearray:
            value: bytes | bytearray = bytearray(payload)
        else:
            value = self._fetched(wire, payload, build, place)
        if self._cls is bytearray:
            build.note_made(value, self, place)
        return value

    def _fetched(self, wire: Wire, payload: Wire, build: Build, place: Place) -> bytes | bytearray:
        if type(payload) is not list or len(payload) != 2 or type(payload[0]) is not int or payload[0] < 0:
            raise self.misfit(wire, place, "not a length and a region")
        return self._cls(build.fetch(payload[1], payload[0], place))


BYTES_KIND, BYTEARRAY_KIND = BytesKind(bytes), BytesKind(bytearray)
ANY_SCALAR = ScalarKind(np.generic)
