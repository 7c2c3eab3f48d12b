"""Who opens an archive's objects: each robot and server of the team by its own secret key, and the holder of the recovery key.

``failover archive key`` makes two keys. The *archive key*, ``keys/archive.key``, is at every member that archives. It names
contents and signs, and opens nothing alone. The *recovery key*, ``keys/archive.recovery``, is carried to where no robot is. With
the archive key it opens each copy, also when the robots and their keys are no more.

Each object has a content key of its own, random. Its head has that key once for each reader, sealed by what only the two ends of
a Diffie-Hellman exchange know: a fresh pair of the object, and the reader's pair. A member's pair is that of its replication
link. So a member that was taken out reads nothing that is sealed later, and a stolen archive key alone reads nothing: that holds
while each member of the team has a key. The byte table is in ``ARCHIVE.md``.

Sources: RFC 7748 (X25519), RFC 5869 (HKDF), RFC 8439 (ChaCha20-Poly1305). The exchange is that of RFC 9180 (HPKE, base mode) in
shape, with several readers of one content key.
"""

from __future__ import annotations

import base64
import contextlib
import os
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from blake3 import blake3
from msgspec import Struct

from checkpoint.store.whole_file import write_new
from failover.config.team import Z85, Team, read_secret_key
from failover.errors import ArchiveError, TeamFileError

KEY_SIZE: Final = 32
KEY_FILE: Final = "archive.key"
RECOVERY_FILE: Final = "archive.recovery"
CURE: Final = "failover archive key makes one; every robot and server of the team needs the same"

ID_SIZE: Final = 8
WRAP_SIZE: Final = ID_SIZE + KEY_SIZE + 16
COUNT_SIZE: Final = 2
READERS_MAX: Final = 4_096

_WITHOUT_KEYS: Final = "failover-archive-2 members without keys"
"""Context of the digest that is the secret key of a team's members where these have none."""

_IDS: Final = "failover-archive-2 readers"
_WRAP: Final = b"failover-archive-2 wrap\0"
_B85: Final = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;<=>?@^_`{|}~"
_FROM_Z85, _TO_Z85 = str.maketrans(Z85, _B85), str.maketrans(_B85, Z85)


class Keys(Struct, frozen=True):
    """What a member has to seal and to open with.

    Attributes:
        shared: the archive key, 32 bytes.
        readers: public keys of X25519 of all that are to open what is sealed here, 32 bytes each.
        secrets: the secret ones that are at hand here.
    """

    shared: bytes
    readers: tuple[bytes, ...]
    secrets: tuple[bytes, ...]


def key_path(team: Path) -> Path:
    """Where the archive key is, in a team directory. A robot's secret key ends otherwise: no name is taken."""
    return team / "keys" / KEY_FILE


def recovery_path(team: Path) -> Path:
    """Where the recovery key is while it is at hand."""
    return team / "keys" / RECOVERY_FILE


def new_key(team: Path) -> Path:
    """Make an archive key and its recovery key; one that is there is never overwritten.

    Returns:
        Where the archive key is.

    Raises:
        ArchiveError: there is one, or it cannot be written.
    """
    path, recovery = key_path(team), recovery_path(team)
    for there in (path, recovery):
        if there.exists():
            raise ArchiveError(
                f"{there} exists, and what was sealed with it needs it: move it to where no robot is if you want another"
            )
    secret = secrets.token_bytes(KEY_SIZE)
    shared = secrets.token_bytes(KEY_SIZE)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_new(recovery, secret.hex().encode() + b"\n")
        write_new(path, f"{shared.hex()}\n{_public_of(secret).hex()}\n".encode())
    except OSError as error:
        raise ArchiveError(f"cannot write below {path.parent}: {error.strerror}") from error
    return path


def read_key(team: Path) -> bytes:
    """The archive key alone: what names, and what signs. Raises as `read_keys`."""
    return _read_lines(key_path(team), 2, "archive key")[0]


def read_keys(directory: Path, team: Team) -> Keys:
    """The keys of a team directory, for what this member seals and opens.

    Raises:
        ArchiveError: the archive key is missing, others may read it, or it is none; the library is not installed.
        TeamFileError: the same of a secret key of a member.
    """
    shared, recovery = _read_lines(key_path(directory), 2, "archive key")
    at_hand = _secrets_of_members(directory)
    with contextlib.suppress(FileNotFoundError):
        recovery_path(directory).lstat()
        (secret,) = _read_lines(recovery_path(directory), 1, "recovery key", "bring it again, or remove it")
        if _public_of(secret) != recovery:
            raise ArchiveError(
                f"{recovery_path(directory)} was made with another archive key than {key_path(directory)}: bring the two that "
                "failover archive key made together"
            )
        at_hand.append(secret)
    readers = sorted({recovery, *_members(team, shared)})
    return Keys(shared, tuple(readers), (*at_hand, _secret_without_keys(shared)))


def check_own(keys: Keys) -> None:
    """See that who seals here could open it. Raises ArchiveError: none of the secret keys here is a reader's."""
    if ids_of(map(_public_of, keys.secrets)).isdisjoint(ids_of(keys.readers)):
        raise ArchiveError(
            "no secret key in keys of the team directory belongs to a robot or server of team.toml: nothing is sealed that could "
            "not be opened here; failover-agent check says which key is meant"
        )


def _secrets_of_members(directory: Path) -> list[bytes]:
    """Those that can be used. Raises TeamFileError: there are some, and none can."""
    found, troubles = list[bytes](), list[TeamFileError]()
    for path in sorted((directory / "keys").glob("*.secret")):
        try:
            found.append(_from_z85(read_secret_key(directory, path.stem)))
        except TeamFileError as error:
            troubles.append(error)
    if troubles and not found:
        raise troubles[0]
    return found


def keys_without_members(shared: bytes) -> Keys:
    """Those of a team whose members have no keys of their own: whoever has the archive key opens all."""
    secret = _secret_without_keys(shared)
    return Keys(shared, (_public_of(secret),), (secret,))


def _members(team: Team, shared: bytes) -> Iterable[bytes]:
    """The public keys of those that may run a component: each robot and server of any site, and never a witness."""
    for member in team.robots.values():
        if member.role != "witness":
            yield from map(_from_z85, member.keys) if member.keys else keys_without_members(shared).readers


def ids_of(readers: Iterable[bytes]) -> frozenset[bytes]:
    """By what an object's head tells its readers apart."""
    return frozenset(map(reader_id, readers))


def reader_id(reader: bytes) -> bytes:
    """Of one public key."""
    return blake3(reader, derive_key_context=_IDS).digest(ID_SIZE)


def wrapped(content_key: bytes, readers: Iterable[bytes], name: str) -> bytes:
    """A content key as the head of the object of this name has it: the fresh public key, the count, a part for each reader.

    Raises:
        ArchiveError: a reader's key is none; the library is not installed.
    """
    x25519, cipher = _library()
    pair = x25519.X25519PrivateKey.generate()
    fresh = pair.public_key().public_bytes_raw()
    parts = []
    for reader in readers:
        sealing = _key_between(pair, reader, fresh, reader, name)
        parts.append(reader_id(reader) + cipher(sealing).encrypt(bytes(12), content_key, None))
    assert len(parts) <= READERS_MAX, "a team is smaller"
    return b"".join((fresh, len(parts).to_bytes(COUNT_SIZE, "little"), *parts))


def unwrapped(wraps: bytes, at_hand: Iterable[bytes], name: str) -> bytes:
    """The content key of an object.

    Args:
        wraps: what `wrapped` returned; at_hand: secret keys.

    Raises:
        ArchiveError: none of them is a reader's, or the head was altered.
    """
    x25519, cipher = _library()
    from cryptography.exceptions import InvalidTag

    fresh, sealed_keys = wraps[:KEY_SIZE], _split(wraps)
    for secret in at_hand:
        pair = x25519.X25519PrivateKey.from_private_bytes(secret)
        public = pair.public_key().public_bytes_raw()
        if (own := reader_id(public)) not in sealed_keys:
            continue
        try:
            opening = _key_between(pair, fresh, fresh, public, name)
            return bytes(cipher(opening).decrypt(bytes(12), sealed_keys[own], None))
        except (InvalidTag, ArchiveError) as error:
            raise ArchiveError(f"{name} in the archive was altered, or put under another name: its head is refused") from error
    raise ArchiveError(
        f"{name} in the archive was sealed with other keys than those that are here: for a new member the robot that runs it "
        f"seals it anew, within some s3_every_s; where no robot is left, bring {RECOVERY_FILE}, which failover archive key made, "
        "to keys of the team directory"
    )


def ids_in(wraps: bytes) -> frozenset[bytes]:
    """Who can open an object: see `ids_of`."""
    return frozenset(_split(wraps))


def _split(wraps: bytes) -> dict[bytes, bytes]:
    first = KEY_SIZE + COUNT_SIZE
    parts = (wraps[at : at + WRAP_SIZE] for at in range(first, len(wraps), WRAP_SIZE))
    return {part[:ID_SIZE]: part[ID_SIZE:] for part in parts}


def _key_between(pair: Any, other: bytes, fresh: bytes, reader: bytes, name: str) -> bytes:
    """What the object's fresh pair and a reader's agree on, for one name. Raises ArchiveError: the other key is none."""
    x25519, _ = _library()
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF

    try:
        agreed = pair.exchange(x25519.X25519PublicKey.from_public_bytes(other))
    except ValueError as error:
        text = base64.b85encode(other).decode().translate(_TO_Z85)
        raise ArchiveError(f"{text} is no public key of X25519: see the keys of team.toml") from error
    derived: bytes = HKDF(SHA256(), KEY_SIZE, fresh + reader, _WRAP + name.encode()).derive(agreed)
    return derived


def _public_of(secret: bytes) -> bytes:
    x25519, _ = _library()
    public: bytes = x25519.X25519PrivateKey.from_private_bytes(secret).public_key().public_bytes_raw()
    return public


def _secret_without_keys(shared: bytes) -> bytes:
    return blake3(shared, derive_key_context=_WITHOUT_KEYS).digest()


def _from_z85(text: str) -> bytes:
    """A key of CURVE, which is one of X25519, as the team file writes it."""
    return base64.b85decode(text.translate(_FROM_Z85))


def _read_lines(path: Path, count: int, what: str, cure: str = CURE) -> list[bytes]:
    """Keys of 32 bytes, a line each."""
    try:
        with path.open() as file:
            mode, text = os.fstat(file.fileno()).st_mode, file.read(8 * KEY_SIZE)
    except OSError as error:
        raise ArchiveError(f"cannot read the {what} {path}: {error.strerror}; {cure}") from error
    except UnicodeDecodeError as error:
        raise ArchiveError(f"{path} is no {what}; {cure}") from error
    if mode & 0o077:
        raise ArchiveError(f"{path} is open to others (mode {mode & 0o777:o}); run: chmod 600 {path}")
    try:
        lines = [bytes.fromhex(line) for line in text.split()]
    except ValueError:
        lines = []
    if [len(line) for line in lines] != [KEY_SIZE] * count:
        raise ArchiveError(
            f"{path} is no {what}: it is not {count} times {2 * KEY_SIZE} hexadecimal digits; move it away; {cure}"
        )
    return lines


def _library() -> tuple[Any, Any]:
    try:
        from cryptography.hazmat.primitives.asymmetric import x25519
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
    except ImportError as error:
        raise ArchiveError(
            "an archive needs the library cryptography, which is not installed: pip install 'failover[s3]'"
        ) from error
    return x25519, ChaCha20Poly1305
