"""Stored form of a kept state, and the names of places in it.

A stored state is msgpack of a *wire* value: None, a bool, an integer of 64 bits, a float, text, bytes, a list, a map with text
keys that are the fields of a record, or a *marked* value: a map of one entry whose key starts with "$" and says what kind its
payload is ("$datetime", "$array" …). The marks are a closed list of built-in kinds: no name on the wire is ever looked up as a
class, so a stored state describes itself and still can build only classes that the program declares.
"""

from __future__ import annotations

import re
from typing import Any, TypeAlias

Wire: TypeAlias = Any
"""None | bool | int | float | str | bytes | list[Wire] | dict[str, Wire]."""

FORMAT = "failover.state/1"
"""First element of every stored state: its kind, and the version of the wire format."""

INLINE_SIZE_MAX = 4096
"""Bytes. Arrays and bytes of this size and more lie in regions of their own, so that they travel as changed pages."""

DATA_SIZE_MAX = 64 << 20
"""Bytes of a state besides its regions; reading it takes up to about 64 times as much memory (an empty list is one byte)."""

REGION_COUNT_MAX = 1023
"""Regions of one state: as many as a segment has room for beside the state itself."""

DEPTH_MAX = 100
"""How deep a state may be nested; far from the recursion limit of Python, also inside a program's own calls."""

NAME_SIZE_MAX = 224
"""Bytes of the name of a region: as many as a segment has room for."""

KEY_TEXT_MAX = 40
"""Characters of a dictionary's key in the name of a place."""

INT_MIN, INT_MAX = -(1 << 63), (1 << 64) - 1
"""The integers that msgpack holds; others are stored as bytes."""

INT_BITS_MAX = 1 << 20
"""An integer beyond this is a mistake or an attack: printing one takes quadratic time."""

SAME = "$same"
"""Mark of a second way to an object that is stored elsewhere; the payload is the path of that place."""


class Key:
    """A step into a dictionary, as it is shown between brackets."""

    __slots__ = ("text",)

    def __init__(self, text: str) -> None:
        self.text = text


def entry_step(key: object, index: int) -> Key:
    """The step to the value of an entry: its key, or its place in the order of entries (``#3``) if the key is not a plain one."""
    return Key(_key_text(key, index) if type(key) in _PLAIN_KEYS else f"#{index}")


def key_step(index: int) -> Key:
    """The step to the key itself of an entry."""
    return Key(f"key #{index}")


_PLAIN_KEYS = frozenset({str, int, bool, type(None)})


def _key_text(key: object, index: int) -> str:
    """Short, and no two keys of one dictionary have the same."""
    text = hex(key) if isinstance(key, int) and key.bit_length() > 128 else repr(key)
    return text if len(text) <= KEY_TEXT_MAX else f"{text[:KEY_TEXT_MAX]}…#{index}"


Place: TypeAlias = tuple[Any, Any, int]
"""Where in a state: (place above or None, step, depth). A step is a field's name, an index, or a ``Key``. Cheap to make;
``text_of`` shows it."""


def root_place(name: str) -> Place:
    """The place of a whole state."""
    return (None, name, 0)


def text_of(place: Place) -> str:
    """A place as a program would write it: ``mapper.tiles['a'][3].image``."""
    name, path = _name_and_path(place)
    return name + path


def path_of(place: Place) -> str:
    """A place without the name of the state, which may be another one elsewhere: ``.tiles['a'][3].image``."""
    return _name_and_path(place)[1]


def _name_and_path(place: Place) -> tuple[str, str]:
    steps: list[str] = []
    at = place
    while True:
        above, step, _ = at
        if above is None:
            return step, "".join(reversed(steps))
        if isinstance(step, str):
            steps.append(f".{step}")
        else:
            steps.append(f"[{step.text if isinstance(step, Key) else step}]")
        at = above


_MARK = re.compile(r"\$[a-z]")


def mark_of(wire: Wire) -> str | None:
    """The mark of a marked value; None for everything else."""
    if type(wire) is dict and len(wire) == 1:
        (key,) = wire
        if type(key) is str and _MARK.match(key):
            return key
    return None


def said(wire: Wire) -> str:
    """A description of a stored value, in a few words of a message: ``str 'north'``, ``a list of 3``, ``a record (x, y)``."""
    if wire is None:
        return "None"
    if isinstance(wire, bool | int | float | str | bytes):
        text = f"{len(wire)} bytes" if isinstance(wire, bytes) else _shortened(wire)
        return f"{type(wire).__name__} {text}"
    if isinstance(wire, list):
        return f"a list of {len(wire)}"
    mark = mark_of(wire)
    if mark is not None:
        return "another way to an object" if mark == SAME else f"{'an' if mark[1] in 'aeiou' else 'a'} {mark[1:]}"
    if isinstance(wire, dict):
        names = [str(name)[:KEY_TEXT_MAX] for name in list(wire)[:5]]
        return f"a record ({', '.join(names)}{', …' if len(wire) > 5 else ''})"
    return f"an unknown {type(wire).__name__}"


def _shortened(value: object) -> str:
    text = repr(value)
    return text if len(text) <= KEY_TEXT_MAX else f"{text[:KEY_TEXT_MAX]}…"
