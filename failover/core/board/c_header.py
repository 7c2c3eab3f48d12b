"""Items as C and C++ declare them: structs, numbers, sizes, digests, and assertions that the compiler lays them out as we do."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from failover.core.board.item_types import NUMBERS, Array, Number, Opaque, Record, Text, Type, canonical, offsets_of
from failover.core.board.items import Board, Item
from failover.errors import ItemError

C_NUMBERS: Final = {
    code: "bool"
    if code == "bool"
    else {"f4": "float", "f8": "double"}.get(code) or f"{'u' * (code[0] == 'u')}int{8 * int(code[1])}_t"
    for code in NUMBERS
}
"""Name of a number → C's."""

KEYWORDS: Final = frozenset(
    """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl const constexpr const_cast continue
    decltype default delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline int long
    mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public register reinterpret_cast
    restrict return short signed sizeof static static_assert static_cast struct switch template this thread_local throw true try
    typedef typeid typename typeof union unsigned using virtual void volatile wchar_t while xor xor_eq
    """.split()  # noqa: SIM905
)
"""Of C and of C++: a field of such a name gets a ``_`` behind it."""

_ODD = re.compile(r"[^A-Za-z0-9]+")


def header(board: Board, team: str) -> str:
    """The text of a C header for the items of a team.

    Raises:
        ItemError: two items would have one name in C.
    """
    lines = [
        f'/* The items of team "{_commented(team)}". Written by: failover board header. Do not edit; write it anew instead. */',
        "#ifndef FAILOVER_ITEMS_H",
        "#define FAILOVER_ITEMS_H",
        "",
        "#include <assert.h>",
        "#include <stdbool.h>",
        "#include <stddef.h>",
        "#include <stdint.h>",
        "",
        f"#define FAILOVER_ITEMS_DIGEST UINT64_C(0x{board.digest:016x})",
        "",
    ]
    words: dict[str, str] = {}
    for number, item in enumerate(board.items):
        prefix = macro_of(item.name)
        if prefix in words:
            raise ItemError(f"items {words[prefix]!r} and {item.name!r} are both {prefix} in C; rename one", "name")
        words[prefix] = item.name
        lines += [*declaration(number, item), ""]
    return "\n".join([*lines, "#endif", ""])


def declaration(number: int, item: Item) -> list[str]:
    """The lines of one item."""
    name, prefix = type_name_of(item.name), macro_of(item.name)
    said = "shared" if item.shared is True else "private" if not item.shared else f"shared by {', '.join(item.shared)}"
    lines = [
        f"/* {_commented(item.name)}: {said}, period {item.period}; {_commented(canonical(item.layout))[:400]} */",
        f"#define {prefix}_ITEM {_quoted(item.name)}",
        f"#define {prefix}_NUMBER {number}",
        f"#define {prefix}_SIZE {item.size}",
        f"#define {prefix}_DIGEST UINT64_C(0x{item.type_digest:016x})",
    ]
    if isinstance(item.layout, Opaque):
        return lines
    lines += [f"typedef {declared(item.layout, name)};", _asserted(f"sizeof({name})", item.size)]
    if isinstance(item.layout, Record):
        lines += [_asserted(f"offsetof({name}, {path})", offset) for path, offset in offsets(item.layout)]
    return lines


def offsets(record: Record, prefix: str = "", begin: int = 0) -> Iterable[tuple[str, int]]:
    """Path of each field as C writes it → bytes from the beginning of the whole; fields of structs inside follow theirs."""
    for name, offset in offsets_of(record).items():
        kind, path = dict(record.fields)[name], f"{prefix}{field_of(name)}"
        yield path, begin + offset
        if isinstance(kind, Record):
            yield from offsets(kind, f"{path}.", begin + offset)


def declared(kind: Type, name: str) -> str:
    """A member or a type of this name, as C declares it, without the semicolon."""
    lengths = ""
    while isinstance(kind, Array):
        lengths += f"[{kind.count}]"
        kind = kind.of
    if isinstance(kind, Record):
        members = " ".join(f"{declared(field, field_of(inner))};" for inner, field in kind.fields)
        return f"struct {{ {members} }} {name}{lengths}"
    if isinstance(kind, Text):
        return f"char {name}{lengths}[{kind.size}]"
    assert isinstance(kind, Number)  # contents without a layout are no field
    return f"{C_NUMBERS[kind.code]} {name}{lengths}"


def field_of(name: str) -> str:
    """A field's name in C."""
    return f"{name}_" if name in KEYWORDS else name


def macro_of(item: str) -> str:
    """The prefix of an item's constants: ``ball.seen`` → ``BALL_SEEN``."""
    word = _ODD.sub("_", item).upper()
    return word if word[:1].isalpha() else f"ITEM_{word.strip('_')}"


def type_name_of(item: str) -> str:
    """The name of an item's type: ``ball.seen`` and ``BALL_SEEN`` → ``BallSeen``; ``cmdVel`` → ``CmdVel``."""
    parts = (
        [part for part in macro_of(item).split("_") if part] if item.isupper() else [part for part in _ODD.split(item) if part]
    )
    word = "".join(part.capitalize() if part.isupper() else part[:1].upper() + part[1:] for part in parts)
    return word if word[:1].isalpha() else f"Item{word}"


def _asserted(what: str, value: int) -> str:
    return f'static_assert({what} == {value}, "{what} is not {value} here: this processor lays structs out otherwise");'


def _commented(text: str) -> str:
    return text.replace("*/", "* /").replace("\n", " ")


def _quoted(text: str) -> str:
    """A text in C: anything but plain letters as its bytes in octal."""
    plain = "".join(chr(byte) if 32 <= byte < 127 and byte not in b'"\\?' else f"\\{byte:03o}" for byte in text.encode())
    return f'"{plain}"'
