"""A bundle: one file that holds a program, its manifest and a signature; named by its content.

    signature.json   who vouches for all that follows; not there in a bundle that is not signed
    manifest.json    what the program is
    program/…        its files, in the order of their paths

The whole is a tar file that ``tar -xf`` reads. Its *digest*, which is its name, is BLAKE3 of all after the signature. A key signs
the text of `signed_text`: the digest, the key, and until when.
"""

from __future__ import annotations

from typing import Final

import msgspec
from blake3 import blake3
from msgspec import Struct

from failover.core.programs import archive, manifest
from failover.core.programs.archive import BLOCK, BUNDLE_SIZE_MAX, END, FILES, Member
from failover.core.programs.manifest import MANIFEST, Manifest
from failover.errors import BundleRefusedError, ProgramError

SIGNATURE: Final = "signature.json"
SIGNATURE_ROOM: Final = 2 * BLOCK
"""A header and one block: the signature is found, and the digest taken, without reading any field of a tar."""

KEY_SIZE: Final = 32
SIGNATURE_SIZE: Final = 64
"""Of Ed25519. Source: RFC 8032."""

TIME_MAX: Final = 1 << 40
"""Seconds since 1970; far beyond any calendar that matters, and well within what every language counts exactly."""


class Signature(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A person's word for a bundle.

    Attributes:
        digest: of what is signed, 64 hexadecimal digits. key: the public one, likewise. signature: 128.
        signed_s, until_s: seconds since 1970; ``until_s`` 0: for ever.
    """

    digest: str
    key: str
    signature: str
    signed_s: int
    until_s: int = 0


class Program(Struct, frozen=True):
    """A bundle that was read.

    Attributes:
        digest: its name. files: without ``program/`` before their paths.
    """

    digest: str
    manifest: Manifest
    files: tuple[Member, ...]


def signed_text(digest: str, key: str, signed_s: int, until_s: int) -> bytes:
    """What a key signs."""
    return f"failover program\n1\n{digest}\n{key}\n{signed_s}\n{until_s}\n".encode()


def digest_of(content: bytes | memoryview) -> str:
    """The name of a bundle, of its part after the signature: 64 hexadecimal digits of BLAKE3."""
    return blake3(content).hexdigest()


def pack(said: Manifest, files: list[Member]) -> bytes:
    """A bundle without a signature.

    Raises:
        ProgramError: the manifest is wrong, or a file cannot be in it.
    """
    manifest.check(said)
    if said.entry_file not in {one.path for one in files}:
        raise ProgramError(f"entry: there is no file {said.entry_file} among the {len(files)} of the program")
    inside = [Member(FILES + one.path, one.content, one.is_executable) for one in files]
    content = archive.pack([Member(MANIFEST, manifest.encode(said)), *inside])
    if len(content) + SIGNATURE_ROOM > BUNDLE_SIZE_MAX:
        raise ProgramError(f"the bundle is larger than {BUNDLE_SIZE_MAX} bytes; leave out what the program can fetch itself")
    return content


def with_signature(content: bytes | memoryview, signature: Signature) -> bytes:
    """A bundle with this signature before ``content``, a part without one."""
    said = msgspec.json.encode(signature, order="sorted").ljust(BLOCK, b" ")
    assert len(said) == BLOCK, "hexadecimal digits and two numbers"
    return archive.header(SIGNATURE, BLOCK) + said + content


def split(content: bytes | memoryview) -> tuple[Signature | None, memoryview]:
    """The signature, if there is one, and all that follows it. Nothing else is read.

    Raises:
        BundleRefusedError: it is no bundle; says why.
    """
    if not SIGNATURE_ROOM < len(content) <= BUNDLE_SIZE_MAX:
        raise BundleRefusedError(
            f"this is no bundle: it has {len(content)} bytes, {SIGNATURE_ROOM + 1} to {BUNDLE_SIZE_MAX} are possible"
        )
    view = memoryview(content)
    first = bytes(view[:BLOCK])
    if first == archive.header(SIGNATURE, BLOCK):
        return _signature(bytes(view[BLOCK:SIGNATURE_ROOM])), view[SIGNATURE_ROOM:]
    if not first.startswith(MANIFEST.encode() + b"\0"):
        raise BundleRefusedError(
            "this is no bundle: it begins neither with a signature nor with a manifest; failover program pack makes one"
        )
    return None, view


def _signature(block: bytes) -> Signature:
    try:
        found = msgspec.json.decode(block.rstrip(b" "), type=Signature)
        words = [bytes.fromhex(one) for one in (found.digest, found.key, found.signature)]
        exact = msgspec.json.encode(found, order="sorted").ljust(BLOCK, b" ")
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BundleRefusedError(f"the bundle's signature is damaged: {error}") from error
    is_ours = [one.hex() for one in words] == [found.digest, found.key, found.signature]  # in small letters
    if [len(one) for one in words] != [32, KEY_SIZE, SIGNATURE_SIZE] or not is_ours or exact != block:
        raise BundleRefusedError("the bundle's signature is damaged: it is not as failover writes it")
    if not 0 <= found.signed_s < TIME_MAX or not 0 <= found.until_s < TIME_MAX:
        raise BundleRefusedError("the bundle's signature is damaged: its times cannot be")
    return found


def read(content: bytes | memoryview) -> Program:
    """What is after the signature, with everything in it checked. Call this only once the signature is.

    Raises:
        BundleRefusedError: a file in it is not as it must be, or the manifest is wrong; names it.
    """
    first, *rest = archive.unpack(content) or (Member("", b""),)
    if first.path != MANIFEST:
        raise BundleRefusedError(f"the bundle cannot be unpacked: it has no {MANIFEST} before its files")
    try:
        said = manifest.decode(bytes(first.content))
    except ProgramError as error:
        raise BundleRefusedError(f"the bundle's manifest is wrong: {error}") from error
    if bytes(first.content) != manifest.encode(said) or first.is_executable:
        raise BundleRefusedError(f"the bundle's {MANIFEST} is not as failover writes it; pack it again")
    outside = next((one.path for one in rest if not one.path.startswith(FILES)), None)
    if outside is not None:
        raise BundleRefusedError(f"the bundle cannot be unpacked: {outside!r} is not below {FILES}")
    files = tuple(Member(one.path.removeprefix(FILES), one.content, one.is_executable) for one in rest)
    if said.entry_file not in {one.path for one in files}:
        raise BundleRefusedError(f"the bundle has no file {said.entry_file}, which its entry names")
    return Program(digest_of(content), said, files)


__all__ = ["END", "Program", "Signature", "digest_of", "pack", "read", "signed_text", "split", "with_signature"]
