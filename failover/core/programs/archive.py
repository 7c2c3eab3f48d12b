"""A bundle's files as tar, in one spelling only: ``pack`` writes it, and ``unpack`` accepts nothing else.

A member is a plain file. Its header is the one that `header` makes of its path, size and mode, to the byte; members stand in the
order of their paths. So links, devices, sparse files, long-name records, two members of one path, and sizes that differ from what
follows are refused by one comparison, before anything is written.

Source: POSIX.1-2008, pax, "ustar Interchange Format".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from msgspec import Struct

from failover.errors import BundleRefusedError, ProgramError

BUNDLE_SIZE_MAX: Final = 64 << 20
"""Bytes of a bundle, which is not compressed: as much is unpacked at most."""

FILES_MAX: Final = 4_096
PATH_SIZE_MAX: Final = 200
"""Bytes of UTF-8 of a file's path in a bundle."""

DEPTH_MAX: Final = 16
BLOCK: Final = 512
FILES: Final = "program/"
"""The program's files lie below it; beside it only the manifest."""

PLAIN: Final = 0o644
EXECUTABLE: Final = 0o755
END: Final = bytes(2 * BLOCK)

_NAME_SIZE: Final = 100
_PREFIX_SIZE: Final = 155
_TYPES: Final = {
    b"1": "a hard link",
    b"2": "a symbolic link",
    b"3": "a character device",
    b"4": "a block device",
    b"5": "a directory of its own",
    b"6": "a fifo",
    b"S": "a sparse file",
    b"L": "a long name of GNU tar",
    b"x": "an extended header",
    b"g": "a global header",
}


class Member(Struct, frozen=True):
    """One file. ``content``: a view into the archive."""

    path: str
    content: memoryview | bytes
    is_executable: bool = False


def check_path(path: str) -> None:
    """Refuse a path that could lead out of the directory into which it is unpacked, or that no tar header can hold.

    Raises:
        ProgramError: says why.
    """
    try:
        size = len(path.encode())
    except UnicodeEncodeError as error:
        raise ProgramError(f"{path[:80]!r} cannot be a file of a bundle: it is no UTF-8") from error
    steps = path.split("/")
    if not path or size > PATH_SIZE_MAX:
        raise ProgramError(
            f"{path[:80]!r} cannot be a file of a bundle: its path has {size} bytes, 1 to {PATH_SIZE_MAX} are possible"
        )
    if path.startswith("/") or any(step in ("", ".", "..") for step in steps):
        raise ProgramError(f"{path[:80]!r} cannot be a file of a bundle: its path leads outside, or has an empty step")
    if len(steps) > DEPTH_MAX:
        raise ProgramError(
            f"{path[:80]!r} cannot be a file of a bundle: it lies {len(steps)} folders deep, {DEPTH_MAX} are the most"
        )
    if not path.isprintable() or "\\" in path:
        raise ProgramError(f"{path[:80]!r} cannot be a file of a bundle: its path holds a character that cannot be seen, or \\")
    _split(path)


def header(path: str, size: int, *, is_executable: bool = False) -> bytes:
    """The header of a member, `BLOCK` bytes: no times, no owner.

    Raises:
        ProgramError: the path cannot be one.
    """
    check_path(path)
    prefix, name = _split(path)
    mode = EXECUTABLE if is_executable else PLAIN
    fields = b"".join(
        (
            name.ljust(_NAME_SIZE, b"\0"),
            b"%07o\0" % mode,
            b"%07o\0" % 0,
            b"%07o\0" % 0,
            b"%011o\0" % size,
            b"%011o\0" % 0,
            b" " * 8,
            b"0",
            bytes(100),
            b"ustar\x0000",
            bytes(64),
            bytes(16),
            prefix.ljust(_PREFIX_SIZE, b"\0"),
            bytes(12),
        )
    )
    return fields[:148] + b"%06o\0 " % sum(fields) + fields[156:]


def _split(path: str) -> tuple[bytes, bytes]:
    """(prefix, name): all in the name if it fits, else split as early as possible."""
    content = path.encode()
    if len(content) <= _NAME_SIZE:
        return b"", content
    for at in range(len(content)):
        if content[at : at + 1] == b"/" and len(content) - at - 1 <= _NAME_SIZE and at <= _PREFIX_SIZE:
            return content[:at], content[at + 1 :]
    raise ProgramError(f"{path[:80]!r} cannot be a file of a bundle: its last step has more than {_NAME_SIZE} bytes")


def pack(members: Sequence[Member]) -> bytes:
    """The archive of these files; the same bytes for the same files, in whatever order they come.

    Raises:
        ProgramError: a path cannot be one, is there twice, or leads below a file; there are too many files, or too many bytes.
    """
    ordered = sorted(members, key=lambda one: one.path)
    _check_tree([one.path for one in ordered])
    total = sum(BLOCK + _padded(len(one.content)) for one in ordered) + len(END)
    if total > BUNDLE_SIZE_MAX:
        raise ProgramError(
            f"the program's files are {total} bytes, {BUNDLE_SIZE_MAX} are the most; leave out what it can fetch itself"
        )
    parts: list[bytes | memoryview] = []
    for one in ordered:
        size = len(one.content)
        parts += [header(one.path, size, is_executable=one.is_executable), one.content, bytes(_padded(size) - size)]
    return b"".join((*parts, END))


def unpack(content: bytes | memoryview) -> tuple[Member, ...]:
    """The files of an archive that `pack` has written.

    Raises:
        BundleRefusedError: it is spelled differently in any byte; names the member and what is wrong.
    """
    if len(content) > BUNDLE_SIZE_MAX:
        raise BundleRefusedError(f"the bundle has {len(content)} bytes, {BUNDLE_SIZE_MAX} are the most")
    view = memoryview(content)
    found = tuple(_members(view))
    paths = [one.path for one in found]
    try:
        _check_tree(paths)
    except ProgramError as error:
        raise BundleRefusedError(f"the bundle cannot be unpacked: {error}") from error
    if paths != sorted(paths):
        raise BundleRefusedError("the bundle cannot be unpacked: its files are not in the order of their paths")
    return found


def _members(view: memoryview) -> Iterator[Member]:
    at, count = 0, 0
    while True:
        block = bytes(view[at : at + BLOCK])
        if len(block) < BLOCK:
            raise BundleRefusedError(f"the bundle is cut off: after {count} files its end is missing")
        if not any(block):
            break
        count += 1
        if count > FILES_MAX + 1:
            raise BundleRefusedError(f"the bundle has more than {FILES_MAX} files")
        path, size, is_executable = _described(block)
        if size > len(view) - at - BLOCK:
            raise BundleRefusedError(f"the bundle is cut off, or lies: {path!r} is said to have {size} bytes")
        content = view[at + BLOCK : at + BLOCK + size]
        at += BLOCK + _padded(size)
        if any(view[at - (_padded(size) - size) : at]):
            raise BundleRefusedError(f"the bundle cannot be unpacked: something is hidden behind the end of {path!r}")
        yield Member(path, content, is_executable)
    if bytes(view[at:]) != END:
        raise BundleRefusedError("the bundle cannot be unpacked: something follows its end, or its end is cut off")


def _described(block: bytes) -> tuple[str, int, bool]:
    """Path, size and mode of a header, which is exactly the one that `header` makes of them.

    Raises:
        BundleRefusedError: it is another one.
    """
    name, prefix = block[:_NAME_SIZE].rstrip(b"\0"), block[345 : 345 + _PREFIX_SIZE].rstrip(b"\0")
    try:
        path = (prefix + b"/" + name if prefix else name).decode()
        size, mode = int(block[124:135], 8), int(block[100:107], 8)
    except ValueError:
        raise BundleRefusedError("the bundle cannot be unpacked: a header is damaged, or no plain file's") from None
    if block[156:157] != b"0":
        kind = _TYPES.get(block[156:157], "of an unknown kind")
        raise BundleRefusedError(f"the bundle cannot be unpacked: {path[:80]!r} is {kind}, and only plain files may be in it")
    try:
        expected = header(path, size, is_executable=mode == EXECUTABLE)
    except (ProgramError, OverflowError) as error:
        raise BundleRefusedError(f"the bundle cannot be unpacked: {error}") from error
    if size < 0 or expected != block:
        raise BundleRefusedError(f"the bundle cannot be unpacked: the header of {path[:80]!r} is not as failover writes it")
    return path, size, mode == EXECUTABLE


def _check_tree(paths: Sequence[str]) -> None:
    """Raises ProgramError: two files would be one, or one a folder of the other, or there are too many."""
    if len(paths) > FILES_MAX + 1:
        raise ProgramError(f"the bundle has {len(paths)} files, {FILES_MAX} are the most")
    known = set(paths)
    if len(known) < len(paths):
        doubled = next(path for path in paths if paths.count(path) > 1)
        raise ProgramError(f"{doubled!r} is in the bundle twice")
    for path in paths:
        steps = path.split("/")
        above = next((one for end in range(1, len(steps)) if (one := "/".join(steps[:end])) in known), None)
        if above is not None:
            raise ProgramError(f"{above!r} would be a file, and the folder of {path!r}")


def _padded(size: int) -> int:
    return -(-size // BLOCK) * BLOCK
