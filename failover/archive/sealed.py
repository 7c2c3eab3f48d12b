"""Seals an archive's objects, so that the owner of their place reads nothing and alters nothing unnoticed.

By AES-256-GCM, or ChaCha20-Poly1305 where the processor has no instructions for AES: without these AES is slow, and the time that
it takes tells of its key. An object says by which it was sealed, and opens on any robot.

The byte table is in ``ARCHIVE.md``. One key for the team, the *archive key*: 32 random bytes, ``keys/archive.key`` in the team
directory. Each object has a key of its own, derived from that, from a random salt and from the object's name: an object under
another name is refused. Its frames are numbered, and the last one is marked: a part is refused.

Sources: RFC 5869 (HKDF); NIST SP 800-38D (GCM); RFC 8439 (ChaCha20-Poly1305); Hoang, Reyhanitabar, Rogaway,
Vizár, CRYPTO 2015 (STREAM: numbered frames).
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final

from checkpoint.store.whole_file import write_new
from failover.archive.objects import Readable
from failover.errors import ArchiveError

AES: Final = b"FOARCHV1"
CHACHA: Final = b"FOARCHC1"
MAGIC_SIZE: Final = 8
SALT_SIZE: Final = 32
HEAD_SIZE: Final = MAGIC_SIZE + SALT_SIZE
FRAME_SIZE: Final = 1 << 20
TAG_SIZE: Final = 16
KEY_SIZE: Final = 32
KEY_FILE: Final = "archive.key"
FRAMES_MAX: Final = 1 << 32
PROCESSOR: Final = Path("/proc/cpuinfo")
CURE: Final = "failover archive key makes one; every robot and server of the team needs the same"


def key_path(team: Path) -> Path:
    """Where the archive key is, in a team directory. A robot's secret key ends otherwise: no name is taken."""
    return team / "keys" / KEY_FILE


def new_key(team: Path) -> Path:
    """Make an archive key; one that is there is never overwritten.

    Raises:
        ArchiveError: there is one, or it cannot be written.
    """
    path = key_path(team)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_new(path, secrets.token_hex(KEY_SIZE).encode() + b"\n")
    except FileExistsError as error:
        raise ArchiveError(
            f"{path} exists, and what was sealed with it can be opened by it alone: move it away first if you want another"
        ) from error
    except OSError as error:
        raise ArchiveError(f"cannot write {path}: {error.strerror}") from error
    return path


def read_key(team: Path) -> bytes:
    """The archive key.

    Raises:
        ArchiveError: it is missing, others may read it, or it is none.
    """
    path = key_path(team)
    try:
        with path.open() as file:
            mode, text = os.fstat(file.fileno()).st_mode, file.read(4 * KEY_SIZE).strip()
    except OSError as error:
        raise ArchiveError(f"cannot read the archive key {path}: {error.strerror}; {CURE}") from error
    except UnicodeDecodeError as error:
        raise ArchiveError(f"{path} is no archive key; {CURE}") from error
    if mode & 0o077:
        raise ArchiveError(f"{path} is open to others (mode {mode & 0o777:o}); run: chmod 600 {path}")
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_SIZE:
        raise ArchiveError(f"{path} is no archive key: it is not {2 * KEY_SIZE} hexadecimal digits; {CURE}")
    return key


def seal(key: bytes, name: str, parts: Iterator[bytes], file: BinaryIO) -> int:
    """Write sealed content to an empty file; its size in bytes.

    Args:
        name: of the object.
        parts: the content, in pieces of any size.

    Raises:
        ArchiveError: the library is not installed.
        OSError: the file does not take it.
    """
    head = (AES if has_aes() else CHACHA) + secrets.token_bytes(SALT_SIZE)
    cipher = _cipher(key, head, name)
    size = file.write(head)
    number, held = 0, bytearray()
    for part in parts:
        held += part
        while len(held) > FRAME_SIZE:  # the last frame is marked, so one is held back
            size += file.write(cipher.encrypt(_nonce(number, False), bytes(held[:FRAME_SIZE]), None))
            del held[:FRAME_SIZE]
            number += 1
    return size + file.write(cipher.encrypt(_nonce(number, True), bytes(held), None))


def unsealed(key: bytes, name: str, source: Readable) -> Iterator[bytes]:
    """The content, frame by frame: each was proved. Whoever takes frames undoes all if a later one is refused.

    Raises:
        ArchiveError: it was altered, cut off, put under another name, or sealed with another key.
    """
    cipher, number = _cipher(key, exactly(source, HEAD_SIZE), name), 0
    frame = exactly(source, FRAME_SIZE + TAG_SIZE)
    while following := exactly(source, FRAME_SIZE + TAG_SIZE):
        yield _opened(cipher, number, False, frame, name)
        number, frame = number + 1, following
    yield _opened(cipher, number, True, frame, name)


def check_end(key: bytes, name: str, head: bytes, size: int, frame: bytes) -> None:
    """Prove the last frame of a sealed object, which proves the key, the name and the size.

    Args:
        head: the first `HEAD_SIZE` bytes; ``size``: of the whole object; ``frame``: its bytes from `last_frame` on.

    Raises:
        ArchiveError: as `unsealed`.
    """
    number = (last_frame(size) - HEAD_SIZE) // (FRAME_SIZE + TAG_SIZE)
    _opened(_cipher(key, head, name), number, True, frame, name)


def last_frame(size: int) -> int:
    """Where the last frame of a sealed object of this size begins."""
    whole = max(size - HEAD_SIZE - 1, 0) // (FRAME_SIZE + TAG_SIZE)
    return HEAD_SIZE + whole * (FRAME_SIZE + TAG_SIZE)


def _opened(cipher: Any, number: int, is_last: bool, frame: bytes, name: str) -> bytes:
    from cryptography.exceptions import InvalidTag

    try:
        return bytes(cipher.decrypt(_nonce(number, is_last), frame, None))
    except (InvalidTag, ValueError) as error:
        raise ArchiveError(
            f"{name} in the archive was altered, cut off or sealed with another archive key: its frame {number} is refused, and "
            "nothing of it is used; take an older copy, or bring the right key"
        ) from error


def exactly(source: Readable, size: int) -> bytes:
    """So many bytes, or what there is."""
    content = bytearray()
    while len(content) < size and (part := source.read(size - len(content))):
        content += part
    return bytes(content)


def _nonce(number: int, is_last: bool) -> bytes:
    assert number < FRAMES_MAX, "an object ends long before"
    return number.to_bytes(11, "big") + bytes([is_last])


@cache
def has_aes() -> bool:
    """Whether the processor has instructions for AES; both kinds of processor call them so."""
    try:
        return "aes" in PROCESSOR.read_text().split()
    except OSError:
        return False


def _cipher(key: bytes, head: bytes, name: str) -> Any:
    """The cipher that an object's head names, with the key of that object. Raises ArchiveError: it names none."""
    if head[:MAGIC_SIZE] not in (AES, CHACHA) or len(head) < HEAD_SIZE:
        raise ArchiveError(f"{name} in the archive is no sealed object of this version of failover")
    magic, salt = head[:MAGIC_SIZE], head[MAGIC_SIZE:]
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
        from cryptography.hazmat.primitives.hashes import SHA256
        from cryptography.hazmat.primitives.kdf.hkdf import HKDF
    except ImportError as error:
        raise ArchiveError(
            "an archive needs the library cryptography, which is not installed: pip install 'failover[s3]'"
        ) from error
    kind, meant = (ChaCha20Poly1305, b"failover-archive-1 chacha\0") if magic == CHACHA else (AESGCM, b"failover-archive-1\0")
    return kind(HKDF(SHA256(), KEY_SIZE, salt, meant + name.encode()).derive(key))
