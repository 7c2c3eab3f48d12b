"""Classes of records by library: how each library declares their fields, and how to read and to make their objects.

attrs and pydantic are known by the marks of their classes, and never imported: a class of theirs exists only in a program that
has them.
"""

from __future__ import annotations

import dataclasses
import sys
import typing
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct

from failover.state.declare import MISSING
from failover.state.records import PlainObjects, Style, attribute_reader, foreign_slots, undeclared

FIELDS_SET = "__fields_set__"


class Member(Struct, frozen=True):
    """A field as its class declares it.

    Attributes:
        annotation: resolved; MISSING if there is none.
        default: makes its default; None: it has none.
        optional: may be absent.
    """

    name: str
    annotation: Any
    default: Callable[[], Any] | None = None
    optional: bool = False


class Record(Struct, frozen=True):
    """A class of records: its fields in order, and its objects."""

    members: tuple[Member, ...]
    style: Style


def record_of(cls: type) -> Record | None:
    """The fields of a class and how its objects are made; None if no library that we know made it.

    Raises:
        NameError, TypeError: an annotation cannot be resolved.
    """
    if _is_model(cls):
        return _model_record(cls)
    if issubclass(cls, msgspec.Struct):
        return _struct_record(cls)
    if "__attrs_attrs__" in vars(cls):
        return _attrs_record(cls)
    if dataclasses.is_dataclass(cls):
        return _dataclass_record(cls)
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return _named_tuple_record(cls)
    if typing.is_typeddict(cls):
        return _typed_dict_record(cls)
    return None


def _hints(cls: type) -> dict[str, Any]:
    """The annotations of a class, resolved; a class may name itself wherever it was defined."""
    return typing.get_type_hints(cls, localns={cls.__name__: cls}, include_extras=True)


def _constant(value: Any) -> Callable[[], Any]:
    return lambda: value


# dataclasses


def _dataclass_record(cls: Any) -> Record:
    hints = _hints(cls)
    members = []
    for field in dataclasses.fields(cls):
        default: Callable[[], Any] | None = None
        if field.default is not dataclasses.MISSING:
            default = _constant(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory
        members.append(Member(field.name, hints.get(field.name, MISSING), default))
    slots = foreign_slots(cls, {member.name for member in members})
    return Record(tuple(members), PlainObjects(cls, mutable=not cls.__dataclass_params__.frozen, slots=slots))


# attrs


def _attrs_record(cls: Any) -> Record:
    hints = _hints(cls)
    nothing = sys.modules["attr"].NOTHING
    members = []
    for attribute in cls.__attrs_attrs__:
        default: Callable[[], Any] | None = None
        if hasattr(attribute.default, "takes_self"):
            default = None if attribute.default.takes_self else attribute.default.factory
        elif attribute.default is not nothing:
            default = _constant(attribute.default)
        members.append(Member(attribute.name, hints.get(attribute.name, MISSING), default))
    preset = {"_attrs_cached_hash": None} if getattr(cls, "__attrs_props__", None) and hasattr(cls, "_attrs_cached_hash") else {}
    return Record(tuple(members), PlainObjects(cls, mutable=not _is_frozen_attrs(cls), preset=preset))


def _is_frozen_attrs(cls: Any) -> bool:
    return "frozen" in getattr(cls.__setattr__, "__name__", "")


# msgspec


class Structs(Style):
    """Objects of msgspec: made by their constructor, then set to the stored values."""

    def __init__(self, cls: type[msgspec.Struct]) -> None:
        self._cls = cls
        self.mutable = not cls.__struct_config__.frozen
        self._runs = hasattr(cls, "__post_init__")

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        return attribute_reader(names)

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        return undeclared(self._cls, value)

    def begin(self) -> Any:
        """Empty, so that a cycle can lead back to it; not where its ``__post_init__`` wants to see the contents."""
        return None if self._runs else self._made(dict.fromkeys(self._cls.__struct_fields__))

    def _made(self, values: dict[str, Any]) -> Any:
        return self._cls(**values)

    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        made = self._made(values) if begun is None else begun
        for name, value in values.items():
            msgspec.structs.force_setattr(made, name, value)
        return made


def _struct_record(cls: type[msgspec.Struct]) -> Record:
    hints = _hints(cls)
    members = []
    for field in msgspec.structs.fields(cls):
        default: Callable[[], Any] | None = None
        if field.default is not msgspec.NODEFAULT:
            default = _constant(field.default)
        elif field.default_factory is not msgspec.NODEFAULT:
            default = typing.cast("Callable[[], Any]", field.default_factory)
        members.append(Member(field.name, hints.get(field.name, field.type), default))
    return Record(tuple(members), Structs(cls))


# pydantic


def _is_model(cls: type) -> bool:
    pydantic = sys.modules.get("pydantic")
    return pydantic is not None and issubclass(cls, pydantic.BaseModel)


class Models(Style):
    """Objects of pydantic: no validator runs; private attributes start again at their defaults."""

    def __init__(self, cls: Any) -> None:
        self._cls = cls
        self.mutable = not cls.model_config.get("frozen", False)

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        read = attribute_reader(names[:-1])
        return lambda value: (*read(value), sorted(value.__pydantic_fields_set__))

    def begin(self) -> Any:
        return self._cls.__new__(self._cls)

    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        known = values.pop(FIELDS_SET)
        object.__setattr__(begun, "__dict__", values)
        object.__setattr__(begun, "__pydantic_fields_set__", values.keys() & set(known))
        object.__setattr__(begun, "__pydantic_extra__", {} if self._cls.model_config.get("extra") == "allow" else None)
        private = {name: attribute.get_default() for name, attribute in self._cls.__private_attributes__.items()}
        missing = sys.modules["pydantic_core"].PydanticUndefined
        kept = {name: value for name, value in private.items() if value is not missing}
        object.__setattr__(begun, "__pydantic_private__", kept if private else None)
        return begun

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        return tuple(value.__pydantic_extra__ or ())


def _model_record(cls: Any) -> Record:
    undefined = sys.modules["pydantic_core"].PydanticUndefined
    members = []
    for name, field in cls.model_fields.items():
        annotation = field.annotation
        for mark in field.metadata:
            annotation = typing.Annotated[annotation, mark]
        default: Callable[[], Any] | None = field.default_factory
        if field.default is not undefined:
            default = _constant(field.default)
        members.append(Member(name, annotation, default))
    members.append(Member(FIELDS_SET, list[str], list))
    return Record(tuple(members), Models(cls))


# Named tuples and typed dictionaries


class NamedTuples(Style):
    """Objects of a subclass of tuple; immutable."""

    mutable = False

    def __init__(self, cls: type) -> None:
        self._cls: Any = cls

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        return tuple

    def begin(self) -> Any:
        return None

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        return undeclared(self._cls, value)

    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        return tuple.__new__(self._cls, [values[name] for name in self._cls._fields])


def _named_tuple_record(cls: Any) -> Record:
    hints, defaults = _hints(cls), cls._field_defaults
    members = [
        Member(name, hints.get(name, MISSING), _constant(defaults[name]) if name in defaults else None) for name in cls._fields
    ]
    return Record(tuple(members), NamedTuples(cls))


class Mappings(Style):
    """Dictionaries with declared keys: typed dictionaries, and the fields of a component."""

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        return lambda value: tuple(value.get(name, MISSING) for name in names)

    def begin(self) -> Any:
        return {}

    def finish(self, begun: Any, values: dict[str, Any]) -> Any:
        begun.update(values)
        return begun

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        return tuple(value)


def _typed_dict_record(cls: Any) -> Record:
    members = [
        Member(name, annotation, None, _may_be_absent(annotation, name in cls.__optional_keys__))
        for name, annotation in _hints(cls).items()
    ]
    return Record(tuple(members), Mappings())


def _may_be_absent(annotation: Any, optional: bool) -> bool:
    """Whether a key may be absent: the class itself cannot tell where its annotations are text (PEP 563)."""
    origin = typing.get_origin(annotation)
    return origin is typing.NotRequired or (optional and origin is not typing.Required)


class Components(Mappings):
    """The kept fields of a component. The other attributes of the program's object are its own affair."""

    mutable = False

    def reader(self, names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
        return lambda value: tuple(map(value.__getitem__, names))

    def extras(self, value: Any, count: int) -> tuple[str, ...]:
        return ()
