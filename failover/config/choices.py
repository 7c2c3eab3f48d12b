"""Sentences about a value that is none of its choices: all of them, and the one that was probably meant."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

import msgspec

from checkpoint.sentences import near


def none_of(said: object, choices: Iterable[object]) -> str:
    """That a value is not one of these."""
    words = [str(choice) for choice in choices if choice != ""]
    return f"{said!r} is none of {', '.join(words)}{near(str(said), words)}"


def misfit(value: object, hint: Any, at: tuple[str, ...] = ()) -> tuple[tuple[str, ...], str] | None:
    """The innermost place at which a value is not of its type, and why; None where it is.

    Args:
        hint: as `msgspec.convert` takes it.
        at: where the value itself stands.
    """
    try:
        msgspec.convert(value, hint)
    except msgspec.ValidationError as error:
        for key, entry, kind in _entries(value, hint):
            if (found := misfit(entry, kind, (*at, key))) is not None:
                return found
        choices = list(_literals(hint))
        return at, none_of(value, choices) if choices else str(error).partition(" - at `")[0]
    return None


def _entries(value: object, hint: Any) -> Iterator[tuple[str, object, Any]]:
    """What a value is made of, each with its own type: keys that are chosen from a list before the entries that they name."""
    kinds = typing.get_args(hint) if _is_union(hint) else (hint,)
    if isinstance(value, list):
        tables = [inner for kind in kinds for inner in typing.get_args(kind) if dataclasses.is_dataclass(inner)]
        yield from ((str(number), entry, inner) for number, entry in enumerate(value) for inner in tables[:1])
    if not isinstance(value, Mapping):
        return
    for kind in kinds:
        if dataclasses.is_dataclass(kind) or (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            hints = typing.get_type_hints(kind, include_extras=True)
            yield from ((key, entry, hints[key]) for key, entry in value.items() if key in hints)
        elif typing.get_origin(kind) is dict:
            of_key, of_entry = typing.get_args(kind)
            yield from ((str(key), key, of_key) for key in value)
            yield from ((str(key), entry, of_entry) for key, entry in value.items())


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, type(int | str))


def _literals(hint: Any) -> Iterator[object]:
    """The words of a type that is a list of choices, perhaps beside a table."""
    for kind in typing.get_args(hint) if _is_union(hint) else (hint,):
        if typing.get_origin(kind) is Literal:
            yield from typing.get_args(kind)
