"""Set owner, mode, attributes and time of a carried file through an open descriptor, because its name may change meanwhile.

A program of root may carry files below a folder of another user. That user can put a link in place of any file there. So each
component of a path is opened by itself and no link is followed (O_PATH, O_NOFOLLOW: nothing is read, and opening affects no
device or pipe). The open file is then changed through /proc/self/fd, which leads to exactly that file (proc_pid_fd(5)).
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from checkpoint.resources.carried.file_numbers import Identity
from checkpoint.snapshot.carried_files import Entry

DESCRIPTORS: Final = "/proc/self/fd/"
HELD: Final = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC


def path_of(descriptor: int) -> str:
    """A path that leads to the open file, also if its name has changed or is gone."""
    return f"{DESCRIPTORS}{descriptor}"


def give(top: str, entry: Entry, name: bytes, identity: Identity | None = None) -> bool:
    """Give what stands at a name below a path, b"" for the path itself, its owner, mode, attributes and time.

    Args:
        identity: device and inode of the file that is meant; None: any file that stands there.

    Returns:
        Whether it has its owner now.

    Raises:
        OSError: it is not there, or is of another kind, or a link leads there.
    """
    with _held(os.path.dirname(top), os.path.basename(top), name) as (folder, last, file):
        about = os.fstat(file)
        is_meant = identity in (None, (about.st_dev, about.st_ino)) and stat.S_IFMT(about.st_mode) == stat.S_IFMT(entry.mode)
        if not is_meant:
            raise FileNotFoundError(errno.ENOENT, "something else has its place", os.path.join(top, os.fsdecode(name)))
        if stat.S_ISLNK(entry.mode):
            is_its = _own(last, entry, about, folder)
            os.utime(last, ns=(entry.mtime_ns, entry.mtime_ns), dir_fd=folder, follow_symlinks=False)
            return is_its
        path = path_of(file)
        is_its = _own(path, entry, about, None)
        os.chmod(path, stat.S_IMODE(entry.mode))
        for attribute, value in entry.attributes:
            with contextlib.suppress(OSError):  # a file system without: content and rights are what counts
                os.setxattr(path, attribute, value)
        os.utime(path, ns=(entry.mtime_ns, entry.mtime_ns))
        return is_its


def _own(path: str | bytes, entry: Entry, about: os.stat_result, folder: int | None) -> bool:
    """Give it its owner; False where we may not."""
    if (about.st_uid, about.st_gid) != (entry.uid, entry.gid):
        try:
            os.chown(path, entry.uid, entry.gid, dir_fd=folder, follow_symlinks=folder is None)
        except PermissionError:
            return False
    return True


@contextmanager
def _held(place: str, top: str, name: bytes) -> Iterator[tuple[int, bytes, int]]:
    """Hold the file at a name open: (its folder, its name there, itself).

    Raises:
        OSError: it is not there, or a component of the name is a link (ENOTDIR).
    """
    parts = [os.fsencode(top), *(name.split(b"/") if name else ())]
    with contextlib.ExitStack() as opened:
        folder = os.open(place, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        opened.callback(os.close, folder)
        for part in parts[:-1]:
            folder = os.open(part, HELD | os.O_DIRECTORY, dir_fd=folder)
            opened.callback(os.close, folder)
        file = os.open(parts[-1], HELD, dir_fd=folder)
        opened.callback(os.close, file)
        yield folder, parts[-1], file
