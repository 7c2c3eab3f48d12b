"""Numpy's element types ⇄ wire, by a list of those that are plain memory.

A dtype is stored as text ("<f8"), or as a map for records and subarrays. Text from a wire reaches numpy's own parser only in the
documented form: no objects, no fields that overlap or lie outside, no sizes that overflow.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np

from failover.state.wire import Wire

Dtype = np.dtype[Any]

ITEM_SIZE_MAX = 1 << 20
"""Bytes of one element."""

DIMENSION_COUNT_MAX = 32
"""Of an array; numpy 1 allows no more."""

FIELD_COUNT_MAX = 1024
DTYPE_DEPTH_MAX = 8
"""Fields of a structured element, and how deep they may be nested."""

SIZE_MAX = (1 << 63) - 1

REMEMBERED_MAX = 256
"""Dtypes whose wire values are remembered: a program has a few, and asks at every commit."""

_PLAIN = re.compile(
    r"""[<>|](?:
        b1 | i[1248] | u[1248] | f[248] | c(?:8|16)         # truth values and numbers that every machine has
      | [mM]8(?:\[(?:[1-9]\d{0,8})?(?:Y|M|W|D|h|m|s|ms|us|ns|ps|fs|as)\])?
      | [SUV]\d{1,7}
    )""",
    re.VERBOSE,
)


class DtypeError(ValueError):
    """An element type that is not kept; the message says which and why."""


@lru_cache(maxsize=REMEMBERED_MAX)
def lower_dtype(dtype: Dtype, depth: int = DTYPE_DEPTH_MAX) -> Wire:
    """A dtype as a wire value.

    Raises:
        DtypeError: it is not plain memory, or differs between machines.
    """
    if depth == 0:
        raise DtypeError(f"dtype nested deeper than {DTYPE_DEPTH_MAX}")
    if dtype.hasobject:
        raise DtypeError(f"dtype {dtype} holds Python objects; keep them in a list, or numbers in an array")
    if dtype.itemsize > ITEM_SIZE_MAX:
        raise DtypeError(f"dtype of {dtype.itemsize} bytes an element: more than {ITEM_SIZE_MAX}")
    if dtype.subdtype is not None:
        base, shape = dtype.subdtype
        return {"base": lower_dtype(base, depth - 1), "shape": list(shape)}
    if dtype.names is not None and dtype.fields is not None:
        fields = [dtype.fields[name] for name in dtype.names]
        if any(len(field) > 2 for field in fields):
            raise DtypeError("dtype has titles beside its names; they are not kept, drop them")
        if len(fields) > FIELD_COUNT_MAX:
            raise DtypeError(f"dtype of {len(fields)} fields: more than {FIELD_COUNT_MAX}")
        lowered = {
            "names": list(dtype.names),
            "formats": [lower_dtype(field[0], depth - 1) for field in fields],
            "offsets": [field[1] for field in fields],
            "itemsize": dtype.itemsize,
        }
        _check_layout(dtype.names, [field[0] for field in fields], [field[1] for field in fields], dtype.itemsize)
        return lowered
    text = dtype.str
    if not _PLAIN.fullmatch(text) or np.dtype(text) != dtype:
        raise DtypeError(f"dtype {dtype} is not the same on every machine; convert it, for example to float64")
    return text


def lift_dtype(wire: Wire, depth: int = DTYPE_DEPTH_MAX) -> Dtype:
    """The dtype of a wire value, from any writer.

    Raises:
        DtypeError: not of the documented form; nothing of it was given to numpy.
    """
    if depth == 0:
        raise DtypeError(f"dtype nested deeper than {DTYPE_DEPTH_MAX}")
    if type(wire) is str:
        return _lift_plain(wire)
    if type(wire) is dict and set(wire) == {"base", "shape"}:
        base = lift_dtype(wire["base"], depth - 1)
        shape = checked_shape(wire["shape"])
        _check_item_size(base.itemsize * math.prod(shape))
        return np.dtype((base, shape))
    if type(wire) is dict and set(wire) == {"names", "formats", "offsets", "itemsize"}:
        return _lift_record(wire, depth)
    raise DtypeError("dtype is neither text nor a record of names, formats, offsets and itemsize")


def _lift_plain(text: str) -> Dtype:
    if not _PLAIN.fullmatch(text):
        raise DtypeError(f"dtype {text[:40]!r} is not one of those that are kept")
    width = re.match(r"..(\d+)", text)
    assert width is not None, text
    _check_item_size(int(width.group(1)) * (4 if text[1] == "U" else 1))
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError) as error:
        raise DtypeError(f"dtype {text!r}: {error}") from error
    if dtype.str != text:
        raise DtypeError(f"dtype {text!r} is spelled {dtype.str!r}")
    return dtype


def _lift_record(wire: Wire, depth: int) -> Dtype:
    names, formats, offsets, itemsize = (wire[part] for part in ("names", "formats", "offsets", "itemsize"))
    lists = (names, formats, offsets)
    if not all(type(part) is list for part in lists) or len({len(part) for part in lists}) != 1 or len(names) > FIELD_COUNT_MAX:
        raise DtypeError(f"dtype's names, formats and offsets are not lists of one length up to {FIELD_COUNT_MAX}")
    if not all(type(name) is str for name in names) or not all(type(number) is int for number in (*offsets, itemsize)):
        raise DtypeError("dtype's names are not text, or its offsets and itemsize not integers")
    _check_item_size(itemsize)
    lifted = [lift_dtype(inner, depth - 1) for inner in formats]
    _check_layout(names, lifted, offsets, itemsize)
    try:
        return np.dtype({"names": names, "formats": lifted, "offsets": offsets, "itemsize": itemsize})
    except (TypeError, ValueError) as error:
        raise DtypeError(f"dtype: {error}") from error


def _check_item_size(size: int) -> None:
    if not 0 <= size <= ITEM_SIZE_MAX:
        raise DtypeError(f"dtype of {size} bytes an element: not from 0 to {ITEM_SIZE_MAX}")


def _check_layout(names: Any, formats: list[Dtype], offsets: list[int], itemsize: int) -> None:
    """Fields have names of their own, lie inside the element, and not over one another."""
    if len(set(names)) != len(names) or "" in names:
        raise DtypeError("dtype has two fields of one name, or one without")
    end = 0
    for offset, dtype, name in sorted(zip(offsets, formats, names, strict=True), key=lambda field: (field[0], field[1].itemsize)):
        if offset < end or offset + dtype.itemsize > itemsize:
            raise DtypeError(f"dtype's field {str(name)[:40]!r} overlaps another one or lies outside of the element")
        end = offset + dtype.itemsize


def checked_shape(wire: Wire) -> tuple[int, ...]:
    """A shape, checked without numpy: no negative lengths, and no product that overflows even without its zeros.

    Raises:
        DtypeError: says which.
    """
    if type(wire) is not list or len(wire) > DIMENSION_COUNT_MAX or not all(type(length) is int for length in wire):
        raise DtypeError(f"its shape is not a list of at most {DIMENSION_COUNT_MAX} integers")
    if any(length < 0 for length in wire) or math.prod(length or 1 for length in wire) > SIZE_MAX:
        raise DtypeError(f"its shape {tuple(wire)} has a negative length or overflows")
    return tuple(wire)
