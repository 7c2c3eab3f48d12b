"""Store the files of programs by content: ``STORE/contents/HEX``, named by the blake3 digest of the content.

Invariants: a file stands under its name whole, or not at all (`checkpoint.store.atomic_files`); none is ever changed. Every user
that can reach the store (it is ours alone) can read and execute all of them. They have none of the other powers of the originals,
such as lending their owner's rights. One content is kept once, for any number of programs, paths and snapshots that name it; the
store removes content that no snapshot of the store names.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Collection
from pathlib import Path
from typing import Final

from blake3 import blake3

from checkpoint.errors import StoreError
from checkpoint.store.atomic_files import TEMPORARY_PREFIX, WholeFiles, disk_trouble

FOLDER: Final = "contents"
DIGEST_SIZE: Final = 32

CONTENT_MODE: Final = 0o555
"""No write, no set-user-id: content to be mapped and executed."""

GRACE_S: Final = 600.0
"""A content that is younger waits for the snapshot that names it."""

PART_SIZE: Final = 1 << 20
"""Bytes that are read at a time while a digest is taken."""


class Contents:
    """The contents of one store. May be called from any thread."""

    def __init__(self, root: Path, files: WholeFiles) -> None:
        """
        Args:
            root: of the store.
        """
        self._folder = root / FOLDER
        self._files = files

    def path(self, digest: bytes) -> Path:
        """Where a content is, or would be."""
        return path_in(self._folder, digest)

    @property
    def folder(self) -> Path:
        """Where all of them are; it may not be there yet."""
        return self._folder

    def has(self, digest: bytes, size: int) -> bool:
        """Whether a content of this digest, and so long, is kept."""
        try:
            about = os.stat(self.path(digest), follow_symlinks=False)
        except OSError:
            return False
        return stat.S_ISREG(about.st_mode) and about.st_size == size

    def hold(self, digest: bytes, size: int) -> bool:
        """Whether it is kept, and stays for `GRACE_S` also without a snapshot that names it: one is on its way."""
        if not self.has(digest, size):
            return False
        with contextlib.suppress(OSError):  # removed in this instant
            os.utime(self.path(digest))
        return self.has(digest, size)

    def put(self, source: int, digest: bytes, *, own: bool = False) -> None:
        """Keep the content of a file; when this returns it survives a power cut.

        Args:
            source: descriptor of the whole file, which has this digest: its receiver has computed it. It stays the caller's.
            own: we have made it: an unnamed one (O_TMPFILE) on the store's file system is taken as it is. That of a program is
                copied, unnamed or not: its owner could go on writing to it.

        Raises:
            StoreError: the disk does not take it; nothing of it is left.
        """
        final = self.path(digest)
        self._files.write(final, lambda file: file.copy_from(source), source if own else None)
        with disk_trouble(f"set the mode of {final}"):
            os.chmod(final, CONTENT_MODE)

    def mend(self) -> None:
        """Give back the mode that a power cut, or our end, has taken from what was just put: it could not be executed.

        Raises:
            StoreError: the disk does not let us.
        """
        with disk_trouble(f"set the modes of the files in {self._folder}"):
            for path in self._folder.iterdir() if self._folder.is_dir() else ():
                if stat.S_IMODE(path.lstat().st_mode) != CONTENT_MODE and not path.name.startswith(TEMPORARY_PREFIX):
                    os.chmod(path, CONTENT_MODE)

    def open(self, digest: bytes) -> int:
        """A descriptor of a content, the caller's to close.

        Raises:
            StoreError: it is not kept here.
        """
        with disk_trouble(f"open the content {digest.hex()}"):
            return os.open(self.path(digest), os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)

    def collect(self, needed: Collection[bytes], now_s: float | None = None) -> int:
        """Remove contents that no snapshot needs; answers with the bytes removed.

        Args:
            needed: digests that some snapshot names.
            now_s: seconds since 1970.

        Raises:
            StoreError: the disk does not let us.
        """
        freed, now_s = 0, time.time() if now_s is None else now_s
        names = {digest.hex() for digest in needed}
        with disk_trouble(f"tidy {self._folder}"):
            for path in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
                about = path.lstat()
                is_young = now_s - about.st_mtime < GRACE_S
                if path.name in names or path.name.startswith(TEMPORARY_PREFIX) or is_young:
                    continue
                self._files.remove(path)
                freed += about.st_size
        return freed


def path_in(folder: str | Path, digest: bytes) -> Path:
    """The file of a content. A digest of another length, which could name something else, is a mistake of the caller's."""
    if len(digest) != DIGEST_SIZE:
        raise StoreError(f"a digest of {len(digest)} bytes names no content: {DIGEST_SIZE} are needed")
    return Path(folder) / digest.hex()


def digest_of_descriptor(descriptor: int) -> bytes:
    """The blake3 digest of a whole file, 32 bytes; one that is cut meanwhile has another. Raises OSError."""
    digest, offset = blake3(), 0
    while part := os.pread(descriptor, PART_SIZE, offset):
        digest.update(part)
        offset += len(part)
    return digest.digest()


def digest_of_file(path: str | Path) -> bytes:
    """The same of the file at a path. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    try:
        return digest_of_descriptor(descriptor)
    finally:
        os.close(descriptor)
