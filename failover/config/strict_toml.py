"""Reads TOML files that a person writes into frozen dataclasses, and names every mistake with file, line and cure."""

from __future__ import annotations

import dataclasses
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from checkpoint.errors import UNDECODABLE
from checkpoint.sentences import near
from failover.config.choices import misfit
from failover.errors import FileMistakeError

T = TypeVar("T")
SIZE_LIMIT: Final = 1 << 20
"""Bytes; no configuration of ours comes near."""

_WORD = re.compile(r"^\w+")
_MSGSPEC_PATH = re.compile(r" - at `\$(?P<path>[^`]*)`$")
_KEY = re.compile(r"""^\s*(?P<path>(?:"[^"]*+"|'[^']*+'|[\w\-]++|\s*+\.\s*+)++)\s*=""")
_TABLE = re.compile(r"^\s*\[\[?(?P<path>[^\]]+)\]\]?")
_BARE = re.compile(r"[\w-]+")
_PART = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([\w-]+))\s*(?:\.|$)""")


def read(path: Path, kind: type[T]) -> T:
    """Read one file as ``kind``, a frozen dataclass whose fields are its keys.

    Raises:
        FileMistakeError: it is missing, no TOML, holds an unknown key or a value of the wrong kind, or refuses itself
            (a ValueError from ``__post_init__``).
    """
    text = _text(path)
    try:
        table = tomllib.loads(text)
    except UNDECODABLE as error:  # also a number of thousands of digits, and tables in tables without end
        raise FileMistakeError(f"{path}: this is not TOML: {error}") from error
    for keys, valid in _unknown(table, kind, ()):
        raise FileMistakeError(_unknown_key(path, text, keys, valid))
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        keys, said = misfit(table, kind) or ((), "")
        if keys:
            raise FileMistakeError(f"{path}:{line_of(text, keys)}: {_spelled(keys)}: {said}") from error
        raise FileMistakeError(_wrong_value(path, text, str(error))) from error


def place_of(path: Path, keys: tuple[str, ...]) -> str:
    """ "file:line: key" of a key in a file that was read, for what its reader finds out afterwards."""
    return f"{path}:{line_of(_text(path), keys)}: {_spelled(keys)}"


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(SIZE_LIMIT).decode()
    except FileNotFoundError as error:
        raise FileMistakeError(f"{path}: there is no such file; see the commented agent.toml for what belongs in it") from error
    except OSError as error:
        raise FileMistakeError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise FileMistakeError(f"{path}: is not UTF-8 text ({error.reason} at byte {error.start})") from error


def _unknown(table: Mapping[str, Any], kind: Any, at: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """Every key that no field answers to, with the keys that would have been valid there."""
    hints = typing.get_type_hints(kind)
    valid = [field.name for field in dataclasses.fields(kind)]
    for key, value in table.items():
        if key not in valid:
            yield (*at, key), valid
            continue
        inner = _nested(hints[key])
        if inner is not None and isinstance(value, dict):
            named = typing.get_origin(_plain(hints[key])) is not None
            for name, entry in value.items() if named else [("", value)]:
                if isinstance(entry, dict):
                    yield from _unknown(entry, inner, (*at, key, name) if named else (*at, key))
        elif inner is not None and isinstance(value, list):
            for number, entry in enumerate(value):
                if isinstance(entry, dict):
                    yield from _unknown(entry, inner, (*at, key, str(number)))


def _plain(hint: Any) -> Any:
    """The type without an "or None"; of several, the one that is a table."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        return next((kind for kind in kinds if dataclasses.is_dataclass(kind)), kinds[0])
    return hint


def _nested(hint: Any) -> Any:
    """The dataclass that a table, or every entry of a table or an array of tables, must be; None for plain values."""
    hint = _plain(hint)
    if dataclasses.is_dataclass(hint):
        return hint
    arguments = [argument for argument in typing.get_args(hint) if argument is not Ellipsis]
    entry = _plain(arguments[-1]) if arguments else None
    return entry if dataclasses.is_dataclass(entry) else None


def _unknown_key(path: Path, text: str, keys: tuple[str, ...], valid: list[str]) -> str:
    cure = near(keys[-1], valid) or "; valid here: " + ", ".join(valid)
    return f"{path}:{line_of(text, keys)}: unknown key {keys[-1]!r}{cure}"


def _spelled(keys: tuple[str, ...]) -> str:
    """Keys as a file has them."""
    return ".".join(key if _BARE.fullmatch(key) else f'"{key}"' for key in keys)


def _wrong_value(path: Path, text: str, message: str) -> str:
    found = _MSGSPEC_PATH.search(message)
    keys = tuple(part for part in re.split(r"[.\[\]]+", found["path"]) if part and part != "...") if found else ()
    said = message[: found.start()] if found else message
    named = keys or tuple(_WORD.findall(said)[:1])  # what a file refuses itself for begins with the key
    line = line_of(text, named) if named else 1
    return f"{path}:{line}: {'.'.join(keys) + ': ' if keys else ''}{said}"


def line_of(text: str, keys: tuple[str, ...]) -> int:
    """The line on which a key stands, from 1; of its table, or the nearest, if the key itself is not found.

    Inner names that are not known exactly (msgspec says only "some entry") match any table. A table of an array (``[[rules]]``)
    has its number, from 0, as its last name: ("rules", "2").
    """
    table: tuple[str, ...] = ()
    numbers: dict[tuple[str, ...], int] = {}
    best = 1
    for number, line in enumerate(text.splitlines(), 1):
        header = _TABLE.match(line)
        if header is not None:
            table = _split(header["path"])
            if line.lstrip().startswith("[["):
                numbers[table] = numbers.get(table, -1) + 1
                table = (*table, str(numbers[table]))
            if table == keys:
                return number
            best = number if best == 1 and _is_near(table, keys) else best
            continue
        key = _KEY.match(line)
        if key is None:
            continue
        path = (*table, *_split(key["path"]))
        if path[-1] == keys[-1] and _fits(path[:-1], keys[:-1]):
            return number
        best = number if path == keys[: len(path)] else best
    return best


def _is_near(table: tuple[str, ...], keys: tuple[str, ...]) -> bool:
    """Whether a table is within the one that is looked for, holds it, or has the name of what is looked for."""
    shared = min(len(table), len(keys))
    return (shared > 1 and table[:shared] == keys[:shared]) or (table[:1] == keys[:1] and table[-1] == keys[-1])


def _fits(table: tuple[str, ...], wanted: tuple[str, ...]) -> bool:
    return table == wanted or (len(table) > len(wanted) and table[: len(wanted)] == wanted)


def _split(path: str) -> tuple[str, ...]:
    return tuple(quoted or literal or bare for quoted, literal, bare in _PART.findall(path))
