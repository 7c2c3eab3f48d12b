"""A person's key pair, and what it signs: Ed25519. The only ``cryptography`` import; it comes with the extra ``programs``.

The secret key is a file as openssl writes it (PKCS #8, PEM), 0600; the public one is 64 hexadecimal digits. Source: RFC 8032.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from checkpoint.store.whole_file import write_new
from failover.errors import ProgramError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    SecretKey = Ed25519PrivateKey

KEY_FILE_SIZE_MAX: Final = 4 << 10


def new_pair(path: Path) -> str:
    """Make a pair, and keep the secret half in a new file.

    Returns:
        The public half.

    Raises:
        ProgramError: the file is there already, or cannot be written.
    """
    from cryptography.hazmat.primitives import serialization

    secret = _ed25519().Ed25519PrivateKey.generate()
    content = secret.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    try:
        write_new(path, content)
    except FileExistsError as error:
        raise ProgramError(f"{path} exists, and a key is never overwritten: name another file, or move that one away") from error
    except OSError as error:
        raise ProgramError(f"cannot write the key {path}: {error.strerror}") from error
    return _public(secret)


def read_secret(path: Path) -> SecretKey:
    """A secret key.

    Raises:
        ProgramError: it is missing, others may read it, or it is no Ed25519 key.
    """
    ed25519 = _ed25519()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization

    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            content = file.read(KEY_FILE_SIZE_MAX)
    except OSError as error:
        raise ProgramError(f"cannot read the key {path}: {error.strerror}; failover program key makes one") from error
    if mode & 0o077:
        raise ProgramError(f"the key {path} is open to others (mode {mode & 0o777:o}); run: chmod 600 {path}")
    try:
        found = serialization.load_pem_private_key(content, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise ProgramError(f"{path} is no key without a password in PEM; failover program key makes one") from error
    if not isinstance(found, ed25519.Ed25519PrivateKey):
        raise ProgramError(f"{path} is no Ed25519 key; failover program key makes one")
    secret: SecretKey = found
    return secret


def public_of(secret: SecretKey) -> str:
    """The public half, 64 hexadecimal digits."""
    return _public(secret)


def sign(secret: SecretKey, text: bytes) -> str:
    """The signature, 128 hexadecimal digits."""
    return secret.sign(text).hex()


def is_signed(text: bytes, public: str, signature: str) -> bool:
    """Whether the owner of a public key has signed this.

    Raises:
        ProgramError: the library is not installed.
    """
    ed25519 = _ed25519()
    from cryptography.exceptions import InvalidSignature

    try:
        ed25519.Ed25519PublicKey.from_public_bytes(bytes.fromhex(public)).verify(bytes.fromhex(signature), text)
    except (InvalidSignature, ValueError):
        return False
    return True


def _public(secret: SecretKey) -> str:
    from cryptography.hazmat.primitives import serialization

    return secret.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw).hex()


def _ed25519() -> Any:
    """The module, which is loaded late."""
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise ProgramError(
            "keys and signatures need the library cryptography, which is not installed: pip install 'failover[programs]'"
        ) from error
    return ed25519
