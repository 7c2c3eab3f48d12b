"""The index of a store for one component, as values: the files, the chains that they make, the positions that can be restored.

Pure: `checkpoint.store.store` reads and writes the files, this module says what they mean.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

from blake3 import blake3
from msgspec import Struct

from checkpoint.model import Position
from checkpoint.snapshot.canonical_state import Header

BASE_SUFFIX = ".base"
DELTA_SUFFIX = ".delta"
SUFFIXES = (BASE_SUFFIX, DELTA_SUFFIX)

FOLDER_PREFIX = "@"
"""Begins the name of a component's folder, so that no component is called "..", "lock" or "aside"."""

MAX_NAME_SIZE = 160
"""Bytes of a folder's name; a component whose encoded path is longer is cut and told apart by a digest."""


class Entry(Struct, frozen=True):
    """One snapshot file.

    Attributes:
        size: bytes of the file; ``stored_s``: when it came, in seconds since 1970.
        pages_size: bytes of the pages that it tells, which the file holds compressed.
    """

    path: Path
    position: Position
    parent: Position | None
    epoch: int
    size: int
    stored_s: float = 0.0
    pages_size: int = 0

    @property
    def order(self) -> tuple[int, int, int]:
        """Later is greater: a later primacy counts before a later capture."""
        return self.epoch, self.position.generation, self.position.sequence


class Shelf(Struct, frozen=True, dict=True):
    """The intact files of one component, in no particular order. The work of every answer is linear in their number."""

    component: str
    entries: tuple[Entry, ...] = ()

    def with_entry(self, entry: Entry) -> Shelf:
        """The shelf after a file came."""
        return Shelf(self.component, (*self.entries, entry))

    def without(self, gone: Iterable[Entry]) -> Shelf:
        """The shelf after files went."""
        removed = set(gone)
        return Shelf(self.component, tuple(entry for entry in self.entries if entry not in removed))

    def positions(self) -> tuple[Position, ...]:
        """The positions that can be restored, oldest first."""
        return tuple(entry.position for entry in self._restorable)

    def newest(self) -> Position | None:
        """The newest position that can be restored."""
        return max(self._restorable, key=lambda entry: entry.order).position if self._restorable else None

    def chain_to(self, position: Position) -> tuple[Entry, ...]:
        """The files that lead to a position, a base first; empty where the chain is not whole."""
        chain: list[Entry] = []
        wanted: Position | None = position
        while wanted is not None:
            entry = self._by_position.get(wanted)
            if entry is None:
                return ()
            chain.append(entry)
            wanted = entry.parent
        return tuple(reversed(chain))

    def unneeded_for(self, oldest: Position) -> tuple[Entry, ...]:
        """Files without which ``oldest`` and everything later can still be restored; none if it cannot be restored itself."""
        floor, best = self.order_of(oldest), self._by_position
        if floor is None:
            return ()
        needed: set[Position] = set()
        for kept in self._restorable:
            wanted = kept.position if kept.order >= floor else None
            while wanted is not None and wanted not in needed:
                needed.add(wanted)
                wanted = best[wanted].parent
        return tuple(entry for entry in self.entries if entry.position not in needed or best[entry.position] is not entry)

    def order_of(self, position: Position) -> tuple[int, int, int] | None:
        """Where a position stands in the order of the files; None if it cannot be restored."""
        return next((entry.order for entry in self._restorable if entry.position == position), None)

    @cached_property
    def _restorable(self) -> tuple[Entry, ...]:
        """One file for every position whose chain is whole, oldest first.

        A parent is before its child in every file (``validity``): it is decided before the child.
        """
        whole: dict[Position, Entry] = {}
        for entry in sorted(self._by_position.values(), key=lambda entry: entry.position):
            if entry.parent is None or entry.parent in whole:
                whole[entry.position] = entry
        return tuple(sorted(whole.values(), key=lambda entry: entry.order))

    @cached_property
    def _by_position(self) -> dict[Position, Entry]:
        """The best file for each position: a base before a delta."""
        best: dict[Position, Entry] = {}
        for entry in self.entries:
            known = best.get(entry.position)
            if known is None or (known.parent is not None and entry.parent is None):
                best[entry.position] = entry
        return best


def folder_name(component: str) -> str:
    """A component's path as one safe file name, which begins with ``FOLDER_PREFIX``."""
    name = FOLDER_PREFIX + quote(component, safe="")
    if len(name) <= MAX_NAME_SIZE:
        return name
    digest = blake3(component.encode()).hexdigest(length=16)
    return f"{name[: MAX_NAME_SIZE - len(digest) - 1]}~{digest}"


def file_name(header: Header) -> str:
    """The name of a snapshot's file: sorts by age, says which position it is and whether it stands alone."""
    position = header.position
    suffix = BASE_SUFFIX if header.is_base else DELTA_SUFFIX
    return f"{header.epoch:016x}-{position.generation:016x}-{position.sequence:016x}-{position.digest.hex()}{suffix}"


def order_of_name(name: str) -> tuple[int, int, int] | None:
    """``Entry.order`` as a file's name says it, for a file whose content cannot be believed; None if it is no such name."""
    parts = name.split("-")
    try:
        epoch, generation, sequence = (int(part, 16) for part in parts[:3])
    except ValueError:
        return None
    return epoch, generation, sequence
