"""A bundle that may not run is refused with one sentence, before anything of it is unpacked; nothing is changed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from failover.core.programs import archive, bundle, manifest
from failover.core.programs.archive import BUNDLE_SIZE_MAX, END, Member
from failover.core.programs.bundle import SIGNATURE_ROOM, Signature
from failover.errors import FailoverError, ProgramError
from failover.programs import keys, packing
from tests.failover.programs.senders import Lab

DAY = 86_400


def listing(folder: Path) -> list[tuple[str, bytes]]:
    """Everything in a place, with content, but for the log, which tells what was refused."""
    return [
        (str(path), path.read_bytes() if path.is_file() else b"") for path in sorted(folder.rglob("*")) if path.suffix != ".log"
    ]


def signed(lab: Lab, content: bytes) -> bytes:
    """Whatever it is, signed by a key that is trusted."""
    secret, digest = keys.read_secret(lab.key), bundle.digest_of(content)
    said = keys.sign(secret, bundle.signed_text(digest, lab.public, 1, 0))
    return bundle.with_signature(content, Signature(digest=digest, key=lab.public, signature=said, signed_s=1))


def refused(lab: Lab, content: bytes, words: str) -> None:
    before = listing(lab.folder)
    with pytest.raises(FailoverError, match=words) as error:
        lab.store.take(content, lab.team)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400
    after = listing(lab.folder)
    assert [one for one in after if not one[0].endswith(".lock")] == [one for one in before if not one[0].endswith(".lock")]


def test_a_bundle_damaged_in_any_byte_is_refused(lab: Lab) -> None:
    whole = lab.bundle(lab.source("1", "x = 1\n"))
    before = listing(lab.folder)
    for at in range(0, len(whole), 1 if len(whole) < 6_000 else 3):
        damaged = bytearray(whole)
        damaged[at] ^= 0x20
        with pytest.raises(FailoverError):
            lab.store.take(bytes(damaged), lab.team)
    for size in range(0, len(whole), 97):
        with pytest.raises(FailoverError):
            lab.store.take(whole[:size], lab.team)
    assert listing(lab.folder) == before
    assert lab.store.take(whole, lab.team).owner == lab.user


def evil(*members: Member | bytes) -> bytes:
    """An honest manifest, and then whatever."""
    said = manifest.Manifest(name="engine", version="1", path="Lab/robot1/Engine", entry="engine.py:Engine")
    parts = [archive.pack([Member(manifest.MANIFEST, manifest.encode(said))])[: -len(END)]]
    for one in members:
        parts.append(one if isinstance(one, bytes) else archive.pack([one])[: -len(END)])
    return b"".join((*parts, END))


def renamed(path: str, kind: bytes = b"0") -> bytes:
    """A header of an empty file with another path or kind, and a right checksum."""
    block = bytearray(archive.header("x", 0))
    block[:100] = path.encode().ljust(100, b"\0")
    block[156:157], block[148:156] = kind, b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (evil(renamed("program/../../../etc/cron.d/x")), "leads outside"),
        (evil(renamed("/etc/passwd")), "leads outside"),
        (evil(renamed("program/x", b"2")), "a symbolic link"),
        (evil(renamed("program/x", b"1")), "a hard link"),
        (evil(renamed("program/x", b"3")), "a character device"),
        (evil(Member("program/engine.py", b""), Member("program/engine.py", b"")), "in the bundle twice"),
        (evil(archive.header("program/x", (8 << 30) - 1)), "is said to have 8589934591 bytes"),
        (evil(archive.header("program/x", 0) * (archive.FILES_MAX + 5)), "more than 4096 files"),
        (evil(Member("other/x", b"")), "not below program/"),
        (evil(Member("program/x", b"")), "has no file engine.py"),
    ],
)
def test_what_a_trusted_person_signed_is_not_unpacked_if_its_form_is_wrong(lab: Lab, content: bytes, words: str) -> None:
    refused(lab, signed(lab, content), words)


def unsigned(lab: Lab) -> bytes:
    return packing.pack(lab.source("1"))


def by_another_key(lab: Lab) -> bytes:
    keys.new_pair(lab.folder / "other.key")
    return packing.sign(unsigned(lab), keys.read_secret(lab.folder / "other.key"))


def with_anothers_signature(lab: Lab) -> bytes:
    """A right digest and a trusted key, and a signature of something else."""
    other = bundle.split(lab.bundle(lab.source("2")))[0]
    assert other is not None
    rest = unsigned(lab)
    return bundle.with_signature(rest, Signature(**{**_fields(other), "digest": bundle.digest_of(rest)}))


def with_longer_life(lab: Lab) -> bytes:
    """The end of the signature's life was changed."""
    found, rest = bundle.split(lab.bundle(lab.source("1"), int(time.time()) + DAY))
    assert found is not None
    return bundle.with_signature(rest, Signature(**{**_fields(found), "until_s": int(time.time()) + 9 * DAY}))


def _fields(one: Signature) -> dict[str, object]:
    return {name: getattr(one, name) for name in one.__struct_fields__}


def expired(lab: Lab) -> bytes:
    return lab.bundle(lab.source("1"), int(time.time()) - DAY)


def by_an_expired_key(lab: Lab) -> bytes:
    lab.trust(until="2020-02-29")
    return lab.bundle(lab.source("1"))


def without_the_right(lab: Lab) -> bytes:
    (lab.team / "rights.toml").write_text("")
    return lab.bundle(lab.source("1"))


def without_rules(lab: Lab) -> bytes:
    (lab.team / "rights.toml").unlink()
    return lab.bundle(lab.source("1"))


def by_a_stranger(lab: Lab) -> bytes:
    lab.trust(owner="nosuchuser")
    return lab.bundle(lab.source("1"))


def with_needs(lab: Lab) -> bytes:
    return lab.bundle(lab.source("1", more='needs = ["numpy", "no_such_module"]'))


def downgrade(lab: Lab) -> bytes:
    lab.send("2")
    with lab.hosting("2"):
        return lab.bundle(lab.source("1.9"))


def other_content(lab: Lab) -> bytes:
    lab.send("1.0")
    return lab.bundle(lab.source("1", "x = 2\n"))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (unsigned, "has no signature"),
        (by_another_key, "not in .*programs.toml"),
        (with_anothers_signature, "forged or damaged"),
        (with_longer_life, "forged or damaged"),
        (expired, "the signature of .* expired on"),
        (by_an_expired_key, "the key of .* expired on 2020-02-29"),
        (without_the_right, "may not program Lab/robot1/Engine"),
        (without_rules, "only a rule gives program"),
        (by_a_stranger, "no user 'nosuchuser'"),
        (with_needs, "needs no_such_module, not here"),
        (downgrade, "1.9 is older than 2, which runs here: a downgrade"),
        (other_content, "1 is here already with another content"),
        (lambda _: b"", "this is no bundle"),
        (lambda _: os.urandom(9_000), "this is no bundle"),
        (lambda _: bytes(BUNDLE_SIZE_MAX + 1), "this is no bundle"),
    ],
)
def test_who_may_not_is_refused_with_a_sentence(lab: Lab, make: Callable[[Lab], bytes], words: str) -> None:
    refused(lab, make(lab), words)


def test_the_programs_file_is_checked_by_the_line(lab: Lab) -> None:
    whole = lab.bundle(lab.source("1"))
    for text, words in (
        ('[[keys]]\nowner = "a"\npublic = "zz"\n', "is no key"),
        ('[[keys]]\nowner = ""\npublic = "' + "a" * 64 + '"\n', "is no user"),
        ('[[keys]]\nowner = "a"\npublic = "' + "a" * 64 + '"\nuntil = "soon"\n', "is no day"),
        ('[[keys]]\nownr = "a"\n', "ownr"),
        ("\0", "TOML"),
    ):
        (lab.team / "programs.toml").write_text(text)
        refused(lab, whole, words)


def test_what_no_bundle_can_hold_is_not_packed(lab: Lab) -> None:
    place = lab.source("1")
    (place / "link").symlink_to("/etc/shadow")
    with pytest.raises(ProgramError, match="plain files only"):
        packing.pack(place)
    (place / "link").unlink()
    os.mkfifo(place / "pipe")
    with pytest.raises(ProgramError, match="no plain file"):
        packing.pack(place)
    (place / "pipe").unlink()
    with (place / "large").open("wb") as file:
        file.truncate(BUNDLE_SIZE_MAX + 1)
    with pytest.raises(ProgramError, match="more than 67108864 bytes"):
        packing.pack(place)
    (place / "large").unlink()
    assert packing.pack(place) == packing.pack(place) and len(packing.pack(place)) > SIGNATURE_ROOM


def test_a_key_that_others_may_read_is_refused_and_none_is_overwritten(lab: Lab) -> None:
    with pytest.raises(ProgramError, match="never overwritten"):
        keys.new_pair(lab.key)
    lab.key.chmod(0o644)
    with pytest.raises(ProgramError, match="chmod 600"):
        keys.read_secret(lab.key)
    lab.key.chmod(0o600)
    lab.key.write_text("-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n")
    with pytest.raises(ProgramError, match="no key"):
        keys.read_secret(lab.key)
