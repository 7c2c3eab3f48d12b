"""An open file that several processes share: the first process describes the file, the others only refer to it.

Facts: ``descriptors``; ``description``: the number that it has in all of them; ``path``: the kernel's name for it.
"""

from __future__ import annotations

from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.model import Resource
from checkpoint.resources.open_file import OpenFile, Surroundings

KIND: Final = "shared"
CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "open files, pipes and sockets that several processes of a program share, or that connect them",
        "shared as before, with one offset; data that waits in them comes back",
    ),
)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The resource that names it as the same open file."""
    if not held.is_echo:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "description": held.description, "path": held.first.target})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Refuse nothing here: the first process that has it does."""
    return None
