"""Kinds of random number generators: Python's and numpy's, kept as the numbers that determine the next draws.

Nothing on the wire names anything but one of numpy's own bit generators. Every number is checked against the table below: some
of them are places in an array, and numpy's C code would follow them anywhere.
"""

from __future__ import annotations

import random
import sys
from typing import Any, Final, TypeAlias

import numpy as np

from failover.errors import FitError, KeepError
from failover.state.kinds import Build, Kind, Walk
from failover.state.numbers import INT
from failover.state.wire import SAME, Place, Wire, mark_of, text_of

RANDOM, GENERATOR = "$random", "$generator"

# random.Random

STATE_WORDS: Final = 625
"""Numbers of 32 bits in the state of a Mersenne twister: 624 words, and the place in them."""
STATE_VERSION: Final = 3
"""Of ``random.Random.getstate``; the same since Python 3.2."""


class RandomKind(Kind):
    """random.Random."""

    name = "Random"
    types = frozenset({random.Random})
    shapes = frozenset({RANDOM})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not random.Random:
            raise self.stranger(value, place)
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        _, words, second = value.getstate()
        return {RANDOM: [np.array(words, "<u4").tobytes(), second]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        parts = wire[RANDOM] if mark == RANDOM else None
        if type(parts) is not list or len(parts) != 2 or not (parts[1] is None or type(parts[1]) is float):
            raise self.misfit(wire, place)
        if type(parts[0]) is not bytes or len(parts[0]) != 4 * STATE_WORDS:
            raise self.misfit(wire, place, f"not {STATE_WORDS} words")
        value = random.Random(0)
        try:
            value.setstate((STATE_VERSION, tuple(np.frombuffer(parts[0], "<u4").tolist()), parts[1]))
        except ValueError as error:
            raise self.misfit(wire, place, str(error)) from error
        build.note_made(value, self, place)
        return value


# numpy.random.Generator

Form: TypeAlias = "int | tuple[str, int]"
"""The greatest that a number may be, or dtype and count of an array."""

_HALF: Final[dict[str, Form]] = {"has_uint32": 1, "uinteger": (1 << 32) - 1}
"""The half of a 64-bit draw that is left over."""
_PCG: Final[dict[str, Form]] = {"state.state": (1 << 128) - 1, "state.inc": (1 << 128) - 1, **_HALF}
FORMS: Final[dict[str, dict[str, Form]]] = {
    "PCG64": _PCG,
    "PCG64DXSM": _PCG,
    "MT19937": {"state.key": ("<u4", 624), "state.pos": 624},
    "Philox": {"state.counter": ("<u8", 4), "state.key": ("<u8", 2), "buffer": ("<u8", 4), "buffer_pos": 4, **_HALF},
    "SFC64": {"state.state": ("<u8", 4), **_HALF},
}
"""Of each bit generator that is kept: the items of its ``state``, by the way to each."""


class GeneratorKind(Kind):
    """numpy.random.Generator over one of numpy's own bit generators. Their library is loaded when a program has loaded it."""

    name = "Generator"
    shapes = frozenset({GENERATOR})

    def __init__(self) -> None:
        loaded = sys.modules.get("numpy.random")
        self.types = frozenset({loaded.Generator}) if loaded else frozenset()

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) not in self.types:
            raise self.stranger(value, place)
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        source = value.bit_generator
        shared = walk.meet(source, self, place)
        if shared is not None:
            where = text_of(place)
            raise KeepError(
                f"cannot keep {where}: it draws from the bit generator of another one, {shared[SAME]}; keep one", where
            )
        forms = FORMS.get(type(source).__name__) if type(source).__module__.startswith("numpy.random.") else None
        if forms is None:
            raise self.stranger(value, place, f"over a {type(source).__name__}; numpy's own are {', '.join(FORMS)}")
        parts = [_lower_part(_at(source.state, way), form, walk, place) for way, form in forms.items()]
        return {GENERATOR: [type(source).__name__, parts]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        stored = wire[GENERATOR] if mark == GENERATOR else None
        if type(stored) is not list or len(stored) != 2 or type(stored[0]) is not str:
            raise self.misfit(wire, place)
        forms, parts = FORMS.get(stored[0]), stored[1]
        if forms is None or type(parts) is not list or len(parts) != len(forms):
            raise self.misfit(wire, place, f"over {stored[0][:40]!r}; known are {', '.join(FORMS)}")
        state: dict[str, Any] = {"bit_generator": stored[0], "state": {}}
        for (way, form), part in zip(forms.items(), parts, strict=True):
            inner, _, key = way.rpartition(".")
            (state[inner] if inner else state)[key] = self._lift_part(part, form, build, place)
        value = _generator(stored[0], state)
        build.note_made(value, self, place)
        return value

    def _lift_part(self, part: Wire, form: Form, build: Build, place: Place) -> Any:
        if isinstance(form, tuple):
            dtype, count = form
            if type(part) is not bytes or len(part) != count * np.dtype(dtype).itemsize:
                raise self.misfit(part, place, f"not {count} words")
            return np.frombuffer(part, dtype).astype(np.dtype(dtype).newbyteorder("="))
        try:
            number = INT.lift(part, build, place)
        except FitError as error:
            raise self.misfit(part, place, "not a number") from error
        if type(number) is not int or not 0 <= number <= form:
            raise self.misfit(part, place, f"not a number from 0 to {form}")
        return number


def _at(state: Any, way: str) -> Any:
    for key in way.split("."):
        state = state[key]
    return state


def _lower_part(part: Any, form: Form, walk: Walk, place: Place) -> Wire:
    if isinstance(form, tuple):
        return np.asarray(part, form[0]).tobytes()
    return INT.lower(int(part), walk, place)


def _generator(name: str, state: dict[str, Any]) -> Any:
    """A generator that draws next what the state says."""
    from numpy import random as numpy_random  # 50 ms: only a program that has such a generator pays for it

    source = getattr(numpy_random, name)(0)
    source.state = state
    return numpy_random.Generator(source)
