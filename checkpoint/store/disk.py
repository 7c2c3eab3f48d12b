"""The store's interface to the disk: one method for every operation that changes something, so that a test can interrupt each."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from pathlib import Path
from typing import Final

from checkpoint.store.whole_file import sync_directory, write_all

FILE_MODE = 0o600
FOLDER_MODE = 0o700
"""Memory is secret: no other user may read a snapshot."""

COPY_SIZE = 1 << 20
"""Bytes copied at a time."""

WRITEBACK_SIZE: Final = 8 << 20
"""Bytes that the disk is given to write at a time; about twice as many wait for it at most."""

_WAIT_BEFORE, _WRITE, _WAIT_AFTER = 1, 2, 4
_sync_file_range = ctypes.CDLL(None).sync_file_range
_sync_file_range.argtypes = (ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint)


class Disk:
    """A real file system. Every method raises OSError as the kernel gives it."""

    def __init__(self) -> None:
        self._nameless: set[int] = set()

    def make_folder(self, path: Path) -> None:
        """Create a folder for our eyes only; durable after ``sync_folder`` of its parent."""
        path.mkdir(mode=FOLDER_MODE)

    def create(self, path: Path) -> int:
        """Create a file for our eyes only; answer its descriptor, for writing."""
        return os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, FILE_MODE)

    def write(self, descriptor: int, content: bytes | memoryview) -> int:
        """Append all of the content."""
        write_all(descriptor, content)
        return len(content)

    def is_unnamed(self, descriptor: int) -> bool:
        """Whether it is a file that no name leads to (O_TMPFILE), and no file system is known that keeps `name` from it."""
        found = os.fstat(descriptor)
        return found.st_nlink == 0 and found.st_dev not in self._nameless

    def name(self, descriptor: int, path: Path) -> bool:
        """Give an unnamed file a name.

        Returns:
            False where it cannot have that one: it lies on another file system, or is a memory file.
        """
        try:
            # Any src_dir_fd makes it linkat(2) with AT_SYMLINK_FOLLOW; link(2) would give a second name to the link in /proc.
            os.link(f"/proc/self/fd/{descriptor}", path, src_dir_fd=descriptor, follow_symlinks=True)
        except OSError as error:
            if error.errno in (errno.EXDEV, errno.ENOENT, errno.EPERM, errno.EOPNOTSUPP):
                if error.errno == errno.EXDEV:  # as of memory files, and so of each snapshot that is made here
                    self._nameless.add(os.fstat(descriptor).st_dev)
                return False
            raise
        os.chmod(path, FILE_MODE)
        return True

    def sync_file(self, descriptor: int) -> None:
        """Return when the file's content would survive a power cut."""
        os.fdatasync(descriptor)

    def rename(self, old: Path, new: Path) -> None:
        """Change a name in one step; durable after ``sync_folder``."""
        os.rename(old, new)

    def sync_folder(self, path: Path) -> None:
        """Return when the names in a folder would survive a power cut."""
        sync_directory(path)

    def remove(self, path: Path) -> None:
        """Remove a file; one that is gone already is fine."""
        path.unlink(missing_ok=True)


def with_cure(error: OSError) -> str:
    """What the kernel says of a failed write, and the cure of a full disk."""
    return f"{error.strerror}; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else str(error.strerror)


class DiskFile:
    """An empty file that is written from its beginning: what ``format.encode`` needs of a file. From any thread, one at a time.

    The disk writes a long file while the file grows. Else the kernel keeps gigabytes of it in memory until ``sync_file``, and a
    sync of any other file meanwhile waits for them: the vote record's, without which no robot takes over, for one. This makes
    nothing durable. Source: sync_file_range(2).
    """

    def __init__(self, disk: Disk, descriptor: int) -> None:
        self._disk = disk
        self._descriptor = descriptor
        self._size = 0
        self._begun = 0

    def write(self, content: bytes | memoryview, /) -> int:
        """Append all of the content."""
        written = self._disk.write(self._descriptor, content)
        self._size += written
        while self._size - self._begun >= WRITEBACK_SIZE:
            self._write_back()
        return written

    def _write_back(self) -> None:
        """Begin to write the file's new bytes, and wait for those begun before; a disk that refuses this writes later."""
        _sync_file_range(self._descriptor, self._begun, WRITEBACK_SIZE, _WRITE)
        if self._begun:
            before = self._begun - WRITEBACK_SIZE
            _sync_file_range(self._descriptor, before, WRITEBACK_SIZE, _WAIT_BEFORE | _WRITE | _WAIT_AFTER)
        self._begun += WRITEBACK_SIZE

    def copy_from(self, source: int) -> None:
        """Append the whole of another file."""
        offset, size = 0, os.fstat(source).st_size
        while content := os.pread(source, min(COPY_SIZE, size - offset), offset):
            self.write(content)
            offset += len(content)


def lock_exclusively(path: Path) -> int | None:
    """Take the lock that one process can hold; the answer keeps it, None means that another has it."""
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, FILE_MODE)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor
