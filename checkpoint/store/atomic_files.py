"""Write files that appear under their names whole or not at all, at any power loss. The store defines their content."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Final

from checkpoint.errors import StoreError
from checkpoint.store.disk import Disk, DiskFile, with_cure

TEMPORARY_PREFIX: Final = "arriving-"
"""Begins the name of a file that is not whole yet; such files are removed when the store is opened."""


class WholeFiles:
    """Writes and removes the files of one store, and knows which were found damaged. May be called from any thread."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._lock = threading.Lock()
        self._serial = count()
        self._damaged: set[Path] = set()

    def write(self, final: Path, fill: Callable[[DiskFile], object], unnamed: int | None = None) -> int:
        """Make a file appear under its name, whole and durable, or not at all; answer its size.

        1. Written under a temporary name, so that its own name never stands for a part.
        2. Its content is synced before it is renamed: a name that survived has its content.
        3. The folder is synced before we return: an acknowledgement outlives a power cut.

        Args:
            fill: writes the content.
            unnamed: descriptor of a file that has the content already; it gets the name where that is possible.

        Raises:
            StoreError: the disk does not take it; nothing of it is left.
        """
        with disk_trouble(f"write {final}"):
            self._ensure_folder(final.parent)
            temporary = final.parent / f"{TEMPORARY_PREFIX}{next(self._serial)}"
            try:
                size = self._write_temporary(temporary, fill, unnamed)
                with self._lock:
                    self._disk.rename(temporary, final)
                    self._damaged.discard(final)
            except BaseException:
                self._disk.remove(temporary)
                raise
            self._disk.sync_folder(final.parent)
            return size

    def _write_temporary(self, temporary: Path, fill: Callable[[DiskFile], object], unnamed: int | None) -> int:
        """Write and sync, or sync and name what is written already."""
        if unnamed is not None and self._disk.is_unnamed(unnamed):
            self._disk.sync_file(unnamed)
            if self._disk.name(unnamed, temporary):
                return os.fstat(unnamed).st_size
        descriptor = self._disk.create(temporary)
        try:
            fill(DiskFile(self._disk, descriptor))
            self._disk.sync_file(descriptor)
            return os.fstat(descriptor).st_size
        finally:
            os.close(descriptor)

    def _ensure_folder(self, folder: Path) -> None:
        with self._lock:  # the folder of files set aside belongs to all components
            if not folder.is_dir():
                self._disk.make_folder(folder)
                self._disk.sync_folder(folder.parent)

    def move(self, path: Path, final: Path) -> None:
        """Give a whole file another name, two folders deep in the store at most. Raises OSError."""
        self._ensure_folder(final.parent.parent)
        self._ensure_folder(final.parent)
        with self._lock:
            self._disk.rename(path, final)
        self._disk.sync_folder(final.parent)
        self._disk.sync_folder(path.parent)

    def remove(self, path: Path) -> None:
        """Remove a file; one that is gone already is fine. Raises OSError."""
        self._disk.remove(path)

    def set_out_of_use(self, path: Path) -> None:
        """It was found damaged; a whole file that is put under its name is not."""
        with self._lock:
            self._damaged.add(path)

    @property
    def are_damaged(self) -> bool:
        """Whether any file is set out of use."""
        return bool(self._damaged)

    def remove_damaged(self, folder: Path, is_old: Callable[[Path], bool]) -> None:
        """Remove files that were set out of use; one that has been put again since is no longer among them. Raises OSError."""
        with self._lock:
            for path in [path for path in self._damaged if path.parent == folder and is_old(path)]:
                self._disk.remove(path)
                self._damaged.discard(path)


@contextmanager
def disk_trouble(tried: str) -> Iterator[None]:
    """Turn what the kernel says into one sentence."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot {tried}: {with_cure(error)}; the snapshots in the store are intact") from error
