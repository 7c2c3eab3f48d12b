"""The kind of array.array: numbers of one C type, one mutable object, like a bytearray."""

from __future__ import annotations

from array import array
from typing import Any, Final

from failover.state.kinds import Build, Kind, Walk
from failover.state.wire import SAME, Place, Wire, mark_of

NUMBERS: Final = "$numbers"

CODES: Final = {code: array(code).itemsize for code in "bBhHiIlLqQfd"}
"""Types that are numbers, and their sizes here; "u" is text, and another size on other machines."""


class NumbersKind(Kind):
    """array.array of numbers; stored as type, bytes of one number, and content or [length, region]."""

    name = "array.array"
    types = frozenset({array})
    shapes = frozenset({NUMBERS})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not array:
            raise self.stranger(value, place)
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        walk.meet_buffer(value, place)
        if value.typecode not in CODES:
            raise self.stranger(value, place, f"of type {value.typecode!r}, which is no number; keep a str")
        size = len(value) * value.itemsize
        content: Wire = value.tobytes() if size < walk.inline_size else None
        if content is None:
            memory = memoryview(value).cast("B")
            content = [size, walk.put_aside(memory, value.typecode, (len(value),), place)]
        return {NUMBERS: [value.typecode, value.itemsize, content]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        parts = wire[NUMBERS] if mark == NUMBERS else None
        if type(parts) is not list or len(parts) != 3 or type(parts[0]) is not str or parts[0] not in CODES:
            raise self.misfit(wire, place)
        if parts[1] != CODES[parts[0]]:
            raise self.misfit(wire, place, f"of {parts[1]} bytes a number, on this machine {CODES[parts[0]]}")
        content = parts[2]
        if type(content) is list and len(content) == 2 and type(content[0]) is int and content[0] >= 0:
            content = build.fetch(content[1], content[0], place)
        elif type(content) is not bytes:
            raise self.misfit(wire, place, "not its content or a length and a region")
        if len(content) % parts[1]:
            raise self.misfit(wire, place, f"{len(content)} bytes, no whole numbers")
        value = array(parts[0])
        value.frombytes(content)
        build.note_made(value, self, place)
        return value
