"""Kinds of records: objects with named fields, of classes that any supported library made.

A record comes back as it was: fields are set on an empty object; no constructor, ``__post_init__`` or validator runs, except
where a class of msgspec has a ``__post_init__``, which cannot be avoided. Stored are names, not positions: an added field takes
its default, a removed one is dropped (both are noted), a renamed one is found by its former name.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property
from operator import attrgetter
from typing import Any

from msgspec import Struct

from failover.errors import FitError, KeepError
from failover.state.containers import MAP
from failover.state.declare import MISSING
from failover.state.kinds import FIT_CURE, Build, Kind, Walk
from failover.state.wire import SAME, Place, Wire, entry_step, mark_of, text_of


class RecordField(Struct, frozen=True):
    """One field of a record.

    Attributes:
        name: of the attribute.
        kind: of its values.
        default: makes its value when it was not stored; None: it must be stored.
        formerly: names under which it was stored before.
        optional: it may be absent from the object (a key of a TypedDict that is not required).
    """

    name: str
    kind: Kind
    default: Callable[[], Any] | None = None
    formerly: tuple[str, ...] = ()
    optional: bool = False


class Style(ABC):
    """How objects of one class are read and made."""

    mutable = True

    @abstractmethod
    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        """A function that answers an object's values, in the order of ``names``."""

    @abstractmethod
    def begin(self) -> Any:
        """An object without contents; None where it cannot exist before them."""

    @abstractmethod
    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        """The object with its contents."""

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        """Names of attributes that an object holds besides its ``count`` fields."""
        return ()


def attribute_reader(names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    """Reads attributes, several at the speed of one call."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda value: tuple(getattr(value, name) for name in names)


def undeclared(cls: type, value: Any) -> tuple[str, ...]:
    """The names in an object's dictionary, if it has one, except those that cached properties left there."""
    found = getattr(value, "__dict__", ())
    return tuple(name for name in found if not isinstance(getattr(cls, name, None), cached_property))


class PlainObjects(Style):
    """Objects of ordinary classes: dataclasses and attrs, with or without slots, frozen or not."""

    def __init__(self, cls: type, mutable: bool, preset: Mapping[str, Any] | None = None, slots: tuple[str, ...] = ()) -> None:
        """
        Args:
            preset: attributes that are no fields and must be there.
            slots: names of slots that are no fields.
        """
        self.mutable = mutable
        self._cls = cls
        self._preset = dict(preset or {})
        self._slots = slots
        self._has_dict = bool(getattr(cls, "__dictoffset__", 0))

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        return attribute_reader(names)

    def begin(self) -> Any:
        return object.__new__(self._cls)

    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        for name, value in values.items():
            object.__setattr__(begun, name, value)
        for name, value in self._preset.items():
            object.__setattr__(begun, name, value)
        return begun

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        if self._slots:
            return (*(name for name in self._slots if hasattr(value, name)), *undeclared(self._cls, value))
        if not self._has_dict or len(vars(value)) <= count:
            return ()
        return undeclared(self._cls, value)


def foreign_slots(cls: type, fields: set[str]) -> tuple[str, ...]:
    """Slots of a class and its bases that are no fields."""
    declared = [vars(base).get("__slots__", ()) for base in cls.__mro__]
    names = [name for slots in declared for name in ((slots,) if isinstance(slots, str) else slots)]
    return tuple(dict.fromkeys(name for name in names if name not in fields and name not in ("__weakref__", "__dict__")))


class RecordKind(Kind):
    """Objects of one class with declared fields. ``complete`` follows the constructor, so that a class can contain itself."""

    shapes = frozenset({"record", MAP})

    def __init__(self, name: str, cls: type, style: Style) -> None:
        self.name = name
        self.types = frozenset({cls})
        self._style = style
        self._mutable = style.mutable

    def complete(self, fields: tuple[RecordField, ...]) -> None:
        """The fields, once their kinds are known."""
        self.fields = fields
        self._steps = tuple((field.name, field.kind.exact, field.kind) for field in fields)
        self._optional = frozenset(field.name for field in fields if field.optional)
        self._names = frozenset(field.name for field in fields)
        self._read = self._style.reader(tuple(field.name for field in fields))
        former = {name: field for field in fields for name in field.formerly}
        self._by_stored_name = former | {field.name: field for field in fields}

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) not in self.types:
            raise self.stranger(value, place)
        if self._mutable:
            again = walk.meet(value, self, place)
            if again is not None:
                return again
        else:
            walk.descend(place)
        extras = self._style.extras(value, len(self._steps))
        if extras:
            self._refuse_extras(extras, place)
        try:
            values = self._read(value)
        except AttributeError as error:
            raise KeepError(f"cannot keep {text_of(place)}: {error}; set every field before a commit", text_of(place)) from error
        depth = place[2] + 1
        wire: Wire = {}
        for (name, exact, kind), inner in zip(self._steps, values, strict=True):
            if type(inner) in exact:
                wire[name] = inner
            elif inner is not MISSING:
                wire[name] = kind.lower(inner, walk, (place, name, depth))
            elif name not in self._optional:
                where = text_of(place)
                raise KeepError(
                    f"cannot keep {where}: it has no {name!r}, declared {self.name}; set every field before a commit", where
                )
        return wire

    def _refuse_extras(self, extras: tuple[str, ...], place: Place) -> None:
        """Refuse an object that holds undeclared attributes.

        Raises:
            KeepError: names the first of them.
        """
        surplus = [name for name in extras if name not in self._names and name != "__orig_class__"]  # of Generic[...]()
        if surplus:
            where = f"{text_of(place)}.{surplus[0]}"
            message = f"cannot keep {where}: it was set but is no declared field of {self.name}, and would be lost"
            raise KeepError(f"{message}; declare it as a field, or make it a functools.cached_property", where)

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        mark = mark_of(wire)
        if mark == SAME:
            return build.again(wire, self, place)
        stored = wire[MAP] if mark == MAP else wire if mark is None else None
        if type(stored) is not dict or not all(type(name) is str for name in stored):
            raise self.misfit(wire, place)
        if stored and self.fields and self._by_stored_name.keys().isdisjoint(stored):
            raise self.misfit(wire, place, f"none of its fields is declared, which are {', '.join(sorted(self._names)[:8])}")
        begun = self._style.begin()
        if self._mutable and begun is not None:
            build.note_made(begun, self, place)
        else:
            build.descend(place)
        value = self._style.finish(begun, self._lift_fields(stored, mark is None, build, place))
        if self._mutable and begun is None:
            build.note_made(value, self, place)
        return value

    def _lift_fields(self, stored: dict[str, Wire], as_record: bool, build: Build, place: Place) -> dict[str, Any]:
        """The values of the declared fields, in stored order: a second way to an object comes after the first.

        Args:
            as_record: they were stored as a record, not as a dictionary; their places are named so.
        """
        depth = place[2] + 1
        values: dict[str, Any] = {}
        for index, (name, inner) in enumerate(stored.items()):
            field = self._by_stored_name.get(name)
            at = (place, name if as_record else entry_step(name, index), depth)
            if field is None:
                build.note(f"{self.name}.{name}", f"{text_of(at)}: stored but not declared any more: dropped")
                continue
            if field.name in values:
                raise field.kind.misfit(inner, at, f"stored under two names of {field.name}")
            values[field.name] = field.kind.lift(inner, build, at)
        for field in self.fields:
            if field.name not in values and not field.optional:
                values[field.name] = self._default(field, build, (place, field.name, depth))
        return values

    def _default(self, field: RecordField, build: Build, place: Place) -> Any:
        where = text_of(place)
        if field.default is None:
            raise FitError(f"{where}: not stored, and declared without a default; give it one, or {FIT_CURE}", where)
        build.note(f"{self.name}.{field.name}", f"{where}: not stored: takes its default")
        return field.default()

    def parts(self) -> tuple[Kind, ...]:
        return tuple(field.kind for field in self.fields)

    def description(self) -> str:
        return f"{self.name}({', '.join(f'{field.name}: {field.kind.name}' for field in self.fields)})"
