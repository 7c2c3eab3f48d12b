"""Compiles an annotation into a kind: types are examined only here, once, when a program starts."""

from __future__ import annotations

import array
import collections
import collections.abc
import copy
import enum
import random
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from failover.errors import SchemaError
from failover.state import arrays, immutables, numbers
from failover.state.advice import NO_FIELDS, advice_for, advice_for_annotation
from failover.state.containers import DequeKind, ListKind, MappingKind, SetKind, TupleKind
from failover.state.declare import MISSING, Field, Formerly, Pickled
from failover.state.dtypes import DtypeError, lower_dtype
from failover.state.kinds import Kind
from failover.state.pickled import PickledKind, UnreadKind
from failover.state.random_numbers import GeneratorKind, RandomKind
from failover.state.record_libraries import Components, Member, record_of
from failover.state.records import RecordField, RecordKind
from failover.state.typed_arrays import NumbersKind
from failover.state.unions import AnyKind, EnumKind, FlagKind, LiteralKind, UnionKind
from failover.state.untyped import LabelledKind, PlainRecordKind

_ATOMS: dict[Any, Kind] = {
    None: numbers.NONE,
    type(None): numbers.NONE,
    bool: numbers.BOOL,
    int: numbers.INT,
    float: numbers.FLOAT,
    complex: numbers.COMPLEX,
    str: numbers.TEXT,
    bytes: arrays.BYTES_KIND,
    bytearray: arrays.BYTEARRAY_KIND,
    np.ndarray: arrays.ANY_ARRAY,
    np.generic: arrays.ANY_SCALAR,
    array.array: NumbersKind(),
    random.Random: RandomKind(),
    **immutables.PLAIN_KINDS,
}

_ABSTRACT: dict[Any, tuple[Any, ...]] = {
    collections.abc.Sequence: (list, tuple),
    collections.abc.MutableSequence: (list,),
    collections.abc.Collection: (list, tuple),
    collections.abc.Iterable: (list, tuple),
    collections.abc.Mapping: (dict,),
    collections.abc.MutableMapping: (dict,),
    collections.abc.Set: (frozenset, set),
    collections.abc.MutableSet: (set,),
}
"""The types that an abstract annotation may hold."""

_WRAPPERS = tuple(
    found for name in ("Final", "Required", "NotRequired", "ReadOnly") if (found := getattr(typing, name, None)) is not None
)


class Compiler:
    """Makes the kinds of one schema; equal declarations share one kind, so that objects can be shared between their places."""

    def __init__(self) -> None:
        self._made: dict[Any, Kind] = {}
        self._generator = GeneratorKind()
        self.any = self._open(AnyKind())

    def open(self) -> AnyKind:
        """A kind of everything stored, records as dictionaries: for migrations and for looking."""
        kind = AnyKind()
        return Compiler()._open(kind, also=(PlainRecordKind(kind), LabelledKind(kind), UnreadKind()))

    def _open(self, kind: AnyKind, also: tuple[Kind, ...] = ()) -> AnyKind:
        self.any = kind
        containers = (
            self._of_kind(ListKind, kind),
            self._tuple_of((kind,), endless=True),
            self._set_of(kind, set),
            self._set_of(kind, frozenset),
            self._of_kind(DequeKind, kind),
            self._mapping_of(dict, kind, kind),
        )
        kind.complete((arrays.ANY_SCALAR, *_ATOMS.values(), self._generator, *containers, *also))
        return kind

    # Interning

    def _once(self, key: Any, make: Callable[[], Kind]) -> Kind:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def _of_kind(self, cls: type[ListKind] | type[DequeKind], element: Kind) -> Kind:
        return self._once((cls, element), lambda: cls(element))

    def _tuple_of(self, elements: tuple[Kind, ...], endless: bool) -> Kind:
        return self._once((tuple, elements, endless), lambda: TupleKind(elements, endless))

    def _set_of(self, element: Kind, cls: Any) -> Kind:
        return self._once((cls, element), lambda: SetKind(element, cls))

    def _mapping_of(self, cls: Any, key: Kind, value: Kind, factory: Any = None) -> Kind:
        return self._once((cls, key, value, factory), lambda: MappingKind(cls, key, value, factory))

    # Fields

    def field(self, declared: Field, where: str) -> Kind:
        """The kind of a declared field.

        Raises:
            SchemaError: it cannot be kept.
        """
        if declared.pickled:
            return PickledKind()
        if declared.dtype is not None or declared.shape is not None:
            return arrays.ArrayKind(*array_form(declared, where))
        default = declared.factory() if declared.annotation is MISSING and declared.factory is not None else declared.default
        return self.kind(declared.annotation, where, default)

    def component(self, name: str, fields: Mapping[str, Field]) -> RecordKind:
        """The kind of a component's kept fields: a mapping name → value.

        Raises:
            SchemaError: one of them cannot be kept; names it.
        """
        made = RecordKind(name, dict, Components())
        made.types = made.types | {types.MappingProxyType}
        made.complete(
            _checked_fields(
                tuple(
                    RecordField(
                        field_name,
                        self.field(declared, f"{name}.{field_name}"),
                        default_of(declared),
                        _formerly(declared.annotation) + declared.formerly,
                    )
                    for field_name, declared in fields.items()
                ),
                name,
            )
        )
        return made

    # Types

    def kind(self, annotation: Any, where: str, default: Any = MISSING) -> Kind:
        """The kind of an annotation, or of a default where there is none.

        Raises:
            SchemaError: it cannot be kept; names the place.
        """
        if annotation is MISSING:
            return self._inferred(default, where)
        if isinstance(annotation, str | typing.ForwardRef):
            raise SchemaError(f"cannot keep {where}: its annotation {annotation!r} is still text; give the type itself", where)
        if annotation is Any or annotation is object:
            return self.any
        try:
            if annotation in _ATOMS:
                return _ATOMS[annotation]
        except TypeError:  # Annotated with something that has no hash
            pass
        if isinstance(annotation, typing.TypeVar):
            return self._type_variable(annotation, where)
        origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
        if hasattr(annotation, "__supertype__"):  # NewType
            return self.kind(annotation.__supertype__, where, default)
        if type(annotation).__name__ == "TypeAliasType":
            return self.kind(annotation.__value__, where, default)
        if origin is not None:
            return self._generic(annotation, origin, arguments, where, default)
        if isinstance(annotation, type):
            return self._class(annotation, (), where, default)
        raise _unknown(annotation, origin, where)

    def _inferred(self, default: Any, where: str) -> Kind:
        """The kind that a default implies without an annotation."""
        if default is MISSING:
            raise SchemaError(f"cannot keep {where}: it has neither an annotation nor a default; give it one of them", where)
        if default is None:
            return self.any
        return self.kind(type(default), where, default)

    def _type_variable(self, variable: typing.TypeVar, where: str) -> Kind:
        if variable.__constraints__:
            return self._union(variable.__constraints__, where)
        return self.any if variable.__bound__ is None else self.kind(variable.__bound__, where)

    def _generic(self, annotation: Any, origin: Any, arguments: tuple[Any, ...], where: str, default: Any) -> Kind:
        if origin is typing.Annotated:
            marks = annotation.__metadata__
            if any(isinstance(mark, Pickled) or mark is Pickled for mark in marks):
                return PickledKind()
            return self.kind(annotation.__origin__, where, default)
        if origin in (typing.Union, types.UnionType):
            return self._union(arguments, where)
        if origin is typing.Literal:
            return self._literal(arguments, where)
        if origin in _WRAPPERS:
            return self.kind(arguments[0], where, default)
        if type(origin).__name__ == "TypeAliasType":
            return self.kind(origin.__value__[arguments], where, default)
        if isinstance(origin, type) and origin is not collections.abc.Callable:
            return self._class(origin, arguments, where, default)
        raise _unknown(annotation, origin, where)

    def _union(self, arms: tuple[Any, ...], where: str) -> Kind:
        kinds = tuple(dict.fromkeys(self.kind(arm, where) for arm in arms))
        if self.any in kinds:
            return self.any
        if len(kinds) == 1:
            return kinds[0]
        union = UnionKind(kinds)
        if union.has_twins:
            raise SchemaError(f"cannot keep {where}: two types of {union.name} have one name; rename one of them", where)
        return self._once((UnionKind, kinds), lambda: union)

    def _literal(self, values: tuple[Any, ...], where: str) -> Kind:
        return LiteralKind(tuple((value, self.kind(type(value), where)) for value in values))

    def _class(self, cls: Any, arguments: tuple[Any, ...], where: str, default: Any) -> Kind:
        if cls in _ABSTRACT:
            return self._abstract(cls, arguments, where)
        if cls in (list, collections.deque, set, frozenset):
            element = self.kind(arguments[0], f"{where}[]") if arguments else self.any
            return (
                self._set_of(element, cls)
                if cls in (set, frozenset)
                else self._of_kind(ListKind if cls is list else DequeKind, element)
            )
        if cls is tuple:
            return self._tuple(arguments, where)
        if cls in (dict, collections.OrderedDict, collections.defaultdict, collections.Counter):
            return self._mapping(cls, arguments, where, default)
        if cls is np.ndarray:
            return arrays.ANY_ARRAY
        if issubclass(cls, np.generic):
            return self._once(cls, lambda: arrays.ScalarKind(cls))
        if issubclass(cls, enum.Enum):
            return self._once(cls, lambda: FlagKind(cls) if issubclass(cls, enum.Flag) else EnumKind(cls))
        if cls in _ATOMS:
            return _ATOMS[cls]
        if cls in self._generator.types:
            return self._generator
        return self._record(cls, arguments, where)

    def _abstract(self, cls: Any, arguments: tuple[Any, ...], where: str) -> Kind:
        if len(arguments) == 1:
            arguments_of = {tuple: (arguments[0], ...)}
            choices = tuple(choice[arguments_of.get(choice, arguments)] for choice in _ABSTRACT[cls])
        else:
            choices = tuple(choice[arguments] if arguments else choice for choice in _ABSTRACT[cls])
        return self._union(choices, where)

    def _tuple(self, arguments: tuple[Any, ...], where: str) -> Kind:
        if not arguments:
            return self._tuple_of((self.any,), endless=True)
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return self._tuple_of((self.kind(arguments[0], f"{where}[]"),), endless=True)
        if arguments == ((),):
            arguments = ()
        return self._tuple_of(
            tuple(self.kind(inner, f"{where}[{index}]") for index, inner in enumerate(arguments)), endless=False
        )

    def _mapping(self, cls: Any, arguments: tuple[Any, ...], where: str, default: Any) -> Kind:
        if cls is collections.Counter:
            arguments = (*(arguments or (Any,)), int)
        key, value = (self.kind(inner, f"{where}[]") for inner in arguments or (Any, Any))
        factory = None
        if cls is collections.defaultdict:
            factory = default.default_factory if isinstance(default, collections.defaultdict) else _factory_of(arguments)
        return self._mapping_of(cls, key, value, factory)

    def _record(self, cls: Any, arguments: tuple[Any, ...], where: str) -> Kind:
        key = (cls, arguments)
        if key in self._made:
            return self._made[key]
        try:
            record = record_of(cls)
        except (NameError, TypeError, AttributeError) as error:
            message = f"cannot keep {where}: an annotation of {cls.__qualname__} cannot be resolved: {error}"
            raise SchemaError(f"{message}; define what it names where the class's module can see it", where) from error
        if record is None:
            cure = advice_for(cls) or NO_FIELDS
            raise SchemaError(f"cannot keep {where}: a {cls.__module__}.{cls.__qualname__} cannot be kept: {cure}", where)
        name = f"{cls.__name__}[{', '.join(map(_spelled, arguments))}]" if arguments else cls.__name__
        kind = RecordKind(name, dict if typing.is_typeddict(cls) else cls, record.style)
        self._made[key] = kind
        variables = dict(zip(getattr(cls, "__parameters__", ()), arguments, strict=False))
        fields = tuple(self._member(member, variables, f"{where}.{member.name}") for member in record.members)
        kind.complete(_checked_fields(fields, where))
        return kind

    def _member(self, member: Member, variables: dict[Any, Any], where: str) -> RecordField:
        annotation = _substituted(member.annotation, variables)
        default = member.default() if annotation is MISSING and member.default is not None else MISSING
        kind = self.any if annotation is MISSING and default is MISSING else self.kind(annotation, where, default)
        return RecordField(member.name, kind, member.default, _formerly(annotation), member.optional)


def _unknown(annotation: Any, origin: Any, where: str) -> SchemaError:
    cure = advice_for_annotation(annotation, origin)
    return SchemaError(f"cannot keep {where}: {annotation!r} is not a type that we know; {cure}", where)


def _spelled(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def _factory_of(arguments: tuple[Any, ...]) -> Callable[[], Any] | None:
    """The factory of a declared defaultdict[K, V]: V, or the class that V is made of."""
    value = arguments[1] if arguments else None
    made: Any = typing.get_origin(value) or value
    return made if isinstance(made, type) else None


def _substituted(annotation: Any, variables: dict[Any, Any]) -> Any:
    """An annotation with its type variables put in."""
    if isinstance(annotation, typing.TypeVar):
        return variables.get(annotation, annotation)
    free = getattr(annotation, "__parameters__", ())
    if not variables or not free or isinstance(annotation, type):
        return annotation
    return annotation[tuple(variables.get(variable, variable) for variable in free)]


def _formerly(annotation: Any) -> tuple[str, ...]:
    """Former names, from the marks of an annotation."""
    marks = annotation.__metadata__ if typing.get_origin(annotation) is typing.Annotated else ()
    return tuple(name for mark in marks if isinstance(mark, Formerly) for name in mark.names)


def _checked_fields(fields: tuple[RecordField, ...], where: str) -> tuple[RecordField, ...]:
    """Names that a place can be told by, each of one field.

    Raises:
        SchemaError: names the field.
    """
    names = [name for field in fields for name in (field.name, *field.formerly)]
    for name in names:
        if not name.isidentifier():
            raise SchemaError(f"cannot keep {where}.{name}: {name!r} is no name of an attribute; declare a dict instead", where)
        if names.count(name) > 1:
            raise SchemaError(
                f"cannot keep {where}.{name}: the name is declared twice (as a field and as a former name); drop one", where
            )
    return fields


def array_form(declared: Field, where: str) -> tuple[np.dtype[Any] | None, tuple[int, ...] | None]:
    """The dtype and shape of a declared array.

    Raises:
        SchemaError: not a dtype or a shape that can be kept.
    """
    try:
        dtype = None if declared.dtype is None else np.dtype(declared.dtype)
        if dtype is not None:
            lower_dtype(dtype)
    except (TypeError, DtypeError) as error:
        raise SchemaError(f"cannot keep {where}: {error}", where) from error
    if declared.shape is not None and any(length < 0 for length in declared.shape):
        raise SchemaError(f"cannot keep {where}: its shape {declared.shape} has a negative length", where)
    return dtype, declared.shape


def default_of(declared: Field) -> Callable[[], Any] | None:
    """The function that makes the first value of a field; None: it has none."""
    if declared.factory is not None:
        return declared.factory
    if declared.default is not MISSING:
        return lambda: copy.deepcopy(declared.default)
    if declared.shape is not None:
        shape = declared.shape
        return lambda: np.zeros(shape, declared.dtype)
    return None
