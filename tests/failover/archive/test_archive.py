"""An archive over a folder: what was sealed comes back, and nothing else is taken for it."""

from __future__ import annotations

import errno
import io
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import msgspec
import pytest
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import Need
from checkpoint.store import chain
from checkpoint.store.chain_files import fold_to
from failover.archive import keys, sealed
from failover.archive.archive import STAMP_MS_MAX, Archive
from failover.archive.keys import keys_without_members
from failover.archive.objects import FolderObjects
from failover.core.types import ComponentSpec
from failover.errors import ArchiveError
from tests.checkpoint.snapshots import COMPONENT, family, history, page, pages_of, snapshot

pytest.importorskip("cryptography")

KEY = bytes(range(32))
HEAD_SIZE = sealed.HEAD_SIZE_LEAST + keys.WRAP_SIZE
"""Bytes of the head of an object for one reader."""
NAME = "lab/@x/1.base.sealed"


@contextmanager
def file_of(content: bytes) -> Iterator[BinaryIO]:
    with tempfile.TemporaryFile() as file:
        file.write(content)
        file.flush()
        yield file


@pytest.fixture
def place(tmp_path: Path) -> Path:
    path = tmp_path / "place"
    path.mkdir()
    return path


def archive(place: Path, key: bytes = KEY, team: str = "lab") -> Archive:
    return Archive(FolderObjects(place), keys_without_members(key), team, place.parent)


def put(archive: Archive, made: Snapshot, spec: bytes = b"") -> str:
    with file_of(format.encode_bytes(made)) as file:
        return archive.put(file, "r1", spec)[0]


def fetched(archive: Archive, number: int = 0, component: str = COMPONENT) -> Snapshot:
    with tempfile.TemporaryFile() as file:
        archive.fetch(archive.copies(component)[number], file)
        return format.decode(file)


# --- Seals -----------------------------------------------------------------------------------------------------------


def seal(content: bytes, name: str = NAME, key: bytes = KEY) -> bytes:
    with io.BytesIO() as file:
        size = sealed.seal(keys_without_members(key), name, iter([content[:7], content[7:]]), file)
        assert size == len(file.getvalue())
        return file.getvalue()


def opened(content: bytes, name: str = NAME, key: bytes = KEY) -> bytes:
    return b"".join(sealed.unsealed(keys_without_members(key), name, io.BytesIO(content)))


def check_end(content: bytes) -> None:
    head = content[:HEAD_SIZE]
    last = sealed.last_frame(head, len(content))
    sealed.check_end(keys_without_members(KEY), NAME, sealed.read_head(NAME, io.BytesIO(content)), len(content), content[last:])


@pytest.fixture(params=[sealed.AES, sealed.CHACHA], ids=["AES", "ChaCha20"])
def magic(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """How objects begin at a robot whose processor has AES, or has not."""
    monkeypatch.setattr(sealed, "has_aes", lambda: request.param == sealed.AES)
    return bytes(request.param)


@pytest.mark.parametrize("size", [0, 1, sealed.FRAME_SIZE - 1, sealed.FRAME_SIZE, sealed.FRAME_SIZE + 1, 3 * sealed.FRAME_SIZE])
def test_what_was_sealed_comes_back(size: int, magic: bytes) -> None:
    content = os.urandom(size)
    closed = seal(content)
    assert closed[: sealed.MAGIC_SIZE] == magic
    assert opened(closed) == content
    assert size < 8 or content[:8] not in closed
    check_end(closed)


@pytest.mark.parametrize("at", range(sealed.MAGIC_SIZE))
def test_both_ends_of_an_object_do_not_prove_it_where_its_first_bytes_name_no_cipher(at: int, magic: bytes) -> None:
    closed = seal(b"secret")
    with pytest.raises(ArchiveError, match="is no sealed object of this version of failover"):
        check_end(closed[:at] + bytes([closed[at] ^ 0x80]) + closed[at + 1 :])


def test_two_seals_of_one_content_share_no_byte_beyond_chance() -> None:
    assert seal(b"secret")[:HEAD_SIZE] != seal(b"secret")[:HEAD_SIZE]


@pytest.mark.parametrize(("flags", "has"), [("flags\t: fpu aes avx", True), ("Features\t: fp asimd", False), (None, False)])
def test_a_processor_tells_whether_it_has_aes(
    flags: str | None, has: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sealed, "PROCESSOR", tmp_path / "cpuinfo")
    if flags is not None:
        (tmp_path / "cpuinfo").write_text(f"processor\t: 0\n{flags}\n")
    assert sealed.has_aes.__wrapped__() is has


def test_every_change_is_refused(magic: bytes) -> None:
    closed = seal(os.urandom(sealed.FRAME_SIZE + 100))
    frame = sealed.FRAME_SIZE + sealed.TAG_SIZE
    one, two = closed[HEAD_SIZE : HEAD_SIZE + frame], closed[HEAD_SIZE + frame :]
    head = closed[:HEAD_SIZE]
    wrong = {
        "cut at a frame": head + one,
        "cut in a frame": closed[:-1],
        "without a frame": head + two,
        "frames exchanged": head + two + one,
        "longer": closed + b"x",
        "a frame twice": head + one + one + two,
        "nothing": b"",
        "only a head": head,
        "another kind of file": b"x" * 5000,
        "the other cipher": (sealed.CHACHA if magic == sealed.AES else sealed.AES) + closed[sealed.MAGIC_SIZE :],
    }
    for at in [*range(HEAD_SIZE), *random.Random(1).sample(range(HEAD_SIZE, len(closed)), 8), len(closed) - 1]:
        wrong[f"a bit at {at}"] = closed[:at] + bytes([closed[at] ^ 1]) + closed[at + 1 :]
    for why, content in wrong.items():
        with pytest.raises(ArchiveError):
            raise AssertionError(f"{why}: {len(opened(content))} bytes were taken")


def test_another_key_and_another_name_are_refused() -> None:
    closed = seal(b"secret")
    wrong = ((NAME, bytes(32), "sealed with other keys"), ("lab/@x/2.base.sealed", KEY, "put under another name: its head"))
    for name, key, said in wrong:
        with pytest.raises(ArchiveError, match=said):
            opened(closed, name, key)


def test_the_end_proves_the_size() -> None:
    closed = seal(os.urandom(2 * sealed.FRAME_SIZE + 100))
    for wrong in (
        closed[:-1],
        closed[: sealed.last_frame(closed[:HEAD_SIZE], len(closed))],
        closed[:-1] + bytes([closed[-1] ^ 1]),
    ):
        with pytest.raises(ArchiveError):
            check_end(wrong)


# --- The key ---------------------------------------------------------------------------------------------------------


def test_a_key_is_made_once_and_read_by_its_owner_alone(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="failover archive key makes one"):
        keys.read_key(tmp_path)
    path = keys.new_key(tmp_path)
    assert path.stat().st_mode & 0o777 == 0o600 and len(keys.read_key(tmp_path)) == 32
    with pytest.raises(ArchiveError, match="exists"):
        keys.new_key(tmp_path)
    path.chmod(0o640)
    with pytest.raises(ArchiveError, match="chmod 600"):
        keys.read_key(tmp_path)
    path.chmod(0o600)
    for wrong in (b"", b"ab" * 31, b"x" * 64, b"\xff\xfe"):
        path.write_bytes(wrong)
        with pytest.raises(ArchiveError, match="is no archive key"):
            keys.read_key(tmp_path)


def test_a_key_that_the_disk_does_not_take_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ArchiveError, match="No space left"):
        keys.new_key(tmp_path)
    assert not keys.key_path(tmp_path).exists()


# --- Checkpoints -----------------------------------------------------------------------------------------------------


def test_a_checkpoint_comes_back_with_its_specification(place: Path) -> None:
    base = history(1)[0]
    spec = msgspec.msgpack.encode(ComponentSpec(COMPONENT, home="r1"))
    name = put(archive(place), base, spec)
    (copy,) = archive(place).copies()
    assert copy.name == name and copy.component == COMPONENT
    assert (copy.epoch, copy.generation, copy.sequence) == (1, 1, 1)
    with tempfile.TemporaryFile() as file:
        label = archive(place).fetch(copy, file)
        assert pages_of(format.decode(file)) == pages_of(base)
    assert label.robot == "r1" and msgspec.msgpack.decode(label.spec, type=ComponentSpec).home == "r1"
    assert list(place.parent.iterdir()) == [place], "nothing is left aside"


def test_a_second_put_of_a_checkpoint_sends_nothing(place: Path) -> None:
    base = history(1)[0]
    name = put(archive(place), base)
    before = (place / name).stat()
    assert put(archive(place), base) == name
    assert (place / name).stat() == before


@pytest.mark.parametrize("made", [history(5), family(4)], ids=["one process", "several processes"])
def test_a_chain_is_archived_as_one_base(made: tuple[Snapshot, ...], place: Path, tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}" for number in range(len(made))]
    for path, one in zip(paths, made, strict=True):
        path.write_bytes(format.encode_bytes(one))
    with tempfile.TemporaryFile() as file:
        fold_to(file, *paths)
        file.flush()
        archive(place).put(file, "r1")
    base = fetched(archive(place), component=made[0].component)
    assert base.is_base and base.position == made[-1].position
    assert pages_of(base) == pages_of(chain.fold(made))


def test_a_delta_is_no_checkpoint(place: Path) -> None:
    with pytest.raises(FormatError, match="no whole checkpoint"):
        put(archive(place), history(2)[1])


def test_only_the_newest_copies_of_a_component_stay(place: Path) -> None:
    for sequence in range(1, 6):
        put(archive(place), snapshot({1: page(str(sequence))}, sequence=sequence))
    put(archive(place), snapshot({1: page("other")}, component="/lab/other"))
    assert archive(place).thin(COMPONENT, 2) == 3
    assert [copy.sequence for copy in archive(place).copies(COMPONENT)] == [5, 4]
    assert fetched(archive(place)).contents[:1] == b"5"
    assert len(archive(place).copies()) == 3


def test_a_new_life_of_a_component_is_newer_than_all_copies_of_the_old_one(place: Path) -> None:
    for sequence in (1, 2, 3):
        put(archive(place), replace(snapshot({1: page("old")}, sequence=sequence, generation=40 * 65), epoch=40))
    name = put(archive(place), snapshot({1: page("new")}))
    assert archive(place).thin(COMPONENT, 3, but=name) == 1
    assert [(copy.epoch, copy.sequence) for copy in archive(place).copies(COMPONENT)] == [(1, 1), (40, 3), (40, 2)]
    assert fetched(archive(place)).contents[:3] == b"new"


def test_a_clock_that_is_behind_makes_no_copy_older_than_those_before(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = put(archive(place), snapshot({1: page("1")}))
    monkeypatch.setattr("failover.archive.archive.time", SimpleNamespace(time=lambda: 1000.0))
    second = put(archive(place), snapshot({1: page("2")}, sequence=2))
    newest, older = archive(place).copies()
    assert (newest.name, older.name) == (second, first) and newest.stamp_ms == older.stamp_ms + 1
    with tempfile.TemporaryFile() as file:
        assert archive(place).fetch(newest, file).at_s == 1000.0


def test_what_was_just_put_stays_whatever_the_owner_of_the_place_names_newer(place: Path) -> None:
    name = put(archive(place), history(1)[0])
    for number in range(3):
        (place / name).with_name(f"{STAMP_MS_MAX:012x}-9-9-{number}-0.base.sealed").touch()
    assert archive(place).thin(COMPONENT, 2, but=name) == 1
    assert name in [copy.name for copy in archive(place).copies()]
    later = put(archive(place), history(2)[0])
    assert later == name, "it is there"


@pytest.mark.parametrize("size", [0, 10, -5])
def test_a_copy_that_was_harmed_is_put_anew(size: int, place: Path) -> None:
    name = put(archive(place), history(1)[0])
    content = (place / name).read_bytes()
    (place / name).write_bytes(content[:size])
    again = put(archive(place), history(1)[0])
    assert again != name and archive(place).copies()[0].name == again
    assert pages_of(fetched(archive(place))) == pages_of(history(1)[0])


@pytest.mark.parametrize("size", [0, 10, -5])
def test_a_needed_file_that_was_harmed_is_replaced(size: int, place: Path) -> None:
    content = os.urandom(3000)
    digest = blake3(content).digest()
    with file_of(content) as file:
        archive(place).put_content(digest, file)
        (stored,) = place.rglob("*.sealed")
        stored.write_bytes(stored.read_bytes()[:size])
        assert not archive(place).holds_whole(digest)
        archive(place).put_content(digest, file)
    assert archive(place).holds_whole(digest)
    with tempfile.TemporaryFile() as file:
        archive(place).fetch_content(Need("/opt/mapper", len(content), digest), file)


def test_a_needed_file_that_changes_while_it_is_sealed_leaves_no_object(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = os.urandom(3000)
    digest = blake3(content).digest()
    real = sealed.seal

    def changed(*arguments: Any) -> int:
        os.pwrite(file.fileno(), b"other", 10)
        return real(*arguments)

    monkeypatch.setattr(sealed, "seal", changed)
    with file_of(content) as file, pytest.raises(ArchiveError, match="changed meanwhile"):
        archive(place).put_content(digest, file)
    assert not archive(place).holds_whole(digest)


def test_a_disk_that_is_nearly_full_takes_no_copy(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.archive.objects.RESERVE_SIZE", 1 << 60)
    with pytest.raises(ArchiveError, match=r"MB free: a copy needs 1 MB, and .* stay free for checkpoints; free some space"):
        put(archive(place), history(1)[0])
    assert archive(place).copies() == []


def test_the_owner_of_the_place_cannot_pass_one_checkpoint_off_as_another(place: Path) -> None:
    old, new = (put(archive(place), snapshot({1: page(str(number))}, sequence=number)) for number in (1, 2))
    (place / new).write_bytes((place / old).read_bytes())
    with pytest.raises(ArchiveError, match="altered"):
        fetched(archive(place))
    assert fetched(archive(place), 1).contents[:1] == b"1"
    for file in place.rglob("*.sealed"):
        assert b"mapper" not in file.read_bytes()


STRANGE = (
    *("x", "@x/y", "@x/y.base.sealed", "@x/1-1-2.base.sealed", "@x/1-1-2-3-4.delta.sealed", "@z/y/1-1-2-3-4.base.sealed"),
    *("@x/z-1-2-3-4.base.sealed", "@x/-1-1-2-3-4.base.sealed", "@x/ffffffffffffffff-1-2-3-4.base.sealed", "@x/1-1-2-3-4.base"),
)


def test_other_objects_of_the_place_are_no_checkpoints(place: Path) -> None:
    name = put(archive(place), history(1)[0])
    for other in (*STRANGE, "contents/1-1-2-3-4.base.sealed", "1-1-2-3-4.base.sealed"):
        path = place / "lab" / other
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert [copy.name for copy in archive(place).copies()] == [name]


def test_what_arrived_otherwise_than_it_was_sent_is_found_at_once(place: Path) -> None:
    class Losing(FolderObjects):
        def put(self, name: str, content: BinaryIO) -> bool:
            is_new = super().put(name, content)
            with (place / name).open("r+b") as file:
                file.truncate(os.fstat(file.fileno()).st_size - 1)
            return is_new

    with (
        pytest.raises(ArchiveError, match="does not come back from it: it was sent with"),
        file_of(format.encode_bytes(history(1)[0])) as file,
    ):
        Archive(Losing(place), keys_without_members(KEY), "lab", place.parent).put(file, "r1")
    assert archive(place).copies() == []
    assert put(archive(place), history(1)[0]) == archive(place).copies()[0].name, "the next try is a new one"


def test_another_team_and_another_key_read_nothing(place: Path) -> None:
    put(archive(place), history(1)[0])
    assert archive(place, team="other").copies() == []
    with pytest.raises(ArchiveError, match="sealed with other keys"):
        fetched(archive(place, key=bytes(32)))


def test_files_that_a_program_needs_are_kept_once_under_names_that_tell_nothing(place: Path) -> None:
    content = os.urandom(3_000_000)
    digest = blake3(content).digest()
    need = Need("/opt/mapper", len(content), digest)
    assert not archive(place).holds_whole(digest)
    with pytest.raises(ArchiveError, match=r"/opt/mapper.* is not in the archive"), tempfile.TemporaryFile() as file:
        archive(place).fetch_content(need, file)
    with file_of(content) as file:
        archive(place).put_content(digest, file)
    assert archive(place).holds_whole(digest)
    assert not [path for path in place.rglob("*") if digest.hex() in path.name]
    with tempfile.TemporaryFile() as file:
        archive(place).fetch_content(need, file)
        file.seek(0)
        assert file.read() == content
    (stored,) = place.rglob("*.sealed")
    stored.unlink()
    with pytest.raises(ArchiveError, match="changed meanwhile"), file_of(b"changed") as file:
        archive(place).put_content(digest, file)
    assert archive(place).copies() == []


class Breaking(FolderObjects):
    """A place whose connection breaks: each read of an object fails while ``is_broken``."""

    is_broken = False

    def open(self, name: str, first: int = 0) -> BinaryIO:
        if self.is_broken:
            raise ArchiveError("the archive's place does not answer: connection reset")
        return super().open(name, first)

    def put(self, name: str, content: BinaryIO) -> bool:
        is_new = super().put(name, content)
        self.is_broken = True
        return is_new


def test_a_place_that_does_not_answer_for_a_moment_is_no_fault_of_an_object(place: Path) -> None:
    objects = Breaking(place)
    there = Archive(objects, keys_without_members(KEY), "lab", place.parent)
    content = b"a file"
    digest = blake3(content).digest()
    with pytest.raises(ArchiveError, match="connection reset"), file_of(content) as file:
        there.put_content(digest, file)
    assert archive(place).holds_whole(digest), "it arrived"
    for act in (there.holds_whole, there.holds_for_all):
        with pytest.raises(ArchiveError, match="connection reset"):
            act(digest)
    with pytest.raises(ArchiveError, match="connection reset"), file_of(content) as file:
        there.put_content(digest, file)
    assert archive(place).holds_whole(digest)
    with pytest.raises(ArchiveError, match="connection reset"):
        put(there, history(1)[0])
    assert len(archive(place).copies()) == 1 and fetched(archive(place)).position == history(1)[0].position


def test_a_file_that_is_sealed_for_other_readers_stays_until_its_successor_is_ready(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = os.urandom(10_000)
    digest = blake3(content).digest()
    with file_of(content) as file:
        archive(place).put_content(digest, file)
    wanted = replace(keys_without_members(KEY), readers=(*keys_without_members(KEY).readers, bytes(range(1, 33))))
    joined = Archive(FolderObjects(place), wanted, "lab", place.parent)
    assert joined.holds_whole(digest) and not joined.holds_for_all(digest)
    with monkeypatch.context() as patch, file_of(content) as file:
        patch.setattr("failover.archive.objects.RESERVE_SIZE", 1 << 60)
        with pytest.raises(ArchiveError, match="MB free"):
            joined.put_content(digest, file)
    with file_of(b"another content") as file, pytest.raises(ArchiveError, match="was changed meanwhile"):
        joined.put_content(digest, file)
    assert archive(place).holds_whole(digest)
    with file_of(content) as file:
        joined.put_content(digest, file)
    assert joined.holds_for_all(digest) and archive(place).holds_whole(digest)


def test_a_file_that_another_member_has_sealed_anew_meanwhile_is_not_replaced(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = os.urandom(10_000)
    digest = blake3(content).digest()
    with file_of(content) as file:
        archive(place).put_content(digest, file)
    wanted = replace(keys_without_members(KEY), readers=(*keys_without_members(KEY).readers, bytes(range(1, 33))))
    first, second = (Archive(FolderObjects(place), wanted, "lab", place.parent) for _ in range(2))
    real = sealed.seal

    def seal_after_the_other(*arguments: Any) -> int:
        monkeypatch.setattr(sealed, "seal", real)
        with file_of(content) as file:
            second.put_content(digest, file)
        (found,) = place.rglob("contents/*.sealed")
        made.append(found.read_bytes())
        return real(*arguments)

    made: list[bytes] = []
    monkeypatch.setattr(sealed, "seal", seal_after_the_other)
    with file_of(content) as file:
        first.put_content(digest, file)
    (found,) = place.rglob("contents/*.sealed")
    assert [found.read_bytes()] == made
