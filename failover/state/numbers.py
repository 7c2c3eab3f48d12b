"""Kinds of numbers and text: values that a wire holds as they are, and values just beyond those.

A number's place takes any number that Python takes there: an integer where a float is declared (``x: float = 0``), a truth
value where an integer is, and the scalars that numpy's arithmetic leaves behind (``pose.x = readings.mean()``). Each comes
back as exactly the value that it was.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from failover.state import arrays
from failover.state.kinds import Build, Kind, Walk
from failover.state.wire import INT_BITS_MAX, INT_MAX, INT_MIN, Place, Wire, mark_of

BIG_INT, COMPLEX_MARK, ODD_TEXT = "$int", "$complex", "$str"


class NoneKind(Kind):
    """Nothing but None."""

    name = "None"
    types = exact = frozenset({type(None)})
    shapes = frozenset({"NoneType"})
    evident = True

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if value is not None:
            raise self.stranger(value, place)
        return None

    def lift(self, wire: Wire, build: Build, place: Place) -> None:
        if wire is not None:
            raise self.misfit(wire, place)


class NumberKind(Kind):
    """bool, int, float or complex, and the narrower numbers that stand in for them."""

    evident = True

    def __init__(self, name: str, plain: tuple[type, ...], scalar: tuple[type, ...]) -> None:
        """``plain``: Python's own types; ``scalar``: numpy's, by their base classes."""
        self.name = name
        self._plain = frozenset(plain)
        self._scalar = scalar
        self.exact = frozenset(plain) - {int, complex}
        self.types = frozenset(plain)
        marks = {arrays.SCALAR} | ({BIG_INT} if int in plain else set()) | ({COMPLEX_MARK} if complex in plain else set())
        self.shapes = frozenset({kind.__name__ for kind in plain if kind is not complex} | marks)

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        kind = type(value)
        if kind in self._plain:
            if kind is int and not INT_MIN <= value <= INT_MAX:
                return lower_int(value, self, place)
            return {COMPLEX_MARK: [value.real, value.imag]} if kind is complex else value
        if isinstance(value, self._scalar):
            return arrays.lower_scalar(value, self, place)
        raise self.stranger(value, place)

    def are_wires(self, values: Iterable[Any]) -> bool:
        kinds = set(map(type, values))
        if kinds <= self.exact:
            return True
        return kinds == {int} and int in self._plain and min(values) >= INT_MIN and max(values) <= INT_MAX

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        kind = type(wire)
        if kind in self._plain and kind is not complex:
            return wire
        mark = mark_of(wire)
        if mark == BIG_INT and int in self._plain:
            return lift_int(wire, self, place)
        if mark == arrays.SCALAR:
            scalar = arrays.lift_scalar(wire, self, place)
            if isinstance(scalar, self._scalar):
                return scalar
        if mark == COMPLEX_MARK and complex in self._plain:
            return self._lift_complex(wire, place)
        raise self.misfit(wire, place)

    def _lift_complex(self, wire: Wire, place: Place) -> complex:
        parts = wire[COMPLEX_MARK]
        if type(parts) is not list or len(parts) != 2 or not all(type(part) is float for part in parts):
            raise self.misfit(wire, place, "not two floats")
        return complex(*parts)


def lower_int(value: int, kind: Kind, place: Place) -> Wire:
    """An integer beyond 64 bits: little-endian two's complement."""
    if value.bit_length() >= INT_BITS_MAX:
        raise kind.stranger(value, place, f"integers of {INT_BITS_MAX} bits and more are kept as bytes or an array")
    return {BIG_INT: value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)}


def lift_int(wire: Wire, kind: Kind, place: Place) -> int:
    """The integer, if those bytes are how we would have written it."""
    packed = wire[BIG_INT]
    if type(packed) is not bytes or len(packed) > INT_BITS_MAX // 8:
        raise kind.misfit(wire, place, f"not at most {INT_BITS_MAX // 8} bytes")
    value = int.from_bytes(packed, "little", signed=True)
    if INT_MIN <= value <= INT_MAX or value.bit_length() // 8 + 1 != len(packed):
        raise kind.misfit(wire, place, "not in its shortest form")
    return value


class TextKind(Kind):
    """str, also with lone surrogates, as names of files have them."""

    name = "str"
    keeps_text = True
    types = frozenset({str})
    shapes = frozenset({"str", ODD_TEXT, arrays.SCALAR})
    evident = True

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not str:
            if type(value) is np.str_:
                return arrays.lower_scalar(value, self, place)
            raise self.stranger(value, place)
        return value if value.isascii() else lower_text(value)

    def are_wires(self, values: Iterable[Any]) -> bool:
        return set(map(type, values)) <= self.types and all(map(str.isascii, values))

    def lift(self, wire: Wire, build: Build, place: Place) -> str:
        if type(wire) is str:
            return wire
        mark = mark_of(wire)
        if mark == ODD_TEXT and type(wire[ODD_TEXT]) is bytes:
            return lift_text(wire[ODD_TEXT], self, place)
        if mark == arrays.SCALAR:
            scalar = arrays.lift_scalar(wire, self, place)
            if isinstance(scalar, np.str_):
                return scalar
        raise self.misfit(wire, place)


def lower_text(value: str) -> Wire:
    """Text as it is, or as bytes where it is no valid Unicode."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return {ODD_TEXT: value.encode(errors="surrogatepass")}
    return value


def lift_text(packed: bytes, kind: Kind, place: Place) -> str:
    """The text that ``lower_text`` could not leave as it is."""
    try:
        return packed.decode(errors="surrogatepass")
    except UnicodeDecodeError as error:
        raise kind.misfit(packed, place, f"not text: {error}") from error


NONE = NoneKind()
BOOL = NumberKind("bool", (bool,), (np.bool_,))
INT = NumberKind("int", (bool, int), (np.bool_, np.integer))
FLOAT = NumberKind("float", (bool, int, float), (np.bool_, np.integer, np.floating))
COMPLEX = NumberKind("complex", (bool, int, float, complex), (np.bool_, np.number))
TEXT = TextKind()
