"""Paths that rights are about, and patterns of them: ``*`` is one step, ``**`` any number of steps."""

from __future__ import annotations

from typing import Final

from failover.errors import RightsError

SIZE_MAX: Final = 200
"""Bytes of UTF-8: the limit of a component's name."""

DEPTH_MAX: Final = 16
"""Steps of a path."""

_SEPARATORS: Final = str.maketrans("→", "/")


def steps_of(path: str) -> tuple[str, ...]:
    """The steps of a path, in the form in which they are compared (NFKC).

    ``/lab/robot1/mapper``, ``lab/robot1/mapper`` and ``lab→robot1→mapper`` are the same path.

    Raises:
        RightsError: it is no path: empty, too long or too deep, with an empty or invisible step, with ``.`` or ``..``.
    """
    return tuple(_split(path, "path"))


def pattern_of(text: str) -> tuple[str, ...]:
    """The steps of a pattern; two ``**`` in a row are one.

    Raises:
        RightsError: as `steps_of`; or ``*`` stands inside a step.
    """
    found: list[str] = []
    for step in _split(text, "pattern of paths"):
        if "*" in step and step not in ("*", "**"):
            raise RightsError(f"{text!r} has the step {step!r}: '*' is one whole step, '**' any number of steps")
        if step != "**" or found[-1:] != ["**"]:
            found.append(step)
    return tuple(found)


def fits(pattern: tuple[str, ...], steps: tuple[str, ...]) -> bool:
    """Whether a pattern fits a path. Takes at most pattern × steps comparisons, whatever they hold."""
    reached = {0}  # places in the pattern from which the rest of it must fit the rest of the path
    for step in steps:
        nearer: set[int] = set()
        for place in _opened(pattern, reached):
            if place < len(pattern):
                if pattern[place] == "**":
                    nearer.add(place)
                elif pattern[place] in ("*", step):
                    nearer.add(place + 1)
        reached = nearer
    return len(pattern) in _opened(pattern, reached)


def _opened(pattern: tuple[str, ...], places: set[int]) -> set[int]:
    """These places, and those behind a ``**``, which may be no step at all."""
    return places | {place + 1 for place in places if place < len(pattern) and pattern[place] == "**"}


def _split(text: str, what: str) -> list[str]:
    normal = text.translate(_SEPARATORS)
    if not normal.isascii():
        import unicodedata  # half a megabyte, for paths that need it

        normal = unicodedata.normalize("NFKC", normal)
    steps = normal.removeprefix("/").split("/")
    try:
        size = len(text.encode())
    except UnicodeEncodeError:
        size = SIZE_MAX + 1
    if size > SIZE_MAX or len(steps) > DEPTH_MAX:
        raise RightsError(f"{text[:40]!r} is no {what}: at most {SIZE_MAX} bytes and {DEPTH_MAX} steps")
    for step in steps:
        if step in ("", ".", "..") or not step.isprintable():
            raise RightsError(f"{text!r} is no {what}: each step is visible text, not empty, and neither '.' nor '..'")
    return steps
