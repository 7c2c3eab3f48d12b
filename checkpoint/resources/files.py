"""Regular files, directories and paths (O_PATH): opened again at the same offset; what was only read must be the same file.

Facts: ``descriptors``; ``path``; ``flags`` of open(2); ``offset`` and ``size`` in bytes, ``mode``, ``device``, ``inode`` and
``mtime_ns`` at the capture; ``digest``: blake3 of the content of a file that is open for reading only, b"" where it is longer
than `DIGEST_LIMIT` or cannot be read; for a file that no name leads to any more ``deleted`` true and its whole ``content``.

A file that is open for writing and only grew since the capture is cut back to ``size``.
"""

from __future__ import annotations

import os
import stat
from functools import lru_cache
from typing import Final

from blake3 import blake3

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux import procfs
from checkpoint.linux.descriptors import Descriptor
from checkpoint.model import Fact, Resource
from checkpoint.resources import OpenFile, Surroundings

KIND: Final = "files"

CAPABILITIES: Final = (
    preserved(
        Area.FILES,
        "regular files, directories and paths (O_PATH)",
        "opened again at the same offset; what was only read must be the same, what only grew is cut back",
    ),
    preserved(Area.FILES, "deleted files", "carried whole, up to 16 MiB"),
    refused(
        Area.FILES,
        "a deleted file over 16 MiB, or with another name; a deleted directory",
        "give it a name",
        "cannot be opened again; let the program close it",
        "still has another name",
        "a deleted file is carried up to",
    ),
    refused(
        Area.FILES,
        "secret memory (memfd_secret)",
        "it cannot be read, that is its purpose; run the program without it",
        "secret memory cannot be read",
    ),
    refused(
        Area.FILES,
        "files that no path leads to (message queues)",
        "let the program close them, or use a unix socket",
        "which no path leads to from here",
    ),
)

DIGEST_LIMIT: Final = 256 << 20
"""Bytes of a file that are digested: about 50 ms of one core, once for each version of the file."""
CONTENT_LIMIT: Final = 16 << 20
"""Bytes of a deleted file that a snapshot carries: it is copied while the program stands still."""
DIGESTS_KEPT: Final = 1024
"""Digests remembered; a file is digested again only when its device, inode, size or time of change differ."""

CHUNK: Final = 1 << 20

O_PATH: Final = 0o10000000
MEMORY_FILE: Final = "/memfd:"


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """What must be known to open it again."""
    first = held.first
    if not is_file(first):
        return None
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "path": first.target.removesuffix(procfs.DELETED) if is_deleted(first) else first.target,
        "flags": first.flags & ~os.O_CLOEXEC,
        "offset": first.offset,
        "size": first.size,
        "mode": first.mode,
        "device": first.device,
        "inode": first.inode,
        "mtime_ns": first.mtime_ns,
    }
    if is_deleted(first):
        content = content_of(held) if held.content is None else held.content
        facts |= {"deleted": True, "content": content, "uid": first.uid, "gid": first.gid}
    elif is_only_read(first):
        facts["digest"] = digest_of(held)
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a file cannot be opened again."""
    first = held.first
    if not is_file(first):
        return None
    what = f"{held.name} is {first.target}"
    if first.target.startswith("/secretmem"):
        return f"{what}: secret memory cannot be read, that is its purpose; run the program without it"
    if not (_was_found(held) if is_deleted(first) else _is_found(held) or _has_just_lost_its_name(held)):
        return f"{what}, which no path leads to from here (a message queue, for one): that is not kept; run without it"
    return _refuse_deleted(held) if is_deleted(first) else None


def is_file(one: Descriptor) -> bool:
    """Whether it is a regular file, a directory, or only the path of something (O_PATH)."""
    is_kind = stat.S_ISREG(one.mode) or stat.S_ISDIR(one.mode) or one.flags & O_PATH
    return bool(is_kind) and one.target.startswith("/")


def _refuse_deleted(held: OpenFile) -> str | None:
    first, what = held.first, f"{held.name} is {held.first.target}"
    if not stat.S_ISREG(first.mode):
        return f"{what}: a deleted directory, device or the like cannot be opened again; let the program close it"
    if first.links:
        return f"{what}, but it still has another name, which is not known: let the program open it under that name"
    if first.size > CONTENT_LIMIT:
        return f"{what} with {first.size >> 20} MiB; a deleted file is carried up to {CONTENT_LIMIT >> 20} MiB: give it a name"
    return None


def is_deleted(one: Descriptor) -> bool:
    """Whether no name leads to it (any more); a name that merely ends in " (deleted)" does not count."""
    return one.target.endswith(procfs.DELETED) and not os.path.lexists(one.target)


def must_carry(held: OpenFile) -> bool:
    """Whether its content must travel with the snapshot."""
    first = held.first
    return stat.S_ISREG(first.mode) and not first.links and first.size <= CONTENT_LIMIT and is_deleted(first)


def _is_found(held: OpenFile) -> bool:
    """Whether its path leads to it, as the process sees paths."""
    try:
        about = os.stat(f"/proc/{held.pid}/root{held.first.target}", follow_symlinks=not held.first.flags & O_PATH)
    except OSError:
        return False
    return (about.st_dev, about.st_ino) == (held.first.device, held.first.inode)


def _has_just_lost_its_name(held: OpenFile) -> bool:
    """Whether it was deleted or closed since we looked, by a program that runs meanwhile: the next look finds it otherwise."""
    through = f"/proc/{held.pid}/fd/{held.first.number}"
    try:
        about = os.stat(through)
        if (about.st_dev, about.st_ino) != (held.first.device, held.first.inode):
            return True  # closed, and another one opened under its number, as a database does with its journals
        return os.readlink(through) == held.first.target + procfs.DELETED
    except FileNotFoundError:
        return True
    except OSError:
        return False


def _was_found(held: OpenFile) -> bool:
    """Whether a deleted file lies on the file system of the directory where its name was; a message queue does not."""
    try:
        about = os.stat(f"/proc/{held.pid}/root{os.path.dirname(held.first.target)}")
    except OSError:
        return True  # the directory has gone too; the content is what counts
    return about.st_dev == held.first.device


def is_only_read(one: Descriptor) -> bool:
    """Whether nothing can be written through it and something can be read."""
    return stat.S_ISREG(one.mode) and one.flags & os.O_ACCMODE == os.O_RDONLY and not one.flags & O_PATH


def content_of(held: OpenFile) -> bytes:
    """The whole of a deleted file, through the process that still holds it.

    Raises:
        CaptureError: it cannot be read.
    """
    try:
        descriptor = os.open(f"/proc/{held.pid}/fd/{held.first.number}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.pread(descriptor, CONTENT_LIMIT, 0)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise CaptureError(f"cannot read the deleted file {held.first.target} of pid {held.pid}: {error.strerror}") from error


def digest_of(held: OpenFile) -> bytes:
    """The blake3 digest of a file that is only read, 32 bytes; b"" when too long, closed to us, or changed meanwhile."""
    first = held.first
    return digest_at(f"/proc/{held.pid}/fd/{first.number}", (first.device, first.inode, first.size, first.mtime_ns))


def digest_at(path: str, version: tuple[int, int, int, int]) -> bytes:
    """The blake3 digest of the file at a path, 32 bytes; b"" when too long, closed to us, or another version.

    Args:
        version: device, inode, size, time of modification.
    """
    if version[2] > DIGEST_LIMIT:
        return b""
    try:
        return _digest(path, version)
    except (OSError, _ChangedError):
        return b""  # whoever may trace may usually read; where not, size and name must do


class _ChangedError(Exception):
    """The path leads to another version of the file."""


@lru_cache(maxsize=DIGESTS_KEPT)
def _digest(path: str, version: tuple[int, int, int, int]) -> bytes:
    with open(path, "rb") as file:
        about = os.fstat(file.fileno())
        if (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns) != version:
            raise _ChangedError
        digest = blake3()
        while piece := file.read(CHUNK):
            digest.update(piece)
        return digest.digest()
