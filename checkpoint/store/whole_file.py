"""Writes a small file so that its name stands for the whole of a content, old or new, and never for a part.

Also the loop that writes all of a content, for every writer.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

Lasting = Literal["process", "content", "name"]
"""What outlives more than a kill of the process. ``content``: after a power cut, the name stands for the whole old or the whole
new content. ``name``: when the writer returns, it is the new one. ``process``: a power cut may leave an empty file."""


@contextmanager
def written_aside(
    path: Path, aside: Path | None = None, *, mode: int = 0o600, lasts: Lasting = "content", is_exclusive: bool = False
) -> Iterator[int]:
    """A descriptor of a file for the body to write; at its end the file gets its name. Nothing is left of one not finished.

    Args:
        aside: the file until then, in the same folder; ``path`` with ``.new`` behind it unless given.
        mode: less what the umask takes.
        is_exclusive: refuse a file that lies there aside, in a folder where other users may write.

    Raises:
        OSError: it cannot be written; the old one stands.
    """
    place = aside if aside is not None else path.with_name(path.name + ".new")
    flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | (os.O_EXCL if is_exclusive else os.O_TRUNC)
    descriptor = os.open(place, flags, mode)
    try:
        try:
            yield descriptor
            if lasts != "process":
                os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
        os.rename(place, path)
    except BaseException:
        with contextlib.suppress(OSError):
            place.unlink()
        raise
    if lasts == "name":
        sync_directory(path.parent)


def write_whole(path: Path, content: bytes, *, mode: int = 0o600, lasts: Lasting = "content") -> None:
    """Put this content in the place of a file's.

    Raises:
        OSError: it cannot be written; the old one stands.
    """
    with written_aside(path, mode=mode, lasts=lasts) as descriptor:
        write_all(descriptor, content)


def write_new(path: Path, content: bytes, *, mode: int = 0o600) -> None:
    """Write a file that must not be there yet; when this returns, a power cut does not take it away.

    Raises:
        FileExistsError: it is there, and stands.
        OSError: it cannot be written; nothing is left of it.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        try:
            write_all(descriptor, content)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        sync_directory(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            path.unlink()
        raise


def write_all(descriptor: int, content: bytes | memoryview) -> None:
    """Write a content by as many write(2) as it takes."""
    rest = memoryview(content).cast("B")
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def sync_directory(directory: Path) -> None:
    """Wait until the disk has the directory's names, so that a rename survives a power cut."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
