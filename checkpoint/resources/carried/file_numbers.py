"""Update device and inode numbers in the program's memory: carried files have other numbers after a restore.

Some programs check whether a path still leads to the file that they hold, by the numbers that fstat(2) once reported: sqlite
refuses to write to a database that was "moved" (SQLITE_READONLY_DBMOVED). Such numbers are in memory as the kernel reported them,
device first and inode next to it (struct stat; unixFileId in sqlite's os_unix.c): eight bytes each, aligned. The restore replaces
both where they are side by side and belong to a carried file. Small inodes, as on a fresh tmpfs, could be any other numbers: the
restore leaves them unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from msgspec.structs import replace

from checkpoint.model import Snapshot

INODE_MIN: Final = 4096
"""Smaller numbers stand beside each other in memory for many reasons."""

Identity = tuple[int, int]
"""Device and inode."""


def renewed(program: Snapshot, identities: Mapping[Identity, Identity]) -> tuple[Snapshot, int]:
    """The same base with the new numbers of files where its memory holds the old ones, and at how many places that was.

    Args:
        identities: of each carried file, then and now.
    """
    moved = {old: new for old, new in identities.items() if old != new and old[1] >= INODE_MIN}
    if not moved or not len(program.contents):
        return program, 0
    words = np.frombuffer(program.contents, dtype="<u8")
    devices, inodes = (np.array(list(numbers), dtype=np.uint64) for numbers in zip(*moved, strict=True))
    places = np.flatnonzero(np.isin(words[1:], inodes))
    places = places[np.isin(words[places], devices)]
    found = [(place, moved[old]) for place in places.tolist() if (old := (int(words[place]), int(words[place + 1]))) in moved]
    if not found:
        return program, 0
    changed = words.copy()
    for place, new in found:
        changed[place : place + 2] = new
    return replace(program, contents=changed.view(np.uint8).data.toreadonly()), len(found)
