"""Moves large arrays of a first value into live memory, where a commit costs the changed pages and not all that they hold.

Only arrays that the state alone holds move, so that no program can notice. An array of which the program has a name, a view or a
weak reference stays where it is, and so does one that the state reaches by two ways. Those are compared at each commit.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from failover.kept_state.state import LIVE_SIZE_MIN

Make = Callable[[str, tuple[int, ...], np.dtype[Any]], NDArray[Any]]

VISITED_MAX: Final = 10_000
"""Containers that are looked into: arrays of a larger state are compared."""

Slots = dict[Any, Any] | list[Any]


def adopt(value: object, make: Make) -> None:
    """Put copies in live memory in the place of arrays in dicts, lists and dataclasses, however they are nested.

    Args:
        make: an array of zeros in live memory, `KeptState.array`.
    """
    alone = _holders({0: np.empty(0)}, 0)
    todo: list[Slots] = [slots for slots in [_slots_of(value)] if slots is not None]
    seen: set[int] = set()
    while todo and len(seen) < VISITED_MAX:
        slots = todo.pop()
        if id(slots) in seen:
            continue
        seen.add(id(slots))
        for key in range(len(slots)) if isinstance(slots, list) else list(slots):
            if _is_movable(slots[key]) and _holders(slots, key) == alone:
                slots[key] = _copied(slots[key], make)
            elif (inner := _slots_of(slots[key])) is not None:
                todo.append(inner)


def _holders(slots: Slots, key: Any) -> int:
    """References to the object there; their number for one holder differs between Pythons."""
    return sys.getrefcount(slots[key])


def _slots_of(value: object) -> Slots | None:
    """Where a value keeps its content, if another object may be put there."""
    if isinstance(value, dict | list) and type(value) in (dict, list):
        return value
    parameters: Any = getattr(type(value), "__dataclass_params__", None)
    slots = getattr(value, "__dict__", None) if parameters is not None and not parameters.frozen else None
    return slots if isinstance(slots, dict) else None


def _is_movable(value: object) -> bool:
    return (
        type(value) is np.ndarray
        and value.nbytes >= LIVE_SIZE_MIN
        and value.flags.owndata
        and value.flags.writeable
        and value.flags.c_contiguous
        and not value.dtype.hasobject
        and not weakref.getweakrefcount(value)
    )


def _copied(value: NDArray[Any], make: Make) -> NDArray[Any]:
    made = make("", value.shape, value.dtype)
    made[...] = value
    return made
