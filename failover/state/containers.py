"""Kinds of containers: list, deque, tuple, set, frozenset, dict and its relatives.

Mutable ones are noted before their contents, so that a way back to them (a cycle) finds them. Where every element is its own
wire value, the encoder gets the container as it is.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

from failover.state.kinds import Build, Kind, Walk
from failover.state.numbers import lower_text
from failover.state.wire import SAME, Place, Wire, entry_step, key_step, mark_of

TUPLE, SET, FROZENSET, DEQUE, MAP, DICT = "$tuple", "$set", "$frozenset", "$deque", "$map", "$dict"


def _lower_all(values: Any, element: Kind, walk: Walk, place: Place) -> list[Wire]:
    """Every element's wire value."""
    if element.are_wires(values):
        return values if type(values) is list else list(values)
    depth = place[2] + 1
    return [element.lower(value, walk, (place, index, depth)) for index, value in enumerate(values)]


def _lift_all(wire: list[Wire], element: Kind, build: Build, place: Place) -> list[Any]:
    depth = place[2] + 1
    return [element.lift(inner, build, (place, index, depth)) for index, inner in enumerate(wire)]


class ListKind(Kind):
    """list."""

    types = frozenset({list})
    shapes = frozenset({"list"})

    def __init__(self, element: Kind) -> None:
        self.name = f"list[{element.name}]"
        self._element = element

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not list:
            raise self.stranger(value, place)
        return walk.meet(value, self, place) or _lower_all(value, self._element, walk, place)

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        stored = wire[TUPLE] if mark == TUPLE else wire
        if type(stored) is not list:
            raise self.misfit(wire, place)
        value: list[Any] = []
        build.note_made(value, self, place)
        value.extend(_lift_all(stored, self._element, build, place))
        return value

    def parts(self) -> tuple[Kind, ...]:
        return (self._element,)


class DequeKind(Kind):
    """collections.deque, its bound included."""

    types = frozenset({deque})
    shapes = frozenset({DEQUE})

    def __init__(self, element: Kind) -> None:
        self.name = f"deque[{element.name}]"
        self._element = element

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not deque:
            raise self.stranger(value, place)
        return walk.meet(value, self, place) or {DEQUE: [value.maxlen, _lower_all(value, self._element, walk, place)]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        bound, stored = wire[DEQUE] if mark == DEQUE and type(wire[DEQUE]) is list and len(wire[DEQUE]) == 2 else (-1, None)
        if type(stored) is not list or not (bound is None or (type(bound) is int and len(stored) <= bound <= (1 << 63) - 1)):
            raise self.misfit(wire, place)
        value: deque[Any] = deque(maxlen=bound)
        build.note_made(value, self, place)
        value.extend(_lift_all(stored, self._element, build, place))
        return value

    def parts(self) -> tuple[Kind, ...]:
        return (self._element,)


class TupleKind(Kind):
    """tuple, of one element type and any length or of one type a place."""

    types = frozenset({tuple})
    shapes = frozenset({TUPLE})

    def __init__(self, elements: tuple[Kind, ...], endless: bool) -> None:
        """``endless``: the one element kind is that of every place."""
        self.name = f"tuple[{', '.join(kind.name for kind in elements) or '()'}{', ...' if endless else ''}]"
        self._elements = elements
        self._endless = endless

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not tuple:
            raise self.stranger(value, place)
        walk.descend(place)
        if self._endless:
            return {TUPLE: _lower_all(value, self._elements[0], walk, place)}
        if len(value) != len(self._elements):
            raise self.stranger(value, place, f"it has {len(value)} elements")
        depth = place[2] + 1
        pairs = enumerate(zip(value, self._elements, strict=True))
        return {TUPLE: [kind.lower(inner, walk, (place, index, depth)) for index, (inner, kind) in pairs]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        stored = wire[TUPLE] if mark_of(wire) == TUPLE else wire
        if type(stored) is not list:
            raise self.misfit(wire, place)
        build.descend(place)
        if self._endless:
            return tuple(_lift_all(stored, self._elements[0], build, place))
        if len(stored) != len(self._elements):
            raise self.misfit(wire, place, f"{len(stored)} elements")
        depth = place[2] + 1
        pairs = enumerate(zip(stored, self._elements, strict=True))
        return tuple(kind.lift(inner, build, (place, index, depth)) for index, (inner, kind) in pairs)

    def parts(self) -> tuple[Kind, ...]:
        return self._elements


class SetKind(Kind):
    """set and frozenset."""

    def __init__(self, element: Kind, cls: type[set[Any]] | type[frozenset[Any]]) -> None:
        self.name = f"{cls.__name__}[{element.name}]"
        self.types = frozenset({cls})
        self._mark = SET if cls is set else FROZENSET
        self.shapes = frozenset({self._mark})
        self._element = element
        self._cls = cls

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not self._cls:
            raise self.stranger(value, place)
        if self._cls is set:
            again = walk.meet(value, self, place)
            if again is not None:
                return again
        else:
            walk.descend(place)
        return {self._mark: _lower_all(value, self._element, walk, place)}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME and self._cls is set:
            return build.again(wire, self, place)
        if mark not in (SET, FROZENSET) or type(wire[mark]) is not list:
            raise self.misfit(wire, place)
        value: set[Any] = set()
        if self._cls is set:
            build.note_made(value, self, place)
        else:
            build.descend(place)
        elements = _lift_all(wire[mark], self._element, build, place)
        try:
            value.update(elements)
        except (TypeError, AttributeError) as error:  # not hashable, or not yet: part of a cycle
            raise self.misfit(wire, place, str(error)) from error
        if len(value) != len(elements):
            raise self.misfit(wire, place, "an element twice")
        return value if self._cls is set else frozenset(value)

    def parts(self) -> tuple[Kind, ...]:
        return (self._element,)


class MappingKind(Kind):
    """dict, OrderedDict, Counter and defaultdict; keys of any immutable kind.

    Stored as a map where every key is text, else as pairs. A defaultdict's factory is the program's, from its declaration or
    default: never from the wire.
    """

    def __init__(self, cls: type[dict[Any, Any]], key: Kind, value: Kind, factory: Callable[[], Any] | None = None) -> None:
        self.name = f"{cls.__name__}[{key.name}, {value.name}]"
        self.types = frozenset({cls})
        self.shapes = frozenset({MAP, DICT})
        self._cls, self._key, self._value, self._factory = cls, key, value, factory
        self._has_text_keys = key.keeps_text

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not self._cls:
            raise self.stranger(value, place)
        if isinstance(value, defaultdict) and value.default_factory is not self._factory:
            raise self.stranger(
                value,
                place,
                f"its default_factory is not {self._factory}, that of the declaration; declare a default that has it",
            )
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        if self._is_map(value):
            if self._value.are_wires(value.values()):
                return {MAP: dict(value)}
            depth = place[2] + 1
            pairs = enumerate(value.items())
            return {
                MAP: {
                    key: self._value.lower(inner, walk, (place, entry_step(key, index), depth)) for index, (key, inner) in pairs
                }
            }
        return {DICT: self._lower_pairs(value, walk, place)}

    def _is_map(self, value: dict[Any, Any]) -> bool:
        """Whether every key is plain text."""
        return self._has_text_keys and all(type(key) is str and (key.isascii() or type(lower_text(key)) is str) for key in value)

    def _lower_pairs(self, value: dict[Any, Any], walk: Walk, place: Place) -> list[Wire]:
        depth = place[2] + 1
        pairs = []
        for index, (key, inner) in enumerate(value.items()):
            lowered = self._key.lower(key, walk, (place, key_step(index), depth))
            pairs.append([lowered, self._value.lower(inner, walk, (place, entry_step(key, index), depth))])
        return pairs

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        pairs = self._stored_pairs(wire, mark, place)
        value: dict[Any, Any] = defaultdict(self._factory) if self._cls is defaultdict else self._cls()
        build.note_made(value, self, place)
        depth = place[2] + 1
        for index, (stored_key, inner) in enumerate(pairs):
            key = self._key.lift(stored_key, build, (place, key_step(index), depth))
            at = (place, stored_key if mark is None else entry_step(key, index), depth)
            try:
                known = key in value
            except (TypeError, AttributeError) as error:  # not hashable, or not yet: part of a cycle
                raise self.misfit(wire, at, str(error)) from error
            if known:
                raise self.misfit(wire, at, "a key twice")
            value[key] = self._value.lift(inner, build, at)
        return value

    def _stored_pairs(self, wire: Wire, mark: str | None, place: Place) -> list[Any]:
        """The stored entries: of a map, of pairs, or of a record, which is a dictionary to a newer declaration."""
        entries = wire[MAP] if mark == MAP else wire if mark is None else None
        if type(entries) is dict and all(type(key) is str for key in entries):
            return list(entries.items())
        if mark == DICT and type(wire[DICT]) is list and all(type(pair) is list and len(pair) == 2 for pair in wire[DICT]):
            return list(wire[DICT])
        raise self.misfit(wire, place)

    def parts(self) -> tuple[Kind, ...]:
        return (self._key, self._value)
