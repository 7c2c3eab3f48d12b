"""Signs what a member puts into a witness's keeping, so that the witness proves it and can open nothing: Ed25519.

The pair comes from the archive key. A witness has the public half alone (``keys/archive.public``): with that it tells the word
of a holder of the archive key from any other, and neither opens nor makes a copy.

Source: RFC 8032 (Ed25519).
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, Final

from blake3 import blake3

from checkpoint.store.whole_file import write_new
from failover.errors import ArchiveError

PUBLIC_FILE: Final = "archive.public"
PUBLIC_MODE: Final = 0o644
KEY_SIZE: Final = 32
PUT: Final = "put"
REMOVE: Final = "remove"
_PAIR: Final = "failover-archive-1 signatures"
"""Context of the digest that is the secret half."""

_STATEMENT: Final = b"failover-archive-1 statement\0"


def public_path(team: Path) -> Path:
    """Where the public half is, in a team directory."""
    return team / "keys" / PUBLIC_FILE


def public_of(key: bytes) -> bytes:
    """The public half that belongs to an archive key. Raises ArchiveError: the library is not installed."""
    public: bytes = _secret(key).public_key().public_bytes_raw()
    return public


def write_public(team: Path, key: bytes) -> None:
    """Write the public half beside its archive key, unless it is there.

    Raises:
        ArchiveError: another one is there, or it cannot be written.
    """
    path, text = public_path(team), public_of(key).hex() + "\n"
    try:
        with contextlib.suppress(FileNotFoundError):
            if path.read_bytes() != text.encode():
                raise ArchiveError(f"{path} belongs to another archive key: remove it, and give the command again")
            return
        write_new(path, text.encode(), mode=PUBLIC_MODE)
    except OSError as error:
        raise ArchiveError(f"cannot write {path}: {error.strerror}") from error


def read_public(team: Path) -> bytes:
    """The public half, at a witness.

    Raises:
        ArchiveError: it is missing, or is none.
    """
    path = public_path(team)
    cure = "failover archive key writes it beside the archive key: carry it from there"
    try:
        public = bytes.fromhex(path.read_text().strip())
    except OSError as error:
        raise ArchiveError(f"cannot read {path}: {error.strerror}; {cure}") from error
    except ValueError:
        public = b""
    if len(public) != KEY_SIZE:
        raise ArchiveError(f"{path} holds no public key of {2 * KEY_SIZE} hexadecimal digits; {cure}")
    return public


def sign(key: bytes, act: str, name: str, size: int = 0, digest: bytes = b"") -> bytes:
    """What a holder of the archive key wants done with an object.

    Args:
        act: `PUT` or `REMOVE`.
        name: of the object, which says team, component, time, epoch and position.
        size, digest: of its bytes, for a put; blake3.
    """
    signature: bytes = _secret(key).sign(_statement(act, name, size, digest))
    return signature


def is_signed(public: bytes, signature: bytes, act: str, name: str, size: int = 0, digest: bytes = b"") -> bool:
    """Whether a holder of the archive key of this public half has signed this; see `sign`."""
    library = _library()
    from cryptography.exceptions import InvalidSignature

    try:
        library.Ed25519PublicKey.from_public_bytes(public).verify(signature, _statement(act, name, size, digest))
    except (InvalidSignature, ValueError):
        return False
    return True


def _statement(act: str, name: str, size: int, digest: bytes) -> bytes:
    """Each part has an end of its own: no two statements have the same bytes."""
    return b"".join((_STATEMENT, act.encode(), b"\0", name.encode(), b"\0", size.to_bytes(8, "little"), digest))


def _secret(key: bytes) -> Any:
    return _library().Ed25519PrivateKey.from_private_bytes(blake3(key, derive_key_context=_PAIR).digest())


def _library() -> Any:
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise ArchiveError(
            "sealed copies need the library cryptography, which is not installed: pip install 'failover[s3]'"
        ) from error
    return ed25519
