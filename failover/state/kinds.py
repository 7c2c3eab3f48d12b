"""The contract of a kind: how values of one declared type become wire values and come back.

A schema is compiled once into a tree of kinds; a commit then only walks it. Nothing in a kind changes once the schema is made.

Lowering (value → wire) visits every mutable object once: a second way to it is stored as such (``$same`` and the place of the
first), so an object that is reached by two paths is one object again after a resume, cycles included; a plain copy would have
been two, silently. Immutable values may be split: no program can tell.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from msgspec import Struct

from failover.errors import FitError, KeepError
from failover.state.wire import (
    DATA_SIZE_MAX,
    DEPTH_MAX,
    NAME_SIZE_MAX,
    REGION_COUNT_MAX,
    SAME,
    Place,
    Wire,
    path_of,
    said,
    text_of,
)

Allocate = Callable[[str, tuple[int, ...], "np.dtype[Any]"], "np.ndarray[Any, Any]"]
"""Makes the array of a place (name, shape, dtype) that a state is read into: C order, writable."""


class Kind(ABC):
    """Values of one declared type.

    Attributes:
        name: the type as a person would declare it.
        types: what ``type(value)`` may be; a union chooses by it.
        exact: those of ``types`` whose values are their own wire values and need no look.
        shapes: the looks of its wire values: names of Python types, "record", marks. Kinds of one union that share a shape
            are told apart by a label, unless both are evident.
        keeps_text: any text is its own wire value, as far as a wire can hold it.
        evident: the wire alone says what the value is, regardless of the declaration: two such kinds never make different values
            of one wire.
    """

    name: str = ""
    types: frozenset[type] = frozenset()
    exact: frozenset[type] = frozenset()
    shapes: frozenset[str] = frozenset()
    evident = False
    keeps_text = False

    @abstractmethod
    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        """The wire value of a value.

        Raises:
            KeepError: it is not of the declared type, or cannot be kept; names the place.
        """

    @abstractmethod
    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        """The value of a wire value, from any writer.

        Raises:
            FitError: it is not of the declared type; names the place.
        """

    def are_wires(self, values: Iterable[Any]) -> bool:
        """Whether all of these are their own wire values: much faster to ask at once than one by one."""
        return self.exact.issuperset(map(type, values))

    def parts(self) -> tuple[Kind, ...]:
        """The kinds inside, for a description."""
        return ()

    def description(self) -> str:
        """The type in words that do not depend on the Python or numpy version."""
        return self.name

    def stranger(self, value: object, place: Place, cure: str = "") -> KeepError:
        """The refusal of a value that is not of the declared type."""
        where = text_of(place)
        cure = cure or "assign a value of the declared type, or change the declaration"
        return KeepError(
            f"cannot keep {where}: it holds {with_article(type(value).__name__)}, declared {self.name}; {cure}", where
        )

    def misfit(self, wire: Wire, place: Place, why: str = "") -> FitError:
        """The refusal of a stored value that is not of the declared type."""
        where = text_of(place)
        return FitError(f"{where}: stored as {said(wire)}, wanted {self.name}{f' ({why})' if why else ''}; {FIT_CURE}", where)


FIT_CURE = "give the schema a higher version and a migration, or declare it as it was stored"


def with_article(name: str) -> str:
    """A name of a class as it is said."""
    return f"{'an' if name[:1] in 'aeiouAEIOU' else 'a'} {name}"


class Region(Struct, frozen=True):
    """An array or a long run of bytes that is stored out of line.

    Attributes:
        name: its place in the state: "mapper.grid".
        memory: its bytes, flat. When encoding: borrowed from the program's own object where that is contiguous, so it is valid
            until the program writes to it next; let go of it before the program goes on.
        dtype, shape: for people; ``bytes`` and the length for bytes. Reading needs neither.
    """

    name: str
    memory: memoryview
    dtype: str = ""
    shape: tuple[int, ...] = ()


class Walk:
    """One lowering: whom it met and which regions it found."""

    __slots__ = ("_arrays", "_memories", "inline_size", "met", "regions")

    def __init__(self, inline_size: int) -> None:
        self.inline_size = inline_size
        self.met: dict[int, tuple[object, Kind, Place]] = {}
        self.regions: list[Region] = []
        self._arrays: list[tuple[np.ndarray[Any, Any], Place]] = []
        self._memories: dict[int, list[int]] = {}

    def meet(self, value: object, kind: Kind, place: Place) -> Wire:
        """Note a mutable object; the wire value to store instead when it was met before, else None.

        Raises:
            KeepError: nested too deep, or declared differently at its two places.
        """
        first = self.met.get(id(value))
        if first is None:
            self.descend(place)
            self.met[id(value)] = (value, kind, place)
            return None
        if first[1] is not kind:
            where = text_of(place)
            there = f"{text_of(first[2])}, declared {kind.name} here and {first[1].name} there"
            raise KeepError(f"cannot keep {where}: it is the same object as {there}; declare both alike, or assign a copy", where)
        return {SAME: path_of(first[2])}

    def descend(self, place: Place) -> None:
        """Refuse what is nested too deep.

        Raises:
            KeepError: names the place.
        """
        if place[2] > DEPTH_MAX:
            where = text_of(place)
            raise KeepError(
                f"cannot keep {where[:NAME_SIZE_MAX]}: nested deeper than {DEPTH_MAX}; keep a flat list and indices", where
            )

    def put_aside(self, memory: memoryview, dtype: str, shape: tuple[int, ...], place: Place) -> str:
        """Store bytes out of line; the name of their region.

        Raises:
            KeepError: too many regions, or too long a name.
        """
        name = text_of(place)
        if len(name.encode(errors="surrogatepass")) > NAME_SIZE_MAX:
            raise KeepError(
                f"cannot keep {name[:80]}…: its name is longer than {NAME_SIZE_MAX} bytes; keep it at a shorter path", name
            )
        if len(self.regions) == REGION_COUNT_MAX:
            message = f"cannot keep {name}: more than {REGION_COUNT_MAX} arrays of {self.inline_size} bytes and more"
            raise KeepError(f"{message}; join them to one array", name)
        self.regions.append(Region(name, memory, dtype, shape))
        return name

    def meet_array(self, array: np.ndarray[Any, Any], place: Place) -> None:
        """Note an array; two that share memory would come back as two that do not.

        Raises:
            KeepError: it shares memory with another one; names both places.
        """
        owner: Any = array
        while isinstance(owner, np.ndarray) and owner.base is not None:
            owner = owner.base
        if isinstance(owner, memoryview):
            owner = owner.obj
        if owner is not array and id(owner) in self.met:
            raise _overlap(place, self.met[id(owner)][2])
        neighbours = self._memories.setdefault(id(owner), [])
        for index in neighbours:
            if index < len(self._arrays) and _shares_memory(array, self._arrays[index][0]):
                raise _overlap(place, self._arrays[index][1])
        neighbours.append(len(self._arrays))
        self._arrays.append((array, place))

    def meet_buffer(self, value: bytearray | array[Any], place: Place) -> None:
        """Note bytes that an array may lie over.

        Raises:
            KeepError: one does; names both places.
        """
        for index in self._memories.get(id(value), ()):
            if index < len(self._arrays):
                raise _overlap(place, self._arrays[index][1])

    def mark(self) -> tuple[int, int, int]:
        """How far it has come, for ``back_to``."""
        return len(self.met), len(self.regions), len(self._arrays)

    def back_to(self, mark: tuple[int, int, int]) -> None:
        """Forget everything since ``mark``: the kind that was tried does not fit."""
        met, regions, arrays = mark
        while len(self.met) > met:
            self.met.popitem()
        del self.regions[regions:]
        del self._arrays[arrays:]


OVERLAP_WORK_MAX = 1000
"""How long numpy may think about whether two views overlap; beyond it they count as overlapping."""


def _overlap(place: Place, other: Place) -> KeepError:
    """The refusal of a second array over the same memory."""
    where = text_of(place)
    message = f"cannot keep {where}: it shares memory with {text_of(other)} (one is a view of the other)"
    return KeepError(f"{message}; keep one of them and make the other a property, or assign a copy", where)


def _shares_memory(left: np.ndarray[Any, Any], right: np.ndarray[Any, Any]) -> bool:
    try:
        return np.shares_memory(left, right, max_work=OVERLAP_WORK_MAX)  # type: ignore[arg-type] # any bound is allowed
    except np.exceptions.TooHardError:
        return True


class Build:
    """One lifting: the regions, and the objects that were made already."""

    __slots__ = ("_left", "_shared", "allocate", "made", "notes")

    def __init__(self, regions: Mapping[str, memoryview], allocate: Allocate, shared: bool) -> None:
        """``shared``: whether the state holds second ways to objects, so that it matters where each one was made."""
        self._left = dict(regions)
        self._shared = shared
        self.allocate = allocate
        self.made: dict[str, tuple[object, Kind]] = {}
        self.notes: dict[str, str] = {}

    def note(self, subject: str, text: str) -> None:
        """Remember a sentence for a person; once a subject, however often it occurs."""
        self.notes.setdefault(subject, text)

    def note_made(self, value: object, kind: Kind, place: Place) -> None:
        """A mutable object exists now, perhaps still empty.

        Raises:
            FitError: nested too deep.
        """
        self.descend(place)
        if self._shared:
            self.made[path_of(place)] = (value, kind)

    def descend(self, place: Place) -> None:
        """Refuse what is nested too deep.

        Raises:
            FitError: names the place.
        """
        if place[2] > DEPTH_MAX:
            where = text_of(place)[:NAME_SIZE_MAX]
            raise FitError(f"{where}: stored nested deeper than {DEPTH_MAX}; no state of ours is", where)

    def again(self, wire: Wire, kind: Kind, place: Place) -> Any:
        """The object of a second way to it, which ``wire`` is.

        Raises:
            FitError: there is no such object, or it is of another kind.
        """
        where, path = text_of(place), wire[SAME]
        made = self.made.get(path) if isinstance(path, str) else None
        there = f"{where.removesuffix(path_of(place))}{path}"[:NAME_SIZE_MAX]
        if made is None:
            message = f"{where}: stored as the same object as {there}, which is not part of the state any more"
            raise FitError(f"{message}; {FIT_CURE}", where)
        if made[1] is not kind:
            raise FitError(
                f"{where}: stored as the same object as {there}, which is {made[1].name}, wanted {kind.name}; {FIT_CURE}", where
            )
        return made[0]

    def fetch(self, name: object, size: int, place: Place) -> memoryview:
        """The bytes of a region; each may be used once, so that a small state cannot ask for much memory.

        Raises:
            FitError: no such region, or not of that size.
        """
        where = text_of(place)
        memory = self._left.pop(name, None) if isinstance(name, str) else None
        if memory is None:
            raise FitError(
                f"{where}: stored in region {str(name)[:NAME_SIZE_MAX]!r}, which is missing or used twice: the state is damaged",
                where,
            )
        if memory.nbytes < size:
            raise FitError(
                f"{where}: its region {name!r} holds {memory.nbytes} bytes, wanted {size}: the state is damaged", where
            )
        return memory.cast("B")[:size]


def refuse_size(size: int, name: str) -> None:
    """Refuse a state that is too large besides its regions.

    Raises:
        KeepError: says what to do.
    """
    if size > DATA_SIZE_MAX:
        message = f"cannot keep {name}: {size} bytes besides its arrays are more than {DATA_SIZE_MAX}"
        raise KeepError(f"{message}; keep long lists as numpy arrays or bytes", name)
