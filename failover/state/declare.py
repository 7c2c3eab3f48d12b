"""Marks that a declaration can carry besides a type: a former name, pickle.

class Pose:
    heading: Annotated[float, Formerly("theta")] = 0.0     # was stored as theta
    solver: Annotated[Solver, Pickled()] = Solver()        # runs code when it is read: see `failover.state.pickled`
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, Final

from msgspec import Struct


class _Missing(Enum):
    MISSING = "MISSING"

    def __repr__(self) -> str:
        return self.value


MISSING: Final = _Missing.MISSING
"""No default was declared, or no annotation."""


class Formerly:
    """In ``Annotated``: names under which the field was stored before it was renamed."""

    def __init__(self, *names: str) -> None:
        self.names = names


class Pickled:
    """In ``Annotated``: this one value is stored by pickle."""


class Field(Struct, frozen=True, dict=True):
    """One kept field of a component.

    Attributes:
        annotation: its type; MISSING: that of its default.
        default: its first value, copied for each use; MISSING: it must be stored, or made by ``factory``.
        factory: makes its first value.
        dtype, shape: of an array that keeps its form: zeros at first.
        formerly: names under which it was stored before.
        pickled: stored by pickle; a person who can write the stored state can then run code in the program.
    """

    annotation: Any = MISSING
    default: Any = MISSING
    factory: Callable[[], Any] | None = None
    dtype: Any = None
    shape: tuple[int, ...] | None = None
    formerly: tuple[str, ...] = ()
    pickled: bool = False
