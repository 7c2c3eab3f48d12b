"""What a witness keeps, proves and refuses by name, over real links; nothing here opens a copy but the key's holder."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
import pytest
from blake3 import blake3

from checkpoint.snapshot import format
from checkpoint.store.index import folder_name
from failover.archive import signature
from failover.archive.archive import Archive
from failover.archive.witness import WANTED, Put, Read, WitnessObjects
from failover.errors import ArchiveError
from tests import witnesses
from tests.checkpoint.snapshots import COMPONENT, page, pages_of, snapshot
from tests.witnesses import GATE, ROBOT, Gate

pytest.importorskip("cryptography")

KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))
SECRET = b"known to robots alone"
FIRST, SECOND, THIRD = (f"lab/@%2Flab%2Fr1%2Fmapper/{stamp:012x}-1-2-3-00ff.base.sealed" for stamp in (1, 2, 3))
OF_ANOTHER = "lab/@%2Flab%2Fr1%2Fplanner/000000000009-1-2-3-00ff.base.sealed"


@pytest.fixture
def gate(tmp_path: Path) -> Iterator[Gate]:
    with witnesses.keeping(tmp_path, KEY) as gate:
        yield gate


@pytest.fixture
def content() -> Iterator[BinaryIO]:
    with tempfile.TemporaryFile() as file:
        file.write(os.urandom(3 << 20))
        file.flush()
        yield file


def put(gate: Gate, name: str, content: BinaryIO, signed: str = "", key: bytes = KEY, digest: bytes = b"") -> str:
    """Ask to put an object, signed as one of another name, or with another key; what the witness answers."""
    size, true = os.fstat(content.fileno()).st_size, blake3(os.pread(content.fileno(), 1 << 30, 0)).digest()
    proof = signature.sign(key, signature.PUT, signed or name, size, true)
    asked = Put(name, size, digest or true, proof)
    found: str = gate.ask(msgspec.to_builtins(asked, builtin_types=(bytes,)))["found"]
    return found


@contextlib.contextmanager
def checkpoint(text: str, component: str = COMPONENT) -> Iterator[BinaryIO]:
    with tempfile.TemporaryFile() as file:
        file.write(format.encode_bytes(snapshot({1: page(text)}, component=component)))
        file.flush()
        yield file


def archive(gate: Gate, aside: Path, key: bytes = KEY) -> Archive:
    return Archive(WitnessObjects(gate, key), key, "lab", aside)


def test_a_checkpoint_comes_back_as_it_was_and_the_witness_has_no_plain_byte_of_it(gate: Gate, tmp_path: Path) -> None:
    ours = archive(gate, tmp_path)
    with checkpoint("x" * 100) as made:
        name, size = ours.put(made, ROBOT)
    (copy,) = ours.copies(COMPONENT)
    with tempfile.TemporaryFile() as back:
        assert ours.fetch(copy, back).robot == ROBOT
        assert pages_of(format.decode(back.fileno())) == {1: page("x" * 100)}
    stored = (gate.directory / name).read_bytes()
    assert len(stored) == size and page("x" * 100)[:50] not in stored and COMPONENT.encode() not in stored
    told = gate.copies.of_component(folder_name(COMPONENT))
    assert told is not None and told[:2] == (1, size)


def test_bytes_that_were_altered_or_cut_off_on_their_way_are_not_kept(gate: Gate, content: BinaryIO) -> None:
    objects = WitnessObjects(gate, KEY)
    for spoil, said in (
        (lambda part: part[:-1] + bytes([part[-1] ^ 1]), "whose digest is not the promised digest"),
        (lambda part: part[:-1], "was due"),
    ):
        gate.spoil = spoil
        with pytest.raises(ArchiveError, match=said):
            objects.put(FIRST, content)
        assert objects.size(FIRST) is None and not [one for one in gate.directory.rglob("*") if one.is_file()]
    gate.spoil = lambda part: part
    assert objects.put(FIRST, content)


@pytest.mark.parametrize(
    ("name", "how"),
    [
        (FIRST, {"key": OTHER_KEY}),
        (OF_ANOTHER, {"signed": FIRST}),
        (FIRST.replace("lab/", "other/", 1), {"signed": FIRST}),
        (FIRST.replace("-1-2-3-", "-2-2-3-"), {"signed": FIRST}),
        (FIRST, {"digest": bytes(32)}),
    ],
    ids=["by another team", "of another component", "of another team", "of another epoch", "of other bytes"],
)
def test_an_object_that_was_not_signed_for_its_name_and_bytes_is_refused_by_name(
    name: str, how: dict[str, str | bytes], gate: Gate, content: BinaryIO
) -> None:
    with pytest.raises(ArchiveError) as refusal:
        put(gate, name, content, **how)  # type: ignore[arg-type]
    assert f"refused the sealed copy {name} of {ROBOT}: its signature is not of this team's archive key" in str(refusal.value)
    assert put(gate, FIRST, content) == WANTED


def test_an_older_copy_is_refused_by_name_also_where_it_was_here_before(gate: Gate, content: BinaryIO) -> None:
    objects = WitnessObjects(gate, KEY)
    assert objects.put(FIRST, content) and objects.put(THIRD, content)
    objects.remove(FIRST)
    for old in (FIRST, SECOND):
        with pytest.raises(ArchiveError) as refusal:
            put(gate, old, content)
        assert f"refused the sealed copy {old} of {ROBOT}: it is older than the newest copy here, {THIRD}" in str(refusal.value)
    assert put(gate, OF_ANOTHER, content) == WANTED, "each component has an order of its own"


def test_a_copy_that_became_old_while_its_bytes_came_is_refused(gate: Gate, content: BinaryIO) -> None:
    assert put(gate, FIRST, content) == WANTED
    digest = blake3(os.pread(content.fileno(), 1 << 30, 0)).digest()
    with tempfile.TemporaryFile() as other:
        other.write(b"newer")
        other.flush()
        assert WitnessObjects(gate, KEY).put(SECOND, other)
    with pytest.raises(ArchiveError, match=f"{FIRST} of {ROBOT}: it is older"):
        gate.ship(digest, os.fstat(content.fileno()).st_size, content.fileno())
    assert WitnessObjects(gate, KEY).size(FIRST) is None


def test_bytes_that_were_not_asked_for_are_refused(gate: Gate, content: BinaryIO) -> None:
    with pytest.raises(ArchiveError, match=f"{GATE} has not asked for that sealed copy"):
        gate.ship(bytes(32), 10, content.fileno())


def test_nothing_is_removed_without_a_signature_for_that_name(gate: Gate, content: BinaryIO) -> None:
    WitnessObjects(gate, KEY).put(FIRST, content)
    with pytest.raises(ArchiveError, match="to be removed: its signature is not"):
        WitnessObjects(gate, OTHER_KEY).remove(FIRST)
    assert WitnessObjects(gate, KEY).size(FIRST)


@pytest.mark.parametrize("name", ["/etc/passwd", "../state", "lab/../../x", "a//b", ".", "lab/\n", "lab/" + "x" * 300, ""])
def test_a_name_leads_nowhere_else(name: str, gate: Gate, content: BinaryIO) -> None:
    with pytest.raises(ArchiveError, match="is no sealed copy"):
        put(gate, name, content)
    with pytest.raises(ArchiveError, match="keeps no sealed copy"):
        gate.ask(msgspec.to_builtins(Read(name, 0)))


def test_a_request_that_is_none_is_told_in_a_sentence(gate: Gate) -> None:
    for strange in ({}, {"act": "open"}, {"act": "read", "name": 1}, {"act": "put", "name": "x"}):
        with pytest.raises(ArchiveError, match="the request about a sealed copy was not understood"):
            gate.ask(strange)


def test_more_than_the_witness_gives_is_refused_with_the_cure(tmp_path: Path, content: BinaryIO) -> None:
    with witnesses.keeping(tmp_path, KEY, size_max=4 << 20) as gate:
        objects = WitnessObjects(gate, KEY)
        objects.put(FIRST, content)
        with pytest.raises(ArchiveError, match=r"no room for .*; raise it, or lower s3_keep at the robots"):
            objects.put(SECOND, content)
        objects.remove(FIRST)
        assert objects.put(SECOND, content)


def test_the_next_life_of_a_witness_keeps_what_this_one_kept(tmp_path: Path, content: BinaryIO) -> None:
    with witnesses.keeping(tmp_path, KEY) as gate:
        WitnessObjects(gate, KEY).put(SECOND, content)
    (gate.directory / "lab" / "arriving-1").write_bytes(b"a half")
    with witnesses.keeping(tmp_path, KEY) as again:
        assert [one.name for one in WitnessObjects(again, KEY).listed("lab")] == [SECOND]
        assert not (gate.directory / "lab" / "arriving-1").exists()
        with pytest.raises(ArchiveError, match="it is older than"):
            put(again, FIRST, content)


def test_a_witness_that_alters_exchanges_or_cuts_off_is_found_out_before_a_byte_is_used(gate: Gate, tmp_path: Path) -> None:
    ours = archive(gate, tmp_path)
    names = []
    for component in (COMPONENT, COMPONENT + "2"):
        with checkpoint("x", component=component) as made:
            names.append(gate.directory / ours.put(made, ROBOT)[0])
    whole, other = (path.read_bytes() for path in names)
    for spoiled in (whole[:-1], whole[:60] + bytes([whole[60] ^ 1]) + whole[61:], other, b""):
        names[0].write_bytes(spoiled)
        (copy,) = ours.copies(COMPONENT)
        with tempfile.TemporaryFile() as back:
            with pytest.raises(ArchiveError, match="in the archive"):
                ours.fetch(copy, back)
            assert back.seek(0, os.SEEK_END) == 0
