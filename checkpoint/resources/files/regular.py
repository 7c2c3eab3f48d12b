"""Restore regular files, directories and paths (O_PATH) at the same offset; a file open only for reading must be the same file.

Facts: ``descriptors``; ``path``; ``flags`` of open(2); ``offset`` and ``size`` in bytes, ``mode``, ``device``, ``inode`` and
``mtime_ns`` at the capture; ``digest``: blake3 of the content of a file that is open for reading only, b"" where it is longer
than `DIGEST_LIMIT` or cannot be read. If no name leads to the file any more, ``deleted`` true, ``uid`` and ``gid``; ``link``:
where a symbolic link leads; ``attributes``: the extended ones, by name; ``content``: [offset, bytes] of each part that is no
hole, with one of its open files, [] with the others.

A file that is open for writing and only grew since the capture is cut back to ``size``.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from blake3 import blake3

from checkpoint.capability import Area, preserved, refused
from checkpoint.engine import NOTED, REFUSED, Finding
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux.memory.digest_tracker import filled_extents
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.model import Fact, Resource
from checkpoint.resources.files import linked_names, locks
from checkpoint.resources.open_file import OpenFile, Surroundings

KIND: Final = "files"

CAPABILITIES: Final = (
    preserved(
        Area.FILES,
        "regular files, directories and paths (O_PATH)",
        "opened again at the same offset. A file that was only read must be the same; a file that only grew is cut back",
    ),
    preserved(
        Area.FILES,
        "deleted files, directories and symbolic links",
        "carried whole, up to 16 MiB without holes. A file that still has another name, near by or in another process of "
        "the program, is opened or mapped by that name. Pages of private mappings are carried too: later "
        "writes to the file do not show in pages that were never touched",
    ),
    refused(
        Area.FILES,
        "a deleted file over 16 MiB, or one whose other name is far away; the mere path (O_PATH) of a deleted device, "
        "socket or pipe",
        "give it a name",
        "cannot be opened again; let the program close it",
        "still has another name",
        "deleted files are carried up to",
    ),
    refused(
        Area.FILES,
        "more than 24 MiB in all in pipes, sockets, memory files and deleted files",
        "use files with a name",
        "hold {} MiB in all",
    ),
    refused(
        Area.FILES,
        "secret memory (memfd_secret)",
        "run the program without it: its purpose is that no other process can read it",
        "secret memory cannot be read",
    ),
    refused(
        Area.FILES,
        "files without a path (message queues)",
        "let the program close them, or use a unix socket",
        "which no path leads to from here",
    ),
)

DIGEST_LIMIT: Final = 256 << 20
"""Bytes of a file that are digested: about 50 ms of one core, once for each version of the file."""
CONTENT_LIMIT: Final = 16 << 20
"""Bytes of a deleted file that a snapshot carries: it is copied while the program stands still."""
CONTENTS_LIMIT: Final = 24 << 20
"""Bytes of all that is carried beside memory: the section of a snapshot in which it stands takes 32 MiB."""
DIGESTS_KEPT: Final = 1024
"""Digests remembered; a file is digested again only when its device, inode, size or time of change differ."""

LOOKS: Final = 5
"""How often a file is looked for that seems to have no name."""

CHUNK: Final = 1 << 20

LOGS_TOLD: Final = 2
"""Files that one note names."""

O_PATH: Final = 0o10000000


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The facts to open it again."""
    first = held.first
    if not is_file(first):
        return None
    is_lost, other = is_deleted(first), other_name(held)
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "path": other or (first.target.removesuffix(procfs.DELETED) if is_lost else first.target),
        "flags": first.flags & ~os.O_CLOEXEC,
        "offset": first.offset,
        "size": first.size,
        "mode": first.mode,
        "device": first.device,
        "inode": first.inode,
        "mtime_ns": first.mtime_ns,
    }
    if is_lost and not other:
        facts |= {"deleted": True, "content": held.observed.get("content", []), "uid": first.uid, "gid": first.gid}
        if stat.S_ISLNK(first.mode):
            facts["link"] = _link_of(held)
        if attributes := held.observed.get("attributes"):
            facts["attributes"] = attributes
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
    if not (_was_found(held) if is_deleted(first) else _is_or_was_found(held)):
        return f"{what}, which no path leads to from here (a message queue, for one): that is not kept; run without it"
    return _refuse_deleted(held) if is_deleted(first) else None


def is_file(one: Descriptor) -> bool:
    """Whether it is a regular file, a directory, or only the path of something (O_PATH)."""
    is_kind = stat.S_ISREG(one.mode) or stat.S_ISDIR(one.mode) or one.flags & O_PATH
    return bool(is_kind) and one.target.startswith("/")


def _refuse_deleted(held: OpenFile) -> str | None:
    first, what = held.first, f"{held.name} is {held.first.target}"
    if stat.S_IFMT(first.mode) not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK):
        return (
            f"{what}: a deleted device or the like, of which only the path is open, cannot be opened again; "
            "let the program close it"
        )
    if first.links and not other_name(held):
        return f"{what}, but it still has another name, which is not known: let the program open it under that name"
    if not first.links and first.stored > CONTENT_LIMIT:
        return f"{what} with {first.stored >> 20} MiB; deleted files are carried up to {CONTENT_LIMIT >> 20} MiB: give it a name"
    return None


def is_deleted(one: Descriptor) -> bool:
    """Whether no name leads to it (any more); a name that merely ends in " (deleted)" does not count."""
    return one.target.endswith(procfs.DELETED) and not os.path.lexists(one.target)


def must_carry(held: OpenFile) -> bool:
    """Whether its content must travel with the snapshot."""
    first = held.first
    return stat.S_ISREG(first.mode) and not first.links and first.stored <= CONTENT_LIMIT and is_deleted(first)


def other_name(held: OpenFile) -> str:
    """The name that is left of a file whose own was deleted; "" without one that is known."""
    first = held.first
    if not (first.links and stat.S_ISREG(first.mode) and is_deleted(first)):
        return ""
    return linked_names.name_of(first.target, (first.device, first.inode), (held.pid, *sorted(held.kin.pids - {held.pid})))


def _is_or_was_found(held: OpenFile) -> bool:
    """Whether its path leads to it, or did until a program that runs meanwhile deleted it.

    Two looks may fall between a deletion and the making of another file of the same name, which often gets the same inode, as a
    database's journals do: a file that is where it was and has no name has one at the next look.
    """
    return any(is_found(held) or _has_just_lost_its_name(held) for _ in range(LOOKS))


def is_found(held: OpenFile) -> bool:
    """Whether its path leads to it, as the process sees paths."""
    try:
        about = os.stat(f"{procfs.outlook(held.pid)}{held.first.target}", follow_symlinks=not held.first.flags & O_PATH)
    except OSError:
        return False
    return (about.st_dev, about.st_ino) == (held.first.device, held.first.inode)


def _has_just_lost_its_name(held: OpenFile) -> bool:
    """Whether it was deleted or closed since we looked, by a program that runs meanwhile: the next look finds it otherwise.

    Raises:
        ProcessGoneError: it has ended: an ordinary user may not look at such a one, and finds nothing.
    """
    through = f"/proc/{held.pid}/fd/{held.first.number}"
    try:
        about = os.stat(through)
        if (about.st_dev, about.st_ino) != (held.first.device, held.first.inode):
            return True  # closed, and another one opened under its number, as a database does with its journals
        return os.readlink(through) == held.first.target + procfs.DELETED
    except FileNotFoundError:
        return True
    except OSError:
        if procfs.status(held.pid).has_ended:
            raise ProcessGoneError(f"pid {held.pid} ended while its files were looked at") from None
        return False


def _was_found(held: OpenFile) -> bool:
    """Whether a deleted file lies on the file system of the directory where its name was; a message queue does not."""
    try:
        about = os.stat(f"{procfs.outlook(held.pid)}{os.path.dirname(held.first.target)}")
    except OSError:
        return True  # the directory has gone too; the content is what counts
    return about.st_dev == held.first.device


def is_only_read(one: Descriptor) -> bool:
    """Whether nothing can be written through it and something can be read."""
    return stat.S_ISREG(one.mode) and one.flags & os.O_ACCMODE == os.O_RDONLY and not one.flags & O_PATH


def observe_deleted(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """The content of a deleted file, with the first open file of it.

    Raises:
        CaptureError: it cannot be read.
    """
    same = (held.first.device, held.first.inode)
    first = next((one for one in opened if (one.first.device, one.first.inode) == same), held)
    if locks.has_lease(held):
        return {}  # to read it would break that
    return {"content": _content_of(held) if first is held else [], "attributes": _attributes_of(held)}


def _attributes_of(held: OpenFile) -> dict[str, Fact]:
    """The extended attributes, as far as we may read them."""
    path, found = f"/proc/{held.pid}/fd/{held.first.number}", {}
    with contextlib.suppress(OSError):  # a file system without
        for name in os.listxattr(path):
            with contextlib.suppress(OSError):
                found[name] = os.getxattr(path, name)
    return dict(found)


def _link_of(held: OpenFile) -> str:
    """Where a symbolic link leads, of which only the path is open."""
    link = os.open(f"/proc/{held.pid}/fd/{held.first.number}", O_PATH | os.O_CLOEXEC)
    try:
        return os.readlink("", dir_fd=link)
    except OSError as error:
        raise CaptureError(f"cannot read the deleted link {held.first.target} of pid {held.pid}: {error.strerror}") from error
    finally:
        os.close(link)


def _content_of(held: OpenFile) -> list[Fact]:
    """[offset, bytes] of each part that is no hole, through the process that still holds it."""
    try:
        descriptor = os.open(f"/proc/{held.pid}/fd/{held.first.number}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return [[first, os.pread(descriptor, last - first, first)] for first, last in filled_extents(descriptor)]
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
        return b""  # a tracer may usually read; where not, size and name must do


class _ChangedError(Exception):
    """The path leads to another version of the file."""


def _digest(path: str, version: tuple[int, int, int, int]) -> bytes:
    """The same file may be reached by many paths: through the descriptors of every process that has it open."""
    if version not in _digests:
        if len(_digests) >= DIGESTS_KEPT:
            _digests.pop(next(iter(_digests)))
        _digests[version] = _digested(path, version)
    return _digests[version]


_digests: Final[dict[tuple[int, int, int, int], bytes]] = {}


def _digested(path: str, version: tuple[int, int, int, int]) -> bytes:
    with open(path, "rb") as file:
        about = os.fstat(file.fileno())
        if (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns) != version:
            raise _ChangedError
        digest = blake3()
        while piece := file.read(CHUNK):
            digest.update(piece)
        return digest.digest()


def findings(resources: Sequence[Resource], surroundings: Surroundings) -> Iterator[Finding]:
    """Findings about all files of a component together: too much content in all, and logs that their readers get twice."""
    size = sum(_size_of(fact) for held in resources for fact in held.facts.values())
    if size > CONTENTS_LIMIT:
        kept = f"up to {CONTENTS_LIMIT >> 20} are kept: use files with a name"
        reason = f"its pipes, sockets, memory files and deleted files hold {size >> 20} MiB in all; {kept}"
        yield Finding(KIND, "contents", REFUSED, reason)
    logs = tuple(dict.fromkeys(str(held.facts["path"]) for held in resources if held.kind == KIND and _is_log(held)))
    left = [path for path in logs if not surroundings.terms.is_carried(path)]
    if left and surroundings.may_repeat:
        more = f" and {len(left) - LOGS_TOLD} more" if len(left) > LOGS_TOLD else ""
        text = (
            f"it appends to {', '.join(left[:LOGS_TOLD])}{more}, which its checkpoints do not carry: after a takeover it writes "
            f"the lines since the last checkpoint again, so that they come twice to a reader: --carry {left[0]}"
        )
        yield Finding(KIND, "logs", NOTED, text)


def _is_log(held: Resource) -> bool:
    """Whether the program only appends to a regular file that has a name."""
    flags, mode = (held.facts[name] for name in ("flags", "mode"))
    assert isinstance(flags, int) and isinstance(mode, int)
    if flags & O_PATH or held.facts.get("deleted") or not stat.S_ISREG(mode):
        return False
    at_end = flags & os.O_ACCMODE == os.O_WRONLY and held.facts["offset"] == held.facts["size"] != 0  # no lock's file
    return at_end or (bool(flags & os.O_APPEND) and flags & os.O_ACCMODE != os.O_RDONLY)


def _size_of(fact: Fact) -> int:
    """Bytes of content in a fact."""
    if isinstance(fact, bytes):
        return len(fact)
    parts = fact.values() if isinstance(fact, Mapping) else fact if isinstance(fact, list) else ()
    return sum(map(_size_of, parts))
