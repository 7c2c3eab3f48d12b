"""Changes valid messages and files into hostile ones; pure: all chance comes from the caller's dice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random
from typing import Any, Final, Literal

import msgspec

Form = Literal["bytes", "text", "json", "msgpack"]
"""How much a change knows of its content: nothing; that it is words and lines; that it is a tree of values."""

SIZE_MAX: Final = 64 << 10
"""Bytes of a case: what a decoder may do with so few is limited (`tests.fuzz.child`)."""

CHANGES: Final = (1, 1, 1, 2, 3, 5)
DEPTHS: Final = (40, 1_100, 12_000)
"""Levels of nesting: some, more than Python's own limit, more than a stack of 8 MB holds."""

NUMBERS: Final = (0, 1, -1, 2, 127, 128, 255, 256, 32_767, 65_535, 65_536, *(1 << n for n in (31, 32, 53, 62, 63)), -(1 << 63))
LIMITS: Final = (*NUMBERS, *((1 << n) - 1 for n in (31, 32, 53, 63, 64)), (1 << 64) - 1)
ODD_TEXTS: Final = (
    "",
    "\0",
    "..",
    "/",
    "//",
    "../" * 40,
    "é",
    "\u202e",
    "x" * 300,
    "9" * 5_000,
    "1e999",
    "nan",
    "-0",
    "\n",
    "%s",
    "{}",
)
ODD_VALUES: Final = (None, True, False, 0.5, -0.0, 1e308, float("inf"), float("nan"), [], {}, [[]], b"")
PIECES: Final = (
    b"\x00",
    b"\xff",
    b"\xc1",
    b"\x80",
    b"\xff" * 4,
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
)
WORDS: Final = (
    "[",
    "]",
    "{",
    "}",
    '"',
    "'",
    "=",
    ",",
    ";",
    ":",
    "#",
    "\n",
    "\\",
    "\\u0000",
    "/",
    "-",
    ".",
    "0x",
    "1e9",
    "null",
    "[[",
    "]]",
)
DEEP: Final = "DEEP"
"""A text in a tree that stands for deep nesting: no encoder writes that by itself."""


def mutated(content: bytes, dice: Random, form: Form, others: Sequence[bytes] = ()) -> bytes:
    """A changed copy, of `SIZE_MAX` bytes at most.

    Args:
        others: contents of which it may get a part.
    """
    for _ in range(dice.choice(CHANGES)):
        content = _change(dice, form)(content, dice, others)[:SIZE_MAX]
    return content


def _change(dice: Random, form: Form) -> Callable[[bytes, Random, Sequence[bytes]], bytes]:
    if form in ("json", "msgpack") and dice.random() < 0.7:
        return _in_json if form == "json" else _in_msgpack
    if form in ("text", "json") and dice.random() < 0.7:
        return dice.choice((_put_word, _put_word, _repeat_line, _drop_line, _nest_text, _long_number))
    return dice.choice(_OF_BYTES)


# --- Bytes -----------------------------------------------------------------------------------------------------------


def _flip(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(dice.randint(1, 4)):
        changed[dice.randrange(len(changed))] ^= 1 << dice.randrange(8)
    return bytes(changed)


def _cut(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    return content[: dice.randint(0, len(content))]


def _remove(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    at = dice.randint(0, len(content))
    return content[:at] + content[at + dice.choice((1, 2, 4, 8, 64)) :]


def _insert(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    at = dice.randint(0, len(content))
    piece = dice.choice((*PIECES, dice.randbytes(dice.randint(1, 8))))
    return content[:at] + piece + content[at + dice.choice((0, len(piece))) :]


def _number(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    """A whole number of a fixed size, at its limit or a little beside what it was."""
    size, order = dice.choice((1, 2, 4, 8)), dice.choice(("little", "big"))
    at = dice.randint(0, max(len(content) - size, 0))
    old = int.from_bytes(content[at : at + size], order)
    new = dice.choice((*LIMITS, old + 1, old - 1, old * 2, len(content), len(content) - at, old + len(content)))
    return content[:at] + (new % 256**size).to_bytes(size, order) + content[at + size :]


def _splice(content: bytes, dice: Random, others: Sequence[bytes]) -> bytes:
    """The beginning of one with the end of another one, or a part of it put in."""
    other = dice.choice(others) if others else content
    at, begin = dice.randint(0, len(content)), dice.randint(0, len(other))
    return content[:at] + other[begin : dice.choice((begin + 16, begin + 256, len(other)))] + dice.choice((b"", content[at:]))


def _repeat(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    at = dice.randint(0, len(content))
    piece = content[at : at + dice.choice((1, 4, 32, 512))]
    return content[:at] + piece * dice.choice((2, 3, 100, 4_000)) + content[at:]


def _nest_bytes(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    at = dice.randint(0, len(content))
    return content[:at] + dice.choice((b"\x91", b"\x81\xa1a", b"[", b"{")) * dice.choice(DEPTHS) + content[at:]


_OF_BYTES: Final = (_flip, _flip, _cut, _remove, _insert, _insert, _number, _number, _splice, _repeat, _nest_bytes)


# --- Words and lines -------------------------------------------------------------------------------------------------


def _put_word(content: bytes, dice: Random, others: Sequence[bytes]) -> bytes:
    """A word in the place of another one; both are what stands between blanks and marks."""
    text = content.decode(errors="replace")
    known = "".join(one.decode(errors="replace")[:4_096] for one in dice.sample(list(others), min(len(others), 2)))
    word = dice.choice((*WORDS, *ODD_TEXTS, *(str(number) for number in LIMITS), *_words(known)[:40]))
    found = _words(text)
    if not found or dice.random() < 0.3:
        at = dice.randint(0, len(text))
        return (text[:at] + word + text[at:]).encode(errors="replace")
    old = dice.choice(found)
    at = text.find(old, dice.randint(0, len(text)))
    at = text.find(old) if at < 0 else at
    return (text[:at] + word + text[at + len(old) :]).encode(errors="replace")


def _words(text: str) -> list[str]:
    for mark in "\"'[]{}(),;:=\n\t":
        text = text.replace(mark, " ")
    return text.split()


def _repeat_line(content: bytes, dice: Random, others: Sequence[bytes]) -> bytes:
    lines = content.splitlines(keepends=True) or [b"\n"]
    more = dice.choice(others).splitlines(keepends=True) if others else lines
    lines.insert(dice.randint(0, len(lines)), dice.choice(more or lines) * dice.choice((1, 1, 2, 500)))
    return b"".join(lines)


def _drop_line(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    lines = content.splitlines(keepends=True)
    if lines:
        del lines[dice.randrange(len(lines))]
    return b"".join(lines)


def _nest_text(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    at = dice.choice((len(content), dice.randint(0, len(content)), content.find(b"=") + 1, content.find(b":") + 1))
    opening, closing = dice.choice(
        ((b"[", b"]"), (b"(", b")"), (b"{", b"}"), (b'{"a":', b"}"), (b"{a=", b"}"), (b"-", b""), (b"!", b""))
    )
    depth = dice.choice(DEPTHS)
    return content[:at] + opening * depth + b"1" + closing * dice.choice((0, depth)) + content[at:]


def _long_number(content: bytes, dice: Random, _others: Sequence[bytes]) -> bytes:
    """A number of some thousand digits, in the place of one: Python refuses to read it (sys.get_int_max_str_digits)."""
    places = [at for at, byte in enumerate(content) if 0x30 <= byte <= 0x39] or [len(content)]
    at = dice.choice(places)
    return content[:at] + b"1" * dice.choice((20, 400, 5_000)) + content[at + 1 :]


# --- Trees of values -------------------------------------------------------------------------------------------------


def _in_json(content: bytes, dice: Random, others: Sequence[bytes]) -> bytes:
    try:
        changed = msgspec.json.encode(_changed(msgspec.json.decode(content), dice, others))
    except (ValueError, TypeError, RecursionError):
        return dice.choice(_OF_BYTES)(content, dice, others)
    depth = dice.choice(DEPTHS)
    return changed.replace(b'"DEEP"', b"[" * depth + b"1" + b"]" * depth)


def _in_msgpack(content: bytes, dice: Random, others: Sequence[bytes]) -> bytes:
    try:
        changed = msgspec.msgpack.encode(_changed(msgspec.msgpack.decode(content), dice, others))
    except (ValueError, TypeError, RecursionError, OverflowError):
        return dice.choice(_OF_BYTES)(content, dice, others)
    return changed.replace(b"\xa4DEEP", b"\x91" * dice.choice(DEPTHS) + b"\x01")


def _changed(tree: Any, dice: Random, others: Sequence[bytes]) -> Any:
    """The tree with one of its values, found by going down, changed."""
    if isinstance(tree, dict) and tree and dice.random() < 0.85:
        key = dice.choice(list(tree))
        act = dice.random()
        if act < 0.1:
            return {name: value for name, value in tree.items() if name != key}
        if act < 0.2:
            return {**tree, dice.choice((*ODD_TEXTS, *LIMITS)): tree[key]}
        return {**tree, key: _changed(tree[key], dice, others)}
    if isinstance(tree, list) and tree and dice.random() < 0.85:
        at = dice.randrange(len(tree))
        act = dice.random()
        if act < 0.1:
            return tree[:at] + tree[at + 1 :]
        if act < 0.2:
            return tree[:at] + [tree[at]] * dice.choice((2, 3, 300)) + tree[at:]
        return [*tree[:at], _changed(tree[at], dice, others), *tree[at + 1 :]]
    return _other_value(tree, dice, others)


def _other_value(value: Any, dice: Random, others: Sequence[bytes]) -> Any:
    act = dice.random()
    if act < 0.08:
        return DEEP
    if act < 0.6:
        if isinstance(value, int) and not isinstance(value, bool):
            return dice.choice((*LIMITS, value + 1, value - 1, value * 2, -value))
        if isinstance(value, str):
            at = dice.randint(0, len(value))
            return dice.choice((*ODD_TEXTS, value[:at], value[:at] + dice.choice(ODD_TEXTS) + value[at:], value * 2))
        if isinstance(value, bytes):
            return mutated(value, dice, "msgpack" if dice.random() < 0.5 else "bytes", others)
    return dice.choice((*ODD_VALUES, *ODD_TEXTS[:8], *LIMITS, value, [value], {"": value}))
