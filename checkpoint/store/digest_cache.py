"""Cache digests of files that have not changed, so that they need not be read again.

Source: inode(7): ctime is the kernel's own, and every write, also one through a mapping, sets it; only a user that sets the clock
could keep it unchanged.
"""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable, Iterable
from typing import Final

from msgspec import Struct

REMEMBERED_MAX: Final = 10_000
"""Files; a program maps some hundred, and reads some more."""

SETTLED_NS: Final = 2 * 10**9
"""A file that was changed so shortly before it was read may be changed once more within the same tick of its clock."""

DigestOf = Callable[[str], bytes]
"""The digest of the file at a path. Raises OSError."""


class FileVersion(Struct, frozen=True):
    """Facts that change when a file does."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int


class KnownDigest(Struct, frozen=True):
    """The digest of a file as it was found."""

    path: str
    version: FileVersion
    digest: bytes


class DigestsOfFiles:
    """Digests by path: of files that changed since they were read they are made anew.

    Attributes:
        used: those that were asked for, to be known the next time.
    """

    def __init__(self, known: Iterable[KnownDigest] = ()) -> None:
        self._known = {one.path: one for one in known}
        self.used: dict[str, KnownDigest] = {}

    def of(self, path: str) -> bytes:
        """The digest of the file at a path.

        Raises:
            OSError: it cannot be read.
        """
        from checkpoint.store.content_store import digest_of_file  # here: a guard knows the types alone

        version, began_ns = _version(path), time.time_ns()
        known = self._known.get(path)
        if known is None or version is None or known.version != version:
            known = KnownDigest(path, version or FileVersion(0, 0, 0, 0, 0), digest_of_file(path))
            if version is None or version != _version(path) or began_ns - version.ctime_ns < SETTLED_NS:
                return known.digest
        if len(self.used) < REMEMBERED_MAX:
            self._known[path] = self.used[path] = known
        return known.digest


def _version(path: str) -> FileVersion | None:
    """None of what is no regular file."""
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        return None
    return FileVersion(about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns)
