"""Seals an archive's objects, so that the owner of their place reads nothing and alters nothing unnoticed.

By AES-256-GCM, or ChaCha20-Poly1305 where the processor has no instructions for AES: without these AES is slow, and the time that
it takes tells of its key. An object says by which it was sealed, and opens on any robot.

The byte table is in ``ARCHIVE.md``; who opens what, in `failover.archive.keys`. The key of an object's frames is derived from
its content key, the archive key, its whole head and its name: an object under another name, or with another head, is refused.
Its frames are numbered, and the last one is marked: a part is refused.

Sources: RFC 5869 (HKDF); NIST SP 800-38D (GCM); RFC 8439 (ChaCha20-Poly1305); Hoang, Reyhanitabar, Rogaway,
Vizár, CRYPTO 2015 (STREAM: numbered frames).
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final

from blake3 import blake3

from failover.archive.keys import COUNT_SIZE, KEY_SIZE, READERS_MAX, WRAP_SIZE, Keys, ids_in, unwrapped, wrapped
from failover.archive.objects import Readable
from failover.errors import ArchiveError

AES: Final = b"FOARCHV2"
CHACHA: Final = b"FOARCHC2"
MAGIC_SIZE: Final = 8
SALT_SIZE: Final = 32
WRAPS_AT: Final = MAGIC_SIZE + SALT_SIZE
HEAD_SIZE_LEAST: Final = WRAPS_AT + KEY_SIZE + COUNT_SIZE
FRAME_SIZE: Final = 1 << 20
TAG_SIZE: Final = 16
FRAMES_MAX: Final = 1 << 32
PROCESSOR: Final = Path("/proc/cpuinfo")


def seal(keys: Keys, name: str, parts: Iterator[bytes], file: BinaryIO) -> int:
    """Write sealed content to an empty file; its size in bytes.

    Args:
        name: of the object.
        parts: the content, in pieces of any size.

    Raises:
        ArchiveError: the library is not installed; a reader's key is none.
        OSError: the file does not take it.
    """
    content_key = secrets.token_bytes(KEY_SIZE)
    head = (AES if has_aes() else CHACHA) + secrets.token_bytes(SALT_SIZE) + wrapped(content_key, keys.readers, name)
    cipher = _cipher(content_key, keys.shared, head, name)
    size = file.write(head)
    number, held = 0, bytearray()
    for part in parts:
        held += part
        while len(held) > FRAME_SIZE:  # the last frame is marked, so one is held back
            size += file.write(cipher.encrypt(_nonce(number, False), bytes(held[:FRAME_SIZE]), None))
            del held[:FRAME_SIZE]
            number += 1
    return size + file.write(cipher.encrypt(_nonce(number, True), bytes(held), None))


def unsealed(keys: Keys, name: str, source: Readable) -> Iterator[bytes]:
    """The content, frame by frame: each was proved. Whoever takes frames undoes all if a later one is refused.

    Raises:
        ArchiveError: it was altered, cut off, put under another name, or sealed with another key.
    """
    cipher, number = _opener(keys, name, read_head(name, source)), 0
    frame = exactly(source, FRAME_SIZE + TAG_SIZE)
    while following := exactly(source, FRAME_SIZE + TAG_SIZE):
        yield _opened(cipher, number, False, frame, name)
        number, frame = number + 1, following
    yield _opened(cipher, number, True, frame, name)


def check_end(keys: Keys, name: str, head: bytes, size: int, frame: bytes) -> None:
    """Prove the last frame of a sealed object, which proves the keys, the head, the name and the size.

    Args:
        head: as `read_head` gave it; ``size``: of the whole object; ``frame``: its bytes from `last_frame` on.

    Raises:
        ArchiveError: as `unsealed`.
    """
    number = (last_frame(head, size) - len(head)) // (FRAME_SIZE + TAG_SIZE)
    _opened(_opener(keys, name, head), number, True, frame, name)


def last_frame(head: bytes, size: int) -> int:
    """Where the last frame of a sealed object of this head and size begins."""
    whole = max(size - len(head) - 1, 0) // (FRAME_SIZE + TAG_SIZE)
    return len(head) + whole * (FRAME_SIZE + TAG_SIZE)


def read_head(name: str, source: Readable) -> bytes:
    """An object's bytes before its frames. Raises ArchiveError: there is no head."""
    first = exactly(source, HEAD_SIZE_LEAST)
    size = head_size(name, first)
    head = first + exactly(source, size - len(first))
    if len(head) < size:
        raise ArchiveError(f"{name} in the archive was cut off in its head")
    return head


def head_size(name: str, first: bytes) -> int:
    """How long a head is, by its first `HEAD_SIZE_LEAST` bytes. Raises ArchiveError: they begin none."""
    count = int.from_bytes(first[-COUNT_SIZE:], "little")
    if first[:MAGIC_SIZE] not in (AES, CHACHA) or len(first) < HEAD_SIZE_LEAST or not 0 < count <= READERS_MAX:
        raise ArchiveError(f"{name} in the archive is no sealed object of this version of failover")
    return HEAD_SIZE_LEAST + count * WRAP_SIZE


def readers_in(head: bytes) -> frozenset[bytes]:
    """Who can open an object, as `failover.archive.keys.ids_of` has it."""
    return ids_in(head[WRAPS_AT:])


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


def _opener(keys: Keys, name: str, head: bytes) -> Any:
    return _cipher(unwrapped(head[WRAPS_AT:], keys.secrets, name), keys.shared, head, name)


def _cipher(content_key: bytes, shared: bytes, head: bytes, name: str) -> Any:
    """The cipher that an object's head names, with the key of its frames."""
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF

    salt, meant = head[MAGIC_SIZE:WRAPS_AT], b"failover-archive-2 frames\0" + blake3(head).digest() + name.encode()
    derived = HKDF(SHA256(), KEY_SIZE, salt, meant).derive(content_key + shared)
    return (ChaCha20Poly1305 if head[:MAGIC_SIZE] == CHACHA else AESGCM)(derived)
