"""A directory becomes a bundle: the manifest from its ``program.toml``, and every plain file below it."""

from __future__ import annotations

import os
import stat
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from checkpoint.errors import UNDECODABLE
from failover.core.programs import bundle, manifest
from failover.core.programs.archive import BUNDLE_SIZE_MAX, FILES_MAX, Member
from failover.core.programs.bundle import Signature
from failover.core.programs.manifest import MANIFEST_SIZE_MAX, Manifest
from failover.errors import ProgramError
from failover.programs import keys

if TYPE_CHECKING:
    from failover.programs.keys import SecretKey

PROGRAM_FILE: Final = "program.toml"
LEFT_OUT: Final = ("__pycache__",)


def manifest_of(directory: Path) -> Manifest:
    """What a directory's program.toml says.

    Raises:
        ProgramError: it is missing or wrong; names the key.
    """
    path = directory / PROGRAM_FILE
    try:
        with path.open("rb") as file:
            content = file.read(MANIFEST_SIZE_MAX + 1)
    except OSError as error:
        raise ProgramError(f"cannot read {path}: {error.strerror}; docs/programs.md shows one") from error
    try:
        if len(content) > MANIFEST_SIZE_MAX:
            raise ProgramError(f"it has more than {MANIFEST_SIZE_MAX} bytes")
        found = msgspec.convert(tomllib.loads(content.decode()), Manifest)
        manifest.check(found)
    except (ProgramError, *UNDECODABLE) as error:
        raise ProgramError(f"{path} is mistaken: {error}") from error
    return found


def pack(directory: Path) -> bytes:
    """A bundle without a signature; the same bytes for the same files, on every machine.

    Raises:
        ProgramError: the manifest is wrong, or something in the directory cannot be in a bundle.
    """
    said = manifest_of(directory)
    return bundle.pack(said, list(_members(directory)))


def _members(directory: Path) -> Iterator[Member]:
    left, count = BUNDLE_SIZE_MAX, 0
    for place, folders, files in os.walk(directory):
        folders[:] = [one for one in folders if one not in LEFT_OUT and not one.startswith(".")]
        for folder in folders:
            if (Path(place) / folder).is_symlink():
                raise ProgramError(f"cannot pack {Path(place) / folder}: it is a link, and a bundle holds plain files only")
        for name in files:
            if name.startswith(".") or (name == PROGRAM_FILE and Path(place) == directory):
                continue
            member = _member(Path(place) / name, directory, left)
            left, count = left - len(member.content), count + 1
            if count > FILES_MAX:
                raise ProgramError(f"cannot pack {directory}: it has more than {FILES_MAX} files")
            yield member


def _member(path: Path, directory: Path, left: int) -> Member:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise ProgramError(f"cannot pack {path}: {error.strerror}; a bundle holds plain files only") from error
    with open(descriptor, "rb") as file:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            raise ProgramError(f"cannot pack {path}: it is no plain file")
        content = file.read(left + 1)
    if len(content) > left:
        raise ProgramError(f"cannot pack {directory}: its files have more than {BUNDLE_SIZE_MAX} bytes")
    return Member(path.relative_to(directory).as_posix(), content, bool(mode & 0o100))


def sign(content: bytes, secret: SecretKey, until_s: int = 0) -> bytes:
    """A bundle with this person's signature, in place of one that it may have.

    Args:
        until_s: seconds since 1970 after which it counts no more; 0: for ever.

    Raises:
        BundleRefusedError: it is no bundle.
    """
    _, rest = bundle.split(content)
    digest, public, now_s = bundle.read(rest).digest, keys.public_of(secret), int(time.time())
    said = keys.sign(secret, bundle.signed_text(digest, public, now_s, until_s))
    return bundle.with_signature(rest, Signature(digest=digest, key=public, signature=said, signed_s=now_s, until_s=until_s))


def read_file(path: Path) -> bytes:
    """A bundle's bytes; not more than one may have.

    Raises:
        ProgramError: it cannot be read, is no plain file, or is too large.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise ProgramError(f"cannot read the bundle {path}: it is no plain file")
            if found.st_size > BUNDLE_SIZE_MAX:
                raise ProgramError(f"{path} is no bundle: it has {found.st_size} bytes, {BUNDLE_SIZE_MAX} are the most")
            return file.read(BUNDLE_SIZE_MAX + 1)
    except OSError as error:
        raise ProgramError(f"cannot read the bundle {path}: {error.strerror}") from error
