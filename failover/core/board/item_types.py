"""The type language of items: the text that a person writes, the C struct that it means, and the one text that names it.

::

    f4                               a number: i1 i2 i4 i8, u1 u2 u4 u8, f4 f8, bool
    f4[3]   f4[2][3]                 an array, as C declares `float x[2][3]`
    char[16]                         text: at most 16 bytes of UTF-8, filled up with zeros
    {x:f4,v:f4[3],pose:{a:f8}}       a struct; in TOML and Python also a table {"x": "f4", "v": "f4[3]", …}
    {x:f4,y:f4}[8]                   an array of structs
    bytes  msgpack  json             contents without a layout; the item says their most bytes

A layout is that of C on every processor where a number is aligned by its size (x86-64, aarch64, armhf, riscv64): little-endian,
each number at a multiple of its size, a struct at a multiple of its most aligned member's and as long as a multiple of it.
Padding is written as zeros. Source: System V ABI, AMD64 supplement 3.1.2; AAPCS64 5.9.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, TypeAlias

from msgspec import Struct

from failover.errors import ItemError

ITEM_SIZE_MAX: Final = 64 << 10
"""Bytes of one value: a get copies it whole, and two to eight banks of it lie in the block."""

DEPTH_MAX: Final = 8
"""Structs and arrays inside each other: more is a mistake, and a parser calls itself for each."""

FIELDS_MAX: Final = 256
"""Of one struct."""

NAME_SIZE_MAX: Final = 63
"""Characters of a field's name: as many as C promises to tell apart."""

NUMBERS: Final = dict(zip(["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8", "bool"], "bhiqBHIQfd?", strict=True))
"""Name of a number → its letter in `struct`."""

OPAQUE: Final = ("bytes", "msgpack", "json")
"""Contents without a layout."""


class Number(Struct, frozen=True):
    """One number. ``code``: a key of `NUMBERS`."""

    code: str


class Text(Struct, frozen=True):
    """At most ``size`` bytes of UTF-8, filled up with zeros; a text of exactly ``size`` bytes has no zero behind it."""

    size: int


class Array(Struct, frozen=True):
    """``count`` values of one type behind each other."""

    of: Type
    count: int


class Record(Struct, frozen=True):
    """A struct: its fields in the order of their addresses."""

    fields: tuple[tuple[str, Type], ...]


class Opaque(Struct, frozen=True):
    """Bytes that have no layout of their own. ``kind``: one of `OPAQUE`; ``size``: the most bytes of a value."""

    kind: str
    size: int


Type: TypeAlias = Number | Text | Array | Record | Opaque

# --- Layout ----------------------------------------------------------------------------------------------------------


def size_of(kind: Type) -> int:
    """Bytes of a value, its padding included; of contents without a layout the most bytes."""
    return _extent(kind)[0]


def alignment_of(kind: Type) -> int:
    """The number of which a value's address is a multiple."""
    return _extent(kind)[1]


def offsets_of(record: Record) -> dict[str, int]:
    """Name of a field → bytes from the struct's beginning to it."""
    return _placed(record)[0]


def _extent(kind: Type) -> tuple[int, int]:
    """Size and alignment of a value, by one look at each part: other robots announce types, and a deep one must cost little."""
    if isinstance(kind, Number):
        size = 1 if kind.code == "bool" else int(kind.code[1])
        return size, size
    if isinstance(kind, Array):
        size, alignment = _extent(kind.of)
        return kind.count * size, alignment
    if isinstance(kind, Record):
        _, end, alignment = _placed(kind)
        return aligned(end, alignment), alignment
    return kind.size, 1


def _placed(record: Record) -> tuple[dict[str, int], int, int]:
    """Where each field begins, where the last one ends, and the alignment of the struct."""
    offsets, end, most = {}, 0, 1
    for name, kind in record.fields:
        size, alignment = _extent(kind)
        offsets[name] = aligned(end, alignment)
        end, most = offsets[name] + size, max(most, alignment)
    return offsets, end, most


def aligned(offset: int, alignment: int) -> int:
    """The next multiple of ``alignment``, from ``offset`` on."""
    return -(-offset // alignment) * alignment


def is_octets(kind: Type) -> bool:
    """Whether an array is one of single bytes, which Python holds as ``bytes``."""
    return isinstance(kind, Array) and kind.of == Number("u1")


def struct_format(kind: Type) -> str:
    """A value's form for `struct`, with each byte of padding as ``x``; to be preceded by ``<``.

    A text and an array of single bytes are one ``s``, every other number is a letter of its own.
    """
    if isinstance(kind, Number):
        return NUMBERS[kind.code]
    if isinstance(kind, Array):
        if isinstance(kind.of, Number):
            return f"{kind.count}{'s' if is_octets(kind) else NUMBERS[kind.of.code]}"
        return struct_format(kind.of) * kind.count
    if isinstance(kind, Record):
        parts, end, offsets = [], 0, offsets_of(kind)
        for name, field in kind.fields:
            parts += ["x" * (offsets[name] - end), struct_format(field)]
            end = offsets[name] + size_of(field)
        return "".join(parts) + "x" * (size_of(kind) - end)
    return f"{kind.size}s"


# --- The text that names a type --------------------------------------------------------------------------------------


def canonical(kind: Type) -> str:
    """The one text of a type, without blanks; `parse` reads it back. Contents without a layout name their size: ``bytes[64]``."""
    lengths = ""
    while isinstance(kind, Array):
        lengths += f"[{kind.count}]"
        kind = kind.of
    if isinstance(kind, Record):
        return "{" + ",".join(f"{name}:{canonical(field)}" for name, field in kind.fields) + "}" + lengths
    if isinstance(kind, Number):
        return kind.code + lengths
    return f"{'char' if isinstance(kind, Text) else kind.kind}{lengths}[{kind.size}]"


def of_table(written: Mapping[str, object] | str, place: str = "", depth: int = 0) -> Type:
    """The type that a person wrote: a text, or a table of fields.

    Args:
        place: the fields that lead here, for the message.

    Raises:
        ItemError: it is none; says which field, and what is possible.
    """
    if isinstance(written, str):
        return _Parser(written, place).whole(depth)
    if not isinstance(written, Mapping):
        raise ItemError(f"{_at(place)}{written!r} is no type; write a text such as 'f4[3]', or a table of fields", "type")
    fields = []
    for name, inner in written.items():
        if not isinstance(name, str):
            raise ItemError(f"{_at(place)}{name!r} cannot name a field; {_FIELD_RULE}", "type")
        below = f"{place}.{name}" if place else name
        if depth >= DEPTH_MAX:
            raise ItemError(f"{_at(below)}structs and arrays lie deeper than {DEPTH_MAX} in each other", "type")
        fields.append((name, of_table(inner, below, depth + 1)))  # type: ignore[arg-type]  # examined there
    return checked(record_of(fields, place))


def parse(text: str) -> Type:
    """The type of a text.

    Raises:
        ItemError: it is none; says what was expected, and where.
    """
    return _Parser(text, "").whole(0)


def record_of(fields: list[tuple[str, Type]], place: str = "") -> Record:
    """A struct of these fields.

    Raises:
        ItemError: it has none, too many, two of one name, or a name that C would refuse.
    """
    if not 1 <= len(fields) <= FIELDS_MAX:
        raise ItemError(f"{_at(place)}a struct of {len(fields)} fields; give it 1 to {FIELDS_MAX}", "type")
    seen = set()
    for name, kind in fields:
        if not _NAME.fullmatch(name) or len(name) > NAME_SIZE_MAX:
            raise ItemError(f"{_at(place)}{name[:80]!r} cannot name a field; {_FIELD_RULE}", "type")
        if name in seen:
            raise ItemError(f"{_at(place)}two fields are called {name!r}", "type")
        if isinstance(kind, Opaque):
            raise ItemError(
                f"{_at(f'{place}.{name}' if place else name)}{kind.kind!r} is no type of a field: it has no fixed size; "
                "write char[N] for text and u1[N] for bytes, or make the whole item of it",
                "type",
            )
        seen.add(name)
    return Record(tuple(fields))


def checked(kind: Type) -> Type:
    """The type itself.

    Raises:
        ItemError: its values are larger than an item may be.
    """
    size = size_of(kind)
    if not 1 <= size <= ITEM_SIZE_MAX:
        raise ItemError(f"a value of {size} bytes; an item holds 1 to {ITEM_SIZE_MAX}", "type")
    return kind


def _at(place: str) -> str:
    return f"field {place}: " if place else ""


_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FIELD_RULE: Final = f"use at most {NAME_SIZE_MAX} letters, digits and _, as in C"
_WORD: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_LENGTH: Final = re.compile(r"\[\s*([0-9]{1,6})\s*\]")
_BLANKS: Final = re.compile(r"[ \t\r\n]*")
TYPES_SAID: Final = f"{', '.join(NUMBERS)}, char[N], each with [N] behind it for an array, {{name:type,…}}"


class _Parser:
    """Reads one text from left to right."""

    def __init__(self, text: str, place: str) -> None:
        self._text = text
        self._place = place
        self._next = 0

    def whole(self, depth: int) -> Type:
        kind = self._type(depth)
        self._skip()
        if self._next < len(self._text):
            raise self._mistake("nothing more")
        return checked(kind)

    def _type(self, depth: int) -> Type:
        if depth > DEPTH_MAX:
            raise ItemError(f"{_at(self._place)}structs and arrays lie deeper than {DEPTH_MAX} in each other", "type")
        if self._takes("{"):
            return self._lengths(self._fields(depth), depth)
        word = self._word("a type")
        if word in OPAQUE:
            return self._opaque(word)
        if word == "char":
            return self._text_of(depth)
        if word not in NUMBERS:
            self._next -= len(word)
            raise self._mistake(f"a type ({TYPES_SAID}, or one of {', '.join(OPAQUE)} as a whole)")
        return self._lengths(Number(word), depth)

    def _fields(self, depth: int) -> Record:
        fields = []
        while True:
            name = self._word("a field's name")
            if not self._takes(":"):
                raise self._mistake(f"':' behind the field's name {name!r}")
            fields.append((name, self._type(depth + 1)))
            if self._takes("}"):
                return record_of(fields, self._place)
            if not self._takes(","):
                raise self._mistake("',' or '}'")

    def _opaque(self, word: str) -> Opaque:
        sizes = self._sizes()
        if len(sizes) > 1:
            raise self._mistake(f"one size behind {word}")
        return Opaque(word, sizes[0] if sizes else ITEM_SIZE_MAX)

    def _text_of(self, depth: int) -> Type:
        sizes = self._sizes()
        if not sizes:
            raise self._mistake("the most bytes of the text, as in char[16]")
        return self._arrays(Text(sizes[-1]), sizes[:-1], depth)

    def _lengths(self, kind: Type, depth: int) -> Type:
        return self._arrays(kind, self._sizes(), depth)

    def _arrays(self, kind: Type, sizes: list[int], depth: int) -> Type:
        if depth + len(sizes) > DEPTH_MAX + 1:
            raise ItemError(f"{_at(self._place)}structs and arrays lie deeper than {DEPTH_MAX} in each other", "type")
        for size in reversed(sizes):
            kind = checked(Array(kind, size))
        return kind

    def _sizes(self) -> list[int]:
        sizes = []
        self._skip()
        while self._text.startswith("[", self._next):
            found = _LENGTH.match(self._text, self._next)
            if found is None or not 1 <= int(found[1]) <= ITEM_SIZE_MAX:
                raise self._mistake(f"a number from 1 to {ITEM_SIZE_MAX} in brackets, as in [3]")
            sizes.append(int(found[1]))
            self._next = found.end()
            self._skip()
        return sizes

    def _word(self, what: str) -> str:
        self._skip()
        found = _WORD.match(self._text, self._next)
        if found is None:
            raise self._mistake(what)
        self._next = found.end()
        return found[0]

    def _takes(self, mark: str) -> bool:
        self._skip()
        if not self._text.startswith(mark, self._next):
            return False
        self._next += 1
        return True

    def _skip(self) -> None:
        found = _BLANKS.match(self._text, self._next)
        assert found is not None  # it matches nothing too
        self._next = found.end()

    def _mistake(self, expected: str) -> ItemError:
        rest = self._text[self._next :]
        found = repr(rest[:20]) if rest else "the end"
        return ItemError(
            f"{_at(self._place)}{self._text[:60]!r} is no type: at character {self._next + 1} stands {found}, "
            f"expected {expected}",
            "type",
        )
