"""The contract of the place where an archive's objects lie; ``tests/contracts/test_object_stores.py`` holds each kind to it.

An object has a name, words with ``/`` between them, and a content. It stands under its name whole or not at all, and is never
changed: the first `ObjectStore.put` of a name wins. The owner of the place can read names and sizes, and can remove objects; the
contents are sealed (`failover.archive.sealed`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, Protocol

from msgspec import Struct

from checkpoint.store.atomic_files import TEMPORARY_PREFIX
from checkpoint.store.disk import Disk, DiskFile
from failover.errors import ArchiveError

RESERVE_SIZE: Final = 256 << 20
"""Bytes of a disk that stay free for the checkpoints of the standbys."""

FULL: Final = "full"
OLDER: Final = "older"
"""Why a place did not take an object, where who puts it can do something about it: `PutRefusedError`."""


class PutRefusedError(ArchiveError):
    """The place does not take an object now.

    Attributes:
        why: `FULL`: it would if older copies of this component were gone; `OLDER`: a newer copy of it came meanwhile.
        lacks: how many bytes have to go, where it is full.
    """

    def __init__(self, why: str, message: str, lacks: int = 0) -> None:
        super().__init__(message)
        self.why, self.lacks = why, lacks


class Stored(Struct, frozen=True):
    """One object. ``at_s``: when it came, seconds since 1970."""

    name: str
    size: int
    at_s: float


class Readable(Protocol):
    """An object's content as it arrives."""

    def read(self, size: int, /) -> bytes:
        """At most so many bytes; b"" at the end. Raises OSError, ArchiveError."""
        ...

    def close(self) -> None: ...


class ObjectStore(Protocol):
    """Objects by name. Every method raises ArchiveError where the place does not answer, or refuses."""

    def put(self, name: str, content: BinaryIO) -> bool:
        """Keep the whole content of a file of the disk; it survives once this returns.

        Returns:
            False: there is an object of that name, which stays as it is.

        Raises:
            PutRefusedError: not now.
        """
        ...

    def size(self, name: str) -> int | None:
        """Bytes of an object; None where there is none."""
        ...

    def open(self, name: str, first: int = 0) -> Readable:
        """The content of an object from a byte on, the caller's to close; ArchiveError where there is none."""
        ...

    def listed(self, folder: str) -> Iterator[Stored]:
        """The objects below a folder, in the order of their names; a folder is the first words of a name."""
        ...

    def remove(self, name: str) -> None:
        """Remove an object; one that is gone already is fine."""
        ...


class FolderObjects:
    """Files below a folder, of another disk or of a server's. It must be there: a disk that is not mounted takes nothing."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def put(self, name: str, content: BinaryIO) -> bool:
        """See `ObjectStore.put`."""
        final, disk, source = self._path(name), Disk(), content.fileno()
        with self._told(f"write {name}"):
            self._make_folder(final.parent)
            try:
                if not self._is_named(disk, source, final):
                    self._copy(disk, source, final)
            except FileExistsError:
                return False
            disk.sync_folder(final.parent)
        return True

    @staticmethod
    def _is_named(disk: Disk, source: int, final: Path) -> bool:
        """Give a file of this disk that has no name yet this one, in place of a copy. Raises FileExistsError."""
        if not disk.is_unnamed(source):
            return False
        disk.sync_file(source)
        return disk.name(source, final)

    @staticmethod
    def _copy(disk: Disk, source: int, final: Path) -> None:
        aside = final.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(4)}")
        descriptor = disk.create(aside)
        try:
            DiskFile(disk, descriptor).copy_from(source)
            disk.sync_file(descriptor)
            os.link(aside, final)  # as a rename, but it replaces nothing
        finally:
            os.close(descriptor)
            disk.remove(aside)

    def _make_folder(self, folder: Path) -> None:
        self._require_root()
        if not folder.is_dir():
            self._make_folder(folder.parent)
            folder.mkdir(mode=0o700, exist_ok=True)
            Disk().sync_folder(folder.parent)

    def size(self, name: str) -> int | None:
        """See `ObjectStore.size`."""
        with self._told(f"look for {name}"):
            self._require_root()
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                return self._path(name).stat().st_size
        return None

    def open(self, name: str, first: int = 0) -> BinaryIO:
        """See `ObjectStore.open`."""
        with self._told(f"read {name}"):
            file = self._path(name).open("rb")
            file.seek(first)
            return file

    def listed(self, folder: str) -> Iterator[Stored]:
        """See `ObjectStore.listed`."""
        with self._told("list what there is"):
            self._require_root()
            found = []
            for path in self._path(folder).rglob("*"):
                with contextlib.suppress(FileNotFoundError):  # another member removes older copies
                    about = path.stat()
                    if stat.S_ISREG(about.st_mode) and not path.name.startswith(TEMPORARY_PREFIX):
                        found.append(Stored(path.relative_to(self._root).as_posix(), about.st_size, about.st_mtime))
        yield from sorted(found, key=lambda one: one.name)

    def remove(self, name: str) -> None:
        """See `ObjectStore.remove`."""
        with self._told(f"remove {name}"):
            self._path(name).unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        if ".." in name.split("/") or name.startswith("/"):
            raise ArchiveError(f"{name!r} names no object")
        return self._root / name

    def _require_root(self) -> None:
        if not self._root.is_dir():
            raise FileNotFoundError(None, "there is no such folder; mount the disk, or make it")

    @contextlib.contextmanager
    def _told(self, tried: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            why = error.strerror or str(error)
            if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
                why += "; the agent's service needs ReadWritePaths= for it (systemctl edit failover-agent)"
            raise ArchiveError(f"cannot {tried} in the archive {self._root}: {why}") from error


def require_room(folder: Path, size: int) -> None:
    """Refuse to begin what could take a disk the room that checkpoints need.

    Raises:
        ArchiveError: it has not so many bytes and `RESERVE_SIZE`.
        OSError: it does not say.
    """
    disk = os.statvfs(folder)
    free = disk.f_bavail * disk.f_frsize
    if free < size + RESERVE_SIZE:
        raise ArchiveError(
            f"the disk of {folder} has {free >> 20} MB free: a copy needs {(size >> 20) + 1} MB, and "
            f"{RESERVE_SIZE >> 20} MB stay free for checkpoints; free some space"
        )
