"""A bundle is what `pack` writes, to the byte; anything else is refused with a sentence before anything is unpacked."""

from __future__ import annotations

import contextlib
import io
import tarfile
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.core.programs import archive, bundle, manifest
from failover.core.programs.archive import BLOCK, END, FILES_MAX, Member
from failover.core.programs.bundle import Signature
from failover.core.programs.manifest import Health, Manifest, Permissions
from failover.errors import BundleRefusedError, ProgramError

SAID = Manifest(name="engine", version="1.2", path="Lab/robot1/PWM", entry="engine.py:Engine")
FILES = [Member("engine.py", b"print(1)\n"), Member("tools/run", b"#!/bin/sh\n", True)]
WHOLE = bundle.pack(SAID, FILES)
SIGNED = Signature(digest=bundle.digest_of(WHOLE), key="ab" * 32, signature="cd" * 64, signed_s=1)

steps = st.text(st.characters(min_codepoint=33, max_codepoint=0x24F, exclude_characters="/\\"), min_size=1, max_size=30).filter(
    lambda step: step not in (".", "..") and step.isprintable()
)
paths = st.lists(steps, min_size=1, max_size=4).map("/".join)


@given(st.dictionaries(paths, st.tuples(st.binary(max_size=1500), st.booleans()), max_size=6), st.randoms(use_true_random=False))
def test_what_is_packed_is_read_again_in_whatever_order_it_came(found: dict[str, tuple[bytes, bool]], dice: object) -> None:
    members = [Member(path, *rest) for path, rest in found.items()]
    try:
        content = archive.pack(members)
    except ProgramError:
        assert any(f"{one}/".startswith(f"{other}/") for one in found for other in found if one != other)
        return
    dice.shuffle(members)  # type: ignore[attr-defined]
    assert archive.pack(members) == content
    assert {one.path: (bytes(one.content), one.is_executable) for one in archive.unpack(content)} == found
    with tarfile.open(fileobj=io.BytesIO(content)) as opened:
        assert set(opened.getnames()) == set(found)


def test_every_damaged_byte_is_refused_or_changes_the_digest() -> None:
    """Bytes of a file's content and the manifest's words may be others: then the signature does not fit."""
    for at in range(len(WHOLE)):
        damaged = bytearray(WHOLE)
        damaged[at] ^= 0x41
        assert bundle.digest_of(damaged) != SIGNED.digest
        with contextlib.suppress(BundleRefusedError):
            bundle.read(bytes(damaged))


@settings(max_examples=200)
@given(st.binary(max_size=4 * BLOCK), st.integers(0, len(WHOLE)))
def test_junk_ends_in_a_sentence(junk: bytes, at: int) -> None:
    for content in (junk, WHOLE[:at] + junk, junk + WHOLE[at:]):
        if content == WHOLE:
            continue
        for read in (bundle.split, bundle.read):
            with contextlib.suppress(BundleRefusedError):
                read(content)  # type: ignore[operator]


def tarred(*members: tarfile.TarInfo, contents: bytes = b"") -> bytes:
    """As another tar writes them, after an honest manifest."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as opened:
        for one in members:
            opened.addfile(one, io.BytesIO(contents))
    return archive.header("manifest.json", 0) + file.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", size: int = 0) -> tarfile.TarInfo:
    found = tarfile.TarInfo(name)
    found.type, found.linkname, found.size = kind, link, size
    return found


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (tarred(member("program/a", tarfile.SYMTYPE, "/etc/shadow")), "a symbolic link"),
        (tarred(member("program/a", tarfile.LNKTYPE, "program/b")), "a hard link"),
        (tarred(member("program/a", tarfile.CHRTYPE)), "a character device"),
        (tarred(member("program/a", tarfile.BLKTYPE)), "a block device"),
        (tarred(member("program/a", tarfile.FIFOTYPE)), "a fifo"),
        (tarred(member("program/a", tarfile.DIRTYPE)), "a directory of its own"),
        (tarred(member("program/a", tarfile.GNUTYPE_SPARSE)), "a sparse file"),
        (tarred(member("program/a", tarfile.XHDTYPE)), "an extended header"),
        (tarred(member("../a")), "leads outside"),
        (tarred(member("/etc/passwd")), "leads outside"),
        (tarred(member("program/../../a")), "leads outside"),
        (tarred(member("program//a")), "leads outside, or has an empty step"),
        (tarred(member("program/a\nb")), "cannot be seen"),
        (archive.header("a", 1 << 32) + END, "is said to have 4294967296 bytes"),
        (archive.header("a", 3) + b"abc" + b"x" * 509 + END, "hidden behind the end"),
        (archive.header("a", 0) * 2 + END, "in the bundle twice"),
        (archive.header("a", 0) + archive.header("a/b", 0) + END, "would be a file, and the folder of"),
        (archive.header("b", 0) + archive.header("a", 0) + END, "not in the order"),
        (archive.header("a", 0) * (FILES_MAX + 2) + END, f"more than {FILES_MAX} files"),
        (archive.header("a", 0) + END + b"x", "something follows its end"),
        (archive.header("a", 0) + bytes(BLOCK), "its end is cut off"),
        (archive.header("a", 0), "its end is missing"),
        (archive.header("a", 0).replace(b"0000644", b"0004755") + END, "not as failover writes it"),
        (b"", "its end is missing"),
    ],
)
def test_what_a_bundle_must_not_hold_is_named(content: bytes, words: str) -> None:
    with pytest.raises(BundleRefusedError, match=words):
        archive.unpack(content)


def test_a_negative_size_is_refused() -> None:
    with pytest.raises(BundleRefusedError):
        archive.unpack(archive.header("a", -5) + bytes(BLOCK) + END)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: archive.pack([Member(MANIFEST_PATH, b"{}")]), "manifest is wrong"),
        (lambda: archive.pack([Member(MANIFEST_PATH, manifest.encode(SAID)), Member("other/x", b"")]), "not below program/"),
        (lambda: archive.pack([Member(MANIFEST_PATH, manifest.encode(SAID)), Member("program/x", b"")]), "no file engine.py"),
        (lambda: archive.pack([Member(MANIFEST_PATH, b" " + manifest.encode(SAID))]), "not as failover writes it"),
        (lambda: archive.pack([Member("program/engine.py", b"")]), "no manifest.json"),
        (lambda: archive.pack([]), "no manifest.json"),
    ],
)
def test_a_bundle_without_what_it_must_hold_is_named(make: Callable[[], bytes], words: str) -> None:
    with pytest.raises(BundleRefusedError, match=words):
        bundle.read(make())


MANIFEST_PATH = manifest.MANIFEST


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "../engine"}, "name: "),
        ({"name": ""}, "name: "),
        ({"version": "1.x"}, "is no version"),
        ({"version": "01"}, "is no version"),
        ({"path": "a b/c"}, "path: "),
        ({"path": "/Lab/x"}, "normal form"),
        ({"entry": "engine.py"}, "entry: "),
        ({"entry": "../engine.py:Engine"}, "leads outside"),
        ({"entry": "engine.sh:Engine"}, "entry: "),
        ({"needs": ("os; rm",)}, "needs: "),
        ({"author": "a\x1b[2J"}, "author: "),
        ({"state": 0}, "state: "),
        ({"permissions": Permissions(devices=("/dev/../etc/shadow",))}, "permissions.devices"),
        ({"permissions": Permissions(devices=("/etc/shadow",))}, "permissions.devices"),
        ({"permissions": Permissions(memory_mb=-1)}, "permissions.memory_mb"),
        ({"health": Health(seconds=-1)}, "health.seconds"),
        ({"health": Health(seconds=float("nan"))}, "health.seconds"),
        ({"health": Health(seconds=float("inf"))}, "health.seconds"),
        ({"health": Health(messages=10**400)}, "health.messages"),
        ({"health": Health(answer_s=0)}, "health.answer_s"),
        ({"health": Health(query="a b")}, "health.query"),
    ],
)
def test_a_wrong_word_of_the_manifest_is_named(change: dict[str, object], words: str) -> None:
    with pytest.raises(ProgramError, match=words):
        manifest.check(msgspec.structs.replace(SAID, **change))


def test_an_unknown_key_of_the_manifest_is_refused() -> None:
    with pytest.raises(ProgramError, match="unknown field `root`"):
        manifest.decode(b'{"root":true,' + manifest.encode(SAID)[1:])


def test_a_signature_is_found_before_anything_else_is_read() -> None:
    signature, rest = bundle.split(bundle.with_signature(WHOLE, SIGNED))
    assert signature == SIGNED and bytes(rest) == WHOLE
    assert bundle.split(WHOLE)[0] is None
    with tarfile.open(fileobj=io.BytesIO(bundle.with_signature(WHOLE, SIGNED))) as opened:
        assert opened.getnames() == ["signature.json", "manifest.json", "program/engine.py", "program/tools/run"]


def test_every_damaged_byte_of_a_signature_is_refused_or_is_another_signature() -> None:
    whole = bundle.with_signature(WHOLE, SIGNED)
    for at in range(bundle.SIGNATURE_ROOM):
        damaged = bytearray(whole)
        damaged[at] ^= 0x01
        with contextlib.suppress(BundleRefusedError):
            assert bundle.split(damaged)[0] != SIGNED
