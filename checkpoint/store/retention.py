"""Keep older checkpoints for people: some whole ones of each component, spread over a span of time. No robot needs them.

They lie in a folder of their own, as files that ``failover inspect`` and ``failover restore`` take. Invariant: the folder never
holds the newest checkpoint of its component, or one that the rules may go back to; so no robot needs a file that is deleted to
free space.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Final

from msgspec import Struct

from checkpoint.store.atomic_files import WholeFiles, disk_trouble

HISTORY_FOLDER: Final = "history"


class Retention(Struct, frozen=True):
    """How much is kept for people.

    Attributes:
        count: of each component; 0 keeps none.
        span_s: seconds over which they are spread: one every ``span_s / count``; older ones go.
        size_max: bytes of the whole store, what the rules need included; beyond it the oldest here go. 0: as much as there is.
    """

    count: int = 0
    span_s: int = 0
    size_max: int = 0

    @property
    def spacing_s(self) -> float:
        """Between two that are kept."""
        return self.span_s / self.count if self.count else 0.0


class Old(Struct, frozen=True):
    """One file. ``stored_s``: when it came, in seconds since 1970; ``size``: bytes."""

    path: Path
    stored_s: float
    size: int


class History:
    """The folder, and its files. May be called from any thread."""

    def __init__(self, root: Path, files: WholeFiles, retention: Retention) -> None:
        """
        Args:
            root: of the store.
        """
        self._root = root / HISTORY_FOLDER
        self._files = files
        self._retention = retention
        self._lock = threading.RLock()
        self._olds: dict[str, tuple[Old, ...]] = {}

    def read(self) -> None:
        """Find out what is there. Raises OSError."""
        for folder in sorted(self._root.iterdir()) if self._root.is_dir() else ():
            found = (Old(path, stored.st_mtime, stored.st_size) for path in folder.iterdir() for stored in (path.stat(),))
            self._olds[folder.name] = tuple(sorted(found, key=lambda old: old.stored_s))

    def of(self, folder: str) -> tuple[Old, ...]:
        """The snapshots kept of the component with this folder, oldest first."""
        return self._olds.get(folder, ())

    @property
    def size(self) -> int:
        """Bytes of all of them."""
        return sum(old.size for olds in list(self._olds.values()) for old in olds)

    def take(self, path: Path) -> bool:
        """Keep a whole checkpoint's file that the store gives away, if it is time for another one; False leaves it there.

        Raises OSError.
        """
        with self._lock:
            stored, olds = path.stat(), self.of(path.parent.name)
            due = not olds or stored.st_mtime - olds[-1].stored_s >= self._retention.spacing_s
            if not self._retention.count or not due:
                return False
            final = self._root / path.parent.name / path.name
            self._files.move(path, final)
            self._olds[path.parent.name] = (*olds, Old(final, stored.st_mtime, stored.st_size))
            return True

    def is_too_much(self, folder: str, now_s: float, store_size: int) -> bool:
        """Whether `thin` or `shrink` would remove something; the disk is not asked."""
        olds, kept = self.of(folder), self._retention
        is_long = bool(olds) and (len(olds) > kept.count or now_s - olds[0].stored_s > kept.span_s)
        return is_long or bool(kept.size_max and store_size + self.size > kept.size_max and any(list(self._olds.values())))

    def thin(self, folder: str, now_s: float) -> None:
        """Remove what is too many of one component, or too old. Raises StoreError."""
        with self._lock:
            olds = self.of(folder)
            fresh = [old for old in olds if now_s - old.stored_s <= self._retention.span_s]
            kept = fresh[-self._retention.count :] if self._retention.count else []
            self._remove(folder, [old for old in olds if old not in kept])

    def shrink(self, store_size: int) -> None:
        """Remove the oldest of all components while they and ``store_size`` bytes are over the limit. Raises StoreError."""
        limit = self._retention.size_max
        while limit and store_size + self.size > limit and self.give_room():
            pass

    def make_room(self, size: int) -> None:
        """Remove the oldest ones until the disk has room for ``size`` bytes, or none is left. Raises StoreError."""
        while self._free() < size and self.give_room():
            pass

    def give_room(self) -> bool:
        """Remove the oldest of all; False if there is none. Raises StoreError."""
        with self._lock:
            first = [(olds[0].stored_s, folder) for folder, olds in self._olds.items() if olds]
            if not first:
                return False
            folder = min(first)[1]
            self._remove(folder, [self._olds[folder][0]])
            return True

    def forget(self, folder: str) -> None:
        """Remove all of one component. Raises StoreError."""
        with self._lock:
            self._remove(folder, self.of(folder))

    def _remove(self, folder: str, olds: list[Old] | tuple[Old, ...]) -> None:
        with disk_trouble(f"remove old snapshots in {self._root / folder}"):
            for old in olds:
                self._files.remove(old.path)
                self._olds[folder] = tuple(one for one in self._olds[folder] if one != old)

    def _free(self) -> int:
        with disk_trouble(f"ask how much room {self._root.parent} has"):
            disk = os.statvfs(self._root.parent)
        return disk.f_bavail * disk.f_frsize
