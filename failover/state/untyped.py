"""Values of a state without its declaration: a migration or a reader gets them in place of the program's classes."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from failover.state.kinds import Build, Kind, Walk
from failover.state.unions import AS
from failover.state.wire import SAME, Place, Wire, mark_of


class PlainRecord(dict[str, Any]):
    """A record as the dictionary of its fields; it may be a key, as the record may have been."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self))


class PlainRecordKind(Kind):
    """Records of any class."""

    name = "a record"
    types = frozenset({PlainRecord})
    shapes = frozenset({"record"})

    def __init__(self, inner: Kind) -> None:
        self._inner = inner

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        again = walk.meet(value, self, place)
        if again is not None:
            return again
        for name in value:
            if type(name) is not str or not name.isidentifier():
                raise self.stranger(value, place, f"{name!r} is no name of a field: make it a dict")
        depth = place[2] + 1
        return {name: self._inner.lower(inner, walk, (place, name, depth)) for name, inner in value.items()}

    def lift(self, wire: Wire, build: Build, place: Place) -> PlainRecord:
        value = PlainRecord()
        build.note_made(value, self, place)
        depth = place[2] + 1
        for name, inner in wire.items():
            if type(name) is not str or not name.isidentifier():
                raise self.misfit(wire, place, f"{name!r} is no name of a field"[:80])
            value[name] = self._inner.lift(inner, build, (place, name, depth))
        return value


class Labelled(Struct, frozen=True):
    """A value of a union, where the wire has to say of which of its types it is."""

    label: str
    value: Any


class LabelledKind(Kind):
    """Labelled values of any union."""

    name = "labelled"
    types = frozenset({Labelled})
    shapes = frozenset({AS})

    def __init__(self, inner: Kind) -> None:
        self._inner = inner

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        walk.descend(place)
        wire = self._inner.lower(value.value, walk, place)
        return wire if mark_of(wire) == SAME else {AS: [value.label, wire]}

    def lift(self, wire: Wire, build: Build, place: Place) -> Labelled:
        payload = wire[AS]
        if type(payload) is not list or len(payload) != 2 or type(payload[0]) is not str:
            raise self.misfit(wire, place, "not a label and a value")
        above, step, depth = place
        return Labelled(payload[0], self._inner.lift(payload[1], build, (above, step, depth + 1)))
