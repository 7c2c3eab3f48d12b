"""Names of robots and components, and the order W between robots that every robot computes alike."""

from __future__ import annotations

import re

from failover.errors import NameFormatError

ROBOT_SIZE_MAX = 63
"""Bytes of UTF-8: a beat carries many of them."""

COMPONENT_SIZE_MAX = 200
"""Bytes of UTF-8: one component's entry must fit a datagram together with the header and the echoes."""

_RUNS = re.compile(r"(\d+)")

Weight = tuple[tuple[tuple[int, int, str], ...], str, str]
"""The parts by which ``weight`` compares: the natural parts, then the normalised text, then the text as it was written."""


def weight(name: str) -> Weight:
    """The order of names: the lesser one wins a simultaneous claim.

    Natural (``robot2`` before ``robot10``), for any alphabet's digits, on the NFKC form; ties by code point, so that two
    names are equal only if they are the same text.
    """
    normal = name if name.isascii() else _normal(name)
    parts = tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in _RUNS.split(normal) if part)
    return parts, normal, name


def _normal(name: str) -> str:
    import unicodedata  # half a megabyte, for names that need it

    return unicodedata.normalize("NFKC", name)


def check_robot(name: str) -> str:
    """The name itself.

    Raises:
        NameFormatError: it is empty, too long, or holds "/" or something invisible.
    """
    if not name or "/" in name or not _visible(name) or text_size(name) > ROBOT_SIZE_MAX:
        raise NameFormatError(
            f"{name!r} cannot name a robot: use 1 to {ROBOT_SIZE_MAX} bytes of visible characters without blanks and '/'"
        )
    return name


def check_component(name: str) -> str:
    """The name itself.

    Raises:
        NameFormatError: it is not a path such as ``/lab/robot1/mapper``.
    """
    steps = name.split("/")
    sound = len(steps) > 1 and not steps[0] and all(step not in ("", ".", "..") and _visible(step) for step in steps[1:])
    if not sound or text_size(name) > COMPONENT_SIZE_MAX:
        raise NameFormatError(
            f"{name!r} cannot name a component: use a path such as /lab/robot1/mapper, at most {COMPONENT_SIZE_MAX} bytes, "
            "of visible characters without blanks, '.' and '..' standing alone"
        )
    return name


def _visible(text: str) -> bool:
    return text.isprintable() and not any(character.isspace() for character in text)


def text_size(text: str) -> int:
    """Bytes of UTF-8; a lone surrogate counts as too long, because it has none."""
    try:
        return len(text.encode())
    except UnicodeEncodeError:
        return COMPONENT_SIZE_MAX + 1
