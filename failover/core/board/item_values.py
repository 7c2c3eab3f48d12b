"""Values of an item as bytes: how an object of a program's class, a dictionary or a numpy value is packed and read back.

The class says the type: a dataclass, a `msgspec.Struct`, a named tuple or a class of attrs by its annotations, a numpy dtype by
its fields. `values_of` makes the plan once; then a put costs one call of `struct` for a struct of plain numbers.

| annotation | type | annotation | type |
|---|---|---|---|
| ``float`` | f8 | ``Annotated[float, "f4"]`` | what the text says, see `item_types` |
| ``int`` | i8 | ``numpy.float32``, ``numpy.int8`` … | f4, i1 … |
| ``bool`` | bool | ``tuple[float, float, float]`` | f8[3] |
| another such class | a struct | ``Annotated[str, "char[16]"]``, ``Annotated[bytes, "u1[6]"]`` | text, bytes |
"""

from __future__ import annotations

import math
import operator
import struct
import typing
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any, Final

import msgspec
from msgspec import Struct

from failover.core.board.item_types import (
    DEPTH_MAX,
    NUMBERS,
    Array,
    Number,
    Opaque,
    Record,
    Text,
    Type,
    canonical,
    checked,
    is_octets,
    of_table,
    offsets_of,
    parse,
    record_of,
    size_of,
    struct_format,
)
from failover.errors import ItemError, ValueMisfitError

PLAIN: Final = {float: "f8", int: "i8", bool: "bool"}
"""Annotations that say a number by themselves."""

_KINDS: Final = {"i": "int", "u": "uint", "f": "float"}
NUMPY_NAMES: Final = {f"{_KINDS[code[0]]}{8 * int(code[1])}": code for code in NUMBERS if code != "bool"} | {
    "bool": "bool",
    "bool_": "bool",
}
"""numpy's name of a number → ours."""

MISFITS: Final = (struct.error, TypeError, ValueError, AttributeError, LookupError, OverflowError)
"""The exceptions that an object raises that is not of its type."""


class Values(Struct, frozen=True):
    """How values of one item become bytes and come back.

    Attributes:
        pack: the value's bytes, of the type's size; of contents without a layout, at most so many.
            Raises ValueMisfitError: names the field and why.
        unpack: the value of such bytes, from any writer.
            Raises ValueMisfitError: only for contents without a layout, which need not be any.
    """

    type: Type
    pack: Callable[[Any], bytes]
    unpack: Callable[[Any], Any]


def values_of(declared: Type, shape: Any = None, finite: bool = False) -> Values:
    """The plan for an item's values.

    Args:
        declared: the item's type.
        shape: the program's class or numpy dtype; None: dictionaries, lists, numbers, text. Of msgpack and json it is what the
            decoder checks against; of bytes it is not used.
        finite: numbers that are not finite are refused.

    Raises:
        ItemError: the class means another type; says both.
    """
    if isinstance(declared, Opaque):
        return _opaque_values(declared, shape)
    if shape is not None and not isinstance(shape, str | Mapping):
        meant = type_of(shape)
        if meant != declared:
            raise ItemError(f"the item is declared as {canonical(declared)}, and {_name(shape)} means {canonical(meant)}", "type")
        if _is_dtype(shape):
            return _numpy_values(declared, shape, finite)
        return _struct_values(declared, _node(declared, shape), finite)
    return _struct_values(declared, _node(declared, None), finite)


# --- Types of classes ------------------------------------------------------------------------------------------------


def type_of(written: Any) -> Type:
    """The type that a class, a numpy dtype, a table or a text means.

    Raises:
        ItemError: it means none; names the field and what to write.
    """
    if isinstance(written, Number | Text | Array | Record | Opaque):
        return checked(written)
    if isinstance(written, str | Mapping):
        return of_table(written)
    if _is_dtype(written):
        return checked(_of_dtype(written, ""))
    return checked(_of_annotation(written, "", 0))


def _of_annotation(hint: Any, place: str, depth: int) -> Type:
    said = [mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, str)]
    if said:
        return parse(said[0])
    if hasattr(hint, "__metadata__"):
        hint = hint.__origin__
    if hint in PLAIN:
        return Number(PLAIN[hint])
    if getattr(hint, "__module__", "") == "numpy" and getattr(hint, "__name__", "") in NUMPY_NAMES:
        return Number(NUMPY_NAMES[hint.__name__])
    if typing.get_origin(hint) is tuple:
        inner = set(typing.get_args(hint))
        if len(inner) == 1:
            return Array(_of_annotation(inner.pop(), place, depth), len(typing.get_args(hint)))
    if isinstance(hint, type) and depth < DEPTH_MAX and (members := _members(hint)):
        fields = [(name, _of_annotation(kind, f"{place}.{name}" if place else name, depth + 1)) for name, kind in members.items()]
        return record_of(fields, place)
    raise ItemError(
        f"{f'field {place}: ' if place else ''}{_name(hint)} says no size; write float, int, bool, a tuple of one of them, a "
        'class with such fields, or say it: Annotated[float, "f4"], Annotated[str, "char[16]"], Annotated[list, "f4[3]"]',
        "type",
    )


def _members(cls: type) -> dict[str, Any]:
    """Fields of a class with their annotations; none if it is no class of records."""
    known = ("__dataclass_fields__", "__struct_fields__", "__attrs_attrs__", "_fields")
    if not any(hasattr(cls, mark) for mark in known):
        return {}
    try:
        hints = typing.get_type_hints(cls, localns={cls.__name__: cls}, include_extras=True)
    except (NameError, TypeError) as error:
        raise ItemError(f"the annotations of {cls.__name__} cannot be resolved: {error}", "type") from error
    return {
        name: hint
        for name, hint in hints.items()
        if typing.get_origin(hint) is not typing.ClassVar and hint is not typing.ClassVar
    }


def _is_dtype(shape: Any) -> bool:
    return hasattr(shape, "itemsize") and hasattr(shape, "subdtype")


def _of_dtype(dtype: Any, place: str) -> Type:
    if dtype.subdtype is not None:
        base, lengths = dtype.subdtype
        kind = _of_dtype(base, place)
        for length in reversed(lengths):
            kind = Array(kind, length)
        return kind
    if dtype.names is not None:
        below = {name: f"{place}.{name}" if place else name for name in dtype.names}
        record = record_of([(name, _of_dtype(dtype.fields[name][0], below[name])) for name in dtype.names], place)
        offsets = {name: dtype.fields[name][1] for name in dtype.names}
        if offsets != offsets_of(record) or dtype.itemsize != size_of(record):
            raise ItemError(f"{dtype} lays its fields out otherwise than C does; make it by numpy.dtype(…, align=True)", "type")
        return record
    if dtype.kind == "S" and dtype.itemsize:
        return Text(dtype.itemsize)
    if dtype.byteorder == ">" or dtype.name not in NUMPY_NAMES:
        raise ItemError(f"{f'field {place}: ' if place else ''}numpy's {dtype} is no type of an item; convert it", "type")
    return Number(NUMPY_NAMES[dtype.name])


def _name(shape: Any) -> str:
    return getattr(shape, "__name__", None) or str(shape)


# --- Bytes of structs ------------------------------------------------------------------------------------------------


class _Node:
    """One part of a value: writes its numbers behind each other, and builds itself of them again."""

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        """Append the value's numbers. Raises one of `MISFITS`."""
        leaves.append(value)

    def build(self, leaves: Iterator[Any]) -> Any:
        """Take the value's numbers."""
        return next(leaves)

    def complaint(self, value: Any, place: str) -> str:
        """Where and why a value does not fit; "" if it does."""
        raise NotImplementedError


class _NumberNode(_Node):
    def __init__(self, code: str) -> None:
        self._code = code
        self._pack = struct.Struct("<" + NUMBERS[code]).pack

    def complaint(self, value: Any, place: str) -> str:
        try:
            self._pack(value)
        except MISFITS:
            return _sentence(place, value, f"no {self._code}")
        return ""


class _BoolNode(_Node):
    """`struct` takes anything for a truth value."""

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        if value not in (True, False):
            raise ValueError
        leaves.append(bool(value))

    def complaint(self, value: Any, place: str) -> str:
        return "" if value in (True, False) else _sentence(place, value, "neither true nor false")


class _TextNode(_Node):
    def __init__(self, size: int) -> None:
        self._size = size

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        encoded = value.encode()
        if len(encoded) > self._size or b"\0" in encoded:
            raise ValueError
        leaves.append(encoded)

    def build(self, leaves: Iterator[Any]) -> Any:
        encoded: bytes = next(leaves)
        return encoded.partition(b"\0")[0].decode(errors="replace")

    def complaint(self, value: Any, place: str) -> str:
        if not isinstance(value, str):
            return _sentence(place, value, "no text")
        try:
            size = len(value.encode())
        except UnicodeEncodeError:
            return _sentence(place, value, "no text that UTF-8 can say")
        if "\0" in value:
            return _sentence(place, value, "a text with a zero in it, which C would cut there")
        return _sentence(place, value, f"{size} bytes long, of at most {self._size}") if size > self._size else ""


class _OctetsNode(_Node):
    def __init__(self, size: int) -> None:
        self._size = size

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        if isinstance(value, str | int):
            raise TypeError
        octets = bytes(value)
        if len(octets) != self._size:
            raise ValueError
        leaves.append(octets)

    def complaint(self, value: Any, place: str) -> str:
        try:
            self.flatten(value, [])
        except MISFITS:
            return _sentence(place, value, f"not {self._size} bytes, each from 0 to 255")
        return ""


class _ArrayNode(_Node):
    def __init__(self, element: _Node, count: int, plain: bool, make: Callable[[Any], Any]) -> None:
        self._element = element
        self._count = count
        self._plain = plain
        self._make = make

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        if len(value) != self._count or isinstance(value, str | Mapping):
            raise ValueError
        if self._plain:
            leaves.extend(value)
        else:
            for element in value:
                self._element.flatten(element, leaves)

    def build(self, leaves: Iterator[Any]) -> Any:
        if self._plain:
            return self._make(islice(leaves, self._count))
        return self._make(self._element.build(leaves) for _ in range(self._count))

    def complaint(self, value: Any, place: str) -> str:
        if isinstance(value, str | Mapping) or not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
            return _sentence(place, value, f"no list of {self._count}")
        if len(value) != self._count:
            return _sentence(place, value, f"{len(value)} values, not {self._count}")
        found = (self._element.complaint(element, f"{place}[{index}]") for index, element in enumerate(value))
        return next(filter(None, found), "")


class _RecordNode(_Node):
    """``read``: the values of an object's fields, in order; ``make``: the object of them."""

    def __init__(self, names: tuple[str, ...], parts: tuple[_Node, ...], shape: Any) -> None:
        self.parts = parts
        self._names = names
        self._mapping = shape is None
        getter: Any = operator.itemgetter if self._mapping else operator.attrgetter
        several = getter(*names)
        self._read = several if len(names) > 1 else lambda value: (several(value),)
        self.read = self._read_mapping if self._mapping else self._read
        self.make = self._maker(shape)

    def _maker(self, shape: Any) -> Callable[..., Any]:
        names = self._names
        if self._mapping:
            return lambda *values: dict(zip(names, values, strict=True))
        if _by_position(shape):
            return shape  # type: ignore[no-any-return]
        return lambda *values: shape(**dict(zip(names, values, strict=True)))

    def _read_mapping(self, value: Any) -> tuple[Any, ...]:
        if len(value) != len(self._names):
            raise LookupError
        found: tuple[Any, ...] = self._read(value)
        return found

    def flatten(self, value: Any, leaves: list[Any]) -> None:
        for part, inner in zip(self.parts, self.read(value), strict=True):
            part.flatten(inner, leaves)

    def build(self, leaves: Iterator[Any]) -> Any:
        return self.make(*[part.build(leaves) for part in self.parts])

    def complaint(self, value: Any, place: str) -> str:
        expected = ", ".join(self._names)
        if self._mapping:
            if not isinstance(value, Mapping):
                return _sentence(place, value, f"no table of the fields {expected}")
            unknown = [name for name in value if name not in self._names]
            if unknown:
                return _sentence(place, unknown[0], f"no field of it; its fields are {expected}")
        for name, part in zip(self._names, self.parts, strict=True):
            if name not in value if self._mapping else not hasattr(value, name):
                return _sentence(place, value, f"without a field {name}; its fields are {expected}")
            inner = value[name] if self._mapping else getattr(value, name)
            if found := part.complaint(inner, f"{place}.{name}" if place else name):
                return found
        return ""


def _by_position(cls: Any) -> bool:
    """Whether a class takes its fields one after the other."""
    if hasattr(cls, "__struct_config__"):
        return len(cls.__match_args__) == len(cls.__struct_fields__)
    if hasattr(cls, "__dataclass_fields__"):
        return not any(field.kw_only for field in cls.__dataclass_fields__.values())
    return hasattr(cls, "_fields")


def _node(kind: Type, shape: Any) -> _Node:
    """The part of a value that has this type; ``shape``: its class or annotation, None for plain values."""
    shape = _without_marks(shape)
    if isinstance(kind, Number):
        return _BoolNode() if kind.code == "bool" else _NumberNode(kind.code)
    if isinstance(kind, Text):
        return _TextNode(kind.size)
    if is_octets(kind):
        assert isinstance(kind, Array)
        return _OctetsNode(kind.count)
    if isinstance(kind, Array):
        of_tuple = shape is tuple or typing.get_origin(shape) is tuple
        inner = typing.get_args(shape)
        element = _node(kind.of, inner[0] if inner and not isinstance(inner[0], typing.TypeVar) else None)
        return _ArrayNode(element, kind.count, isinstance(element, _NumberNode), tuple if of_tuple else list)
    assert isinstance(kind, Record)  # contents without a layout are no part
    hints = _members(shape) if isinstance(shape, type) else {}
    parts = tuple(_node(field, hints.get(name)) for name, field in kind.fields)
    return _RecordNode(tuple(name for name, _ in kind.fields), parts, shape if hints else None)


def _without_marks(hint: Any) -> Any:
    return hint.__origin__ if hasattr(hint, "__metadata__") else hint


def _struct_values(kind: Type, node: _Node, finite: bool) -> Values:
    form = struct.Struct("<" + struct_format(kind))
    packed, unpacked, flatten, build = form.pack, form.unpack, node.flatten, node.build

    def pack(value: Any) -> bytes:
        leaves: list[Any] = []
        try:
            flatten(value, leaves)
            if finite:
                _refuse_endless(leaves)
            return packed(*leaves)
        except MISFITS as error:
            raise _misfit(node, value, error) from None

    def unpack(octets: Any) -> Any:
        return build(iter(unpacked(octets)))

    if not isinstance(node, _RecordNode) or not all(isinstance(part, _NumberNode) for part in node.parts):
        return Values(kind, pack, unpack)
    read, make = node.read, node.make

    def pack_flat(value: Any) -> bytes:
        try:
            return packed(*read(value))
        except MISFITS as error:
            raise _misfit(node, value, error) from None

    return Values(kind, pack if finite else pack_flat, lambda octets: make(*unpacked(octets)))


class _EndlessError(ValueError):
    """A number that is not finite."""


def _refuse_endless(leaves: list[Any]) -> None:
    for leaf in leaves:
        if not isinstance(leaf, bytes) and not math.isfinite(leaf):
            raise _EndlessError(f"{leaf} is refused: the item is declared with finite = true")


def _misfit(node: _Node, value: Any, error: Exception) -> ValueMisfitError:
    if isinstance(error, _EndlessError):
        return ValueMisfitError(str(error))
    return ValueMisfitError(node.complaint(value, "") or f"{_short(value)}: {error}")


def _sentence(place: str, value: Any, why: str) -> str:
    return f"{f'field {place}: ' if place else ''}{_short(value)} is {why}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


# --- Bytes of numpy, and contents without a layout -------------------------------------------------------------------


def _numpy_values(kind: Type, dtype: Any, finite: bool) -> Values:
    import numpy as np

    base, lengths = dtype.subdtype or (dtype, ())
    holes = _padding(kind)

    def pack(value: Any) -> bytes:
        try:
            found = np.asarray(value, base)
        except MISFITS as error:
            raise ValueMisfitError(f"{_short(value)} is no {dtype}: {error}") from None
        if found.shape != lengths:
            raise ValueMisfitError(f"an array of the shape {found.shape}, not {lengths}")
        if finite and not _is_finite(found):
            raise ValueMisfitError("a number that is not finite is refused: the item is declared with finite = true")
        octets = found.tobytes()
        if not holes:
            return octets
        filled = bytearray(octets)
        for begin, end in holes:
            filled[begin:end] = bytes(end - begin)
        return bytes(filled)

    def unpack(octets: Any) -> Any:
        found = np.frombuffer(octets, base).reshape(lengths)
        return found if lengths else found[()]

    return Values(kind, pack, unpack)


def _is_finite(found: Any) -> bool:
    import numpy as np

    if found.dtype.names is not None:
        return all(_is_finite(found[name]) for name in found.dtype.names)
    return found.dtype.kind != "f" or bool(np.isfinite(found).all())


def _padding(kind: Type, begin: int = 0) -> list[tuple[int, int]]:
    """The bytes of a value that belong to no field: (begin, end) each."""
    if isinstance(kind, Array):
        size = size_of(kind.of)
        return (
            [hole for index in range(kind.count) for hole in _padding(kind.of, begin + index * size)] if _padding(kind.of) else []
        )
    if not isinstance(kind, Record):
        return []
    holes, end, offsets = [], begin, offsets_of(kind)
    for name, field in kind.fields:
        at = begin + offsets[name]
        holes += [(end, at)] if at > end else []
        holes += _padding(field, at)
        end = at + size_of(field)
    last = begin + size_of(kind)
    return holes + ([(end, last)] if last > end else [])


def _opaque_values(kind: Opaque, shape: Any) -> Values:
    if kind.kind == "bytes":
        encode: Callable[[Any], bytes] = _octets
        decode: Callable[[Any], Any] = bytes
    elif kind.kind == "msgpack":
        encode = msgspec.msgpack.Encoder().encode
        decode = msgspec.msgpack.Decoder(Any if shape is None else shape).decode
    else:
        encode = msgspec.json.Encoder().encode
        decode = msgspec.json.Decoder(Any if shape is None else shape).decode

    def pack(value: Any) -> bytes:
        try:
            octets = encode(value)
        except (*MISFITS, msgspec.MsgspecError, RecursionError) as error:
            raise ValueMisfitError(f"{_short(value)} cannot be said in {kind.kind}: {error}") from None
        if len(octets) > kind.size:
            raise ValueMisfitError(f"a value of {len(octets)} bytes; the item holds {kind.size}: raise its size, or put less")
        return octets

    def unpack(octets: Any) -> Any:
        try:
            return decode(octets)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            raise ValueMisfitError(f"its {len(octets)} bytes are no {kind.kind} that was expected: {error}") from None

    return Values(kind, pack, unpack)


def _octets(value: Any) -> bytes:
    if isinstance(value, str | int):
        raise TypeError("give bytes")
    return bytes(value)
