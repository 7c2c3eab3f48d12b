"""Parts of sentences for people: the kernel's words, and the name that was probably meant."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

AS_SOON_AS: Final = "failover captures it as soon as"
"""Begins the cure of a refusal for a moment only: that moment's end follows."""

_KEPT: Final = frozenset("\n\t\xa0")


def visible(text: str) -> str:
    """The text, with what cannot be seen written out (``\\x1b``): what a program said gives a terminal no orders."""
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() or one in _KEPT else ascii(one)[1:-1] for one in text)


def in_words(error: BaseException) -> str:
    """An error as people read it: what the kernel says without its number, and a file's name as text, also where it was bytes."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    named = [
        name.decode(errors="surrogateescape") if isinstance(name, bytes) else str(name)
        for name in (error.filename, error.filename2)
        if name is not None
    ]
    return error.strerror + (f" ({', '.join(named)})" if named else "")


def copy_outdated(why: str, component: str = "") -> str:
    """Why the ready copy of a component cannot be brought on, and what to do."""
    return f"the ready copy{f' of {component}' if component else ''} must be built again: {why}"


def near(said: str, choices: Iterable[str]) -> str:
    """The question whether one of the choices was meant, to be added to a sentence; "" where none is near."""
    import difflib  # for a mistake only

    found = difflib.get_close_matches(said, list(choices), 1)
    return f"; did you mean {found[0]!r}?" if found else ""
