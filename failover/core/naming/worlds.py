"""Worlds besides the real one: simulated robots have paths below ``Simulated/``, and files of their own on the board.

A program with ``FAILOVER_WORLD=Simulated`` lives there: its paths get ``Simulated/`` before them, its board has simulated robots.
"""

from __future__ import annotations

from typing import Final

from failover.errors import NameFormatError

VARIABLE: Final = "FAILOVER_WORLD"

SIMULATED: Final = "Simulated"
"""The first step of all paths of simulated things; no robot's own."""


def checked(world: str) -> str:
    """A world as $FAILOVER_WORLD names it; "": the real one.

    Raises:
        NameFormatError: it could be taken for something real.
    """
    normal = world.strip("/")
    if normal and not is_simulated(normal):
        raise NameFormatError(f"{VARIABLE}={world!r} names no simulated world: write {SIMULATED}, or {SIMULATED}/NAME")
    if any(step in ("", ".", "..") or any(letter.isspace() for letter in step) for step in normal.split("/") if normal):
        raise NameFormatError(f"{VARIABLE}={world!r} names no world: a step of it is empty, '.', '..', or holds a blank")
    return normal


def is_simulated(path: str) -> bool:
    """Whether a path in normal form belongs to something simulated."""
    return path == SIMULATED or path.startswith(f"{SIMULATED}/")


def within(world: str, path: str) -> str:
    """A path in normal form as it is in a world: below it. One that is below it already stays."""
    return path if not world or path == world or path.startswith(f"{world}/") else f"{world}/{path}"


def guest(world: str, robot: str = "") -> str:
    """What a robot of a world is called beside the real ones, ``Simulated.Robotino``; without a robot: how these names begin."""
    return f"{world.replace('/', '.')}.{robot}"
