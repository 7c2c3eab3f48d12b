"""What a witness keeps, proves and refuses by name, over real links; nothing here opens a copy but the key's holder."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import pytest
from blake3 import blake3

from checkpoint.snapshot import format
from checkpoint.store.index import folder_name
from failover.archive import sealed, signature
from failover.archive.archive import Archive
from failover.archive.keys import WRAP_SIZE, keys_without_members
from failover.archive.objects import OLDER, FolderObjects, PutRefusedError
from failover.archive.witness import WANTED, Listed, Put, Read, Size, WitnessObjects
from failover.errors import ArchiveError
from tests import witnesses
from tests.agent.guards import until
from tests.checkpoint.snapshots import COMPONENT, page, pages_of, snapshot
from tests.witnesses import GATE, ROBOT, Gate

pytest.importorskip("cryptography")

KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))
HEAD = sealed.HEAD_SIZE_LEAST
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
    answer = gate.ask(msgspec.to_builtins(asked, builtin_types=(bytes,)))
    return str(answer.get("why") or answer["found"])


@contextlib.contextmanager
def checkpoint(text: str, component: str = COMPONENT) -> Iterator[BinaryIO]:
    with tempfile.TemporaryFile() as file:
        file.write(format.encode_bytes(snapshot({1: page(text)}, component=component)))
        file.flush()
        yield file


def archive(gate: Gate, aside: Path, key: bytes = KEY) -> Archive:
    return Archive(WitnessObjects(gate, key), keys_without_members(key), "lab", aside)


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
        with pytest.raises(ArchiveError, match=f"{FIRST} did not come to the witness: .*{said}"):
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
        said = f"refused the sealed copy {old} of {ROBOT}: it is older than the newest copy here, {THIRD}"
        assert put(gate, old, content) == said
        with pytest.raises(PutRefusedError, match="it is older than") as refusal:
            objects.put(old, content)
        assert refusal.value.why == OLDER
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
    with pytest.raises(ArchiveError, match="is the name of no sealed copy"):
        WitnessObjects(gate, KEY).remove(name)


def test_a_request_that_is_none_is_told_in_a_sentence(gate: Gate, content: BinaryIO) -> None:
    for strange in ({}, {"act": "open"}, {"act": "read", "name": 1}, {"act": "put", "name": "x"}):
        with pytest.raises(ArchiveError, match="the request about a sealed copy was not understood"):
            gate.ask(strange)
    assert WitnessObjects(gate, KEY).put(FIRST, content)
    for first, size in ((1 << 63, 1), ((1 << 64) - 1, 1), ((3 << 20) + 1, 1), (-1, 1), (0, 0), (0, -1)):
        with pytest.raises(ArchiveError, match=f"{FIRST} has 3145728 bytes: there are no {size} from byte {first} on"):
            gate.ask(msgspec.to_builtins(Read(FIRST, first, size)))
    for size in (0, -1, 1 << 63, (1 << 64) - 1):
        with pytest.raises(ArchiveError, match=f"of {size} bytes is no sealed copy"):
            gate.ask(msgspec.to_builtins(Put(SECOND, size, bytes(32), bytes(64)), builtin_types=(bytes,)))
    assert gate.ask(msgspec.to_builtins(Size("lab/\0"))) == {}
    assert gate.ask(msgspec.to_builtins(Listed("/etc"))) == {}


def test_more_than_the_witness_gives_is_refused_with_the_cure(tmp_path: Path, content: BinaryIO) -> None:
    with witnesses.keeping(tmp_path, KEY, size_max=4 << 20) as gate:
        objects = WitnessObjects(gate, KEY)
        objects.put(FIRST, content)
        said = rf"no room for {OF_ANOTHER} of 3145728 bytes: {GATE} keeps 3145728 bytes .*; raise it, lower s3_keep at the robots"
        with pytest.raises(ArchiveError, match=said):
            objects.put(OF_ANOTHER, content)
        (gate.directory / FIRST).unlink()
        assert objects.put(OF_ANOTHER, content), "the third cure that it names: somebody removes a copy there"


def test_the_next_life_of_a_witness_keeps_what_this_one_kept(tmp_path: Path, content: BinaryIO) -> None:
    with witnesses.keeping(tmp_path, KEY) as gate:
        WitnessObjects(gate, KEY).put(SECOND, content)
    (gate.directory / "lab" / "arriving-1").write_bytes(b"a half")
    (gate.directory / "arriving-team").mkdir()
    with witnesses.keeping(tmp_path, KEY) as again:
        assert [one.name for one in WitnessObjects(again, KEY).listed("lab")] == [SECOND]
        assert not (gate.directory / "lab" / "arriving-1").exists()
        assert "it is older than" in put(again, FIRST, content)


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


def test_transfers_that_do_not_arrive_leave_room_for_the_next(tmp_path: Path, content: BinaryIO) -> None:
    """Each try has another digest, as a copy that is sealed anew has."""
    with witnesses.keeping(tmp_path, KEY, size_max=4 << 20) as gate:
        objects = WitnessObjects(gate, KEY)
        spoilt = (lambda part: part[:-1] + bytes([part[-1] ^ 1]), lambda part: part[:-1])
        for spoil in spoilt:
            gate.spoil = spoil
            with pytest.raises(ArchiveError, match="did not come to the witness"):
                objects.put(FIRST, content)
            content.seek(0)
            content.write(os.urandom(32))
            content.flush()
        for number in range(3):  # asked for, and never offered
            content.seek(0)
            content.write(os.urandom(32))
            content.flush()
            assert put(gate, SECOND.replace("-1-2-3-", f"-1-2-{number}-"), content) == WANTED
        gate.spoil = lambda part: part
        assert objects.put(SECOND, content)


def test_what_is_under_way_takes_room(tmp_path: Path, content: BinaryIO) -> None:
    with witnesses.keeping(tmp_path, KEY, size_max=4 << 20) as gate:
        assert put(gate, FIRST, content) == WANTED
        gate.copies.arriving = lambda: 2 << 20
        with pytest.raises(ArchiveError, match="2097152 are on their way, and its sealed_size is 4194304"):
            gate.ship(blake3(os.pread(content.fileno(), 1 << 30, 0)).digest(), 3 << 20, content.fileno())
        with pytest.raises(ArchiveError, match="2097152 are on their way"):
            put(gate, FIRST, content)


def test_where_a_witness_is_full_older_copies_of_that_component_go_and_never_the_newest(tmp_path: Path) -> None:
    with witnesses.keeping(tmp_path, KEY, size_max=10_000) as gate:
        ours = archive(gate, tmp_path)
        names = []
        for number in range(12):
            with checkpoint(os.urandom(400).hex()) as made:
                names.append(ours.put(made, ROBOT)[0])
            assert ours.copies(COMPONENT)[0].name == names[-1], number
        kept = [copy.name for copy in reversed(ours.copies(COMPONENT))]
        assert 2 <= len(kept) < 12 and kept == names[-len(kept) :], "the oldest went first"
        with checkpoint(os.urandom(400).hex(), component=COMPONENT + "2") as made, pytest.raises(ArchiveError, match="no room"):
            ours.put(made, ROBOT)
        with tempfile.TemporaryFile() as large:
            large.write(os.urandom(9_500))
            large.flush()
            for _ in range(2):
                with pytest.raises(ArchiveError, match="no room for lab/contents/"):
                    ours.put_content(blake3(os.pread(large.fileno(), 1 << 20, 0)).digest(), large)
        assert [copy.name for copy in reversed(ours.copies(COMPONENT))] == kept, "for others none of them goes"


def test_a_copy_that_another_member_overtook_is_sealed_anew_with_a_later_time(
    gate: Gate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ours, theirs = archive(gate, tmp_path), archive(gate, tmp_path)
    overtaken: list[str] = []
    whole = ours._put_in_room

    def overtake(name: str, file: BinaryIO, spare: Sequence[str]) -> bool:
        if not overtaken:
            with checkpoint("theirs") as made:
                overtaken.append(theirs.put(made, "robot2")[0])
        return whole(name, file, spare)

    monkeypatch.setattr(ours, "_put_in_room", overtake)
    with checkpoint("ours") as made:
        name, _ = ours.put(made, ROBOT)
    assert [copy.name for copy in ours.copies(COMPONENT)] == [name, *overtaken]
    assert not caplog.records, "nobody did anything wrong"


def test_a_transfer_that_is_dropped_while_its_copy_is_stored_leaves_a_copy_that_counts(
    gate: Gate, content: BinaryIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored, dropped = threading.Event(), threading.Event()
    whole = FolderObjects.put

    def slow(self: FolderObjects, name: str, file: BinaryIO) -> bool:
        is_ours = whole(self, name, file)
        stored.set()
        dropped.wait()
        return is_ours

    monkeypatch.setattr(FolderObjects, "put", slow)

    def try_to_put() -> None:
        with contextlib.suppress(ArchiveError):
            WitnessObjects(gate, KEY).put(FIRST, content)

    putting = threading.Thread(target=try_to_put)
    putting.start()
    stored.wait()
    gate.drop_transfers()
    dropped.set()
    putting.join()
    assert until(lambda: WitnessObjects(gate, KEY).size(FIRST), "the witness's thread to end") == 3 << 20


def test_the_witness_sees_what_was_removed_or_changed_on_its_disk(gate: Gate, content: BinaryIO) -> None:
    objects = WitnessObjects(gate, KEY)
    for name in (FIRST, SECOND, THIRD):
        objects.put(name, content)
    (gate.directory / THIRD).unlink()
    assert [one.name for one in objects.listed("lab")] == [FIRST, SECOND]
    (gate.directory / SECOND).unlink()
    assert objects.size(SECOND) is None
    (gate.directory / FIRST).write_bytes(b"short")
    assert objects.size(FIRST) == 5
    (gate.directory / FIRST).unlink()
    with pytest.raises(ArchiveError, match="keeps no sealed copy"):
        objects.open(FIRST)
    assert objects.put(FIRST, content), "nothing newer is there any more"


def test_a_disk_keeps_its_reserve(gate: Gate, content: BinaryIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.archive.objects.RESERVE_SIZE", 1 << 60)
    with pytest.raises(ArchiveError, match=r"MB free: a copy needs 4 MB, and .* stay free for checkpoints; free some space"):
        WitnessObjects(gate, KEY).put(FIRST, content)


def test_who_reads_the_head_of_an_object_is_sent_little(gate: Gate, content: BinaryIO) -> None:
    objects = WitnessObjects(gate, KEY)
    objects.put(FIRST, content)
    sent: list[int] = []
    whole = gate.ask

    def ask(arguments: dict[str, Any]) -> dict[str, Any]:
        answer = whole(arguments)
        sent.append(len(answer.get("content", b"")))
        return answer

    gate.ask = ask  # type: ignore[method-assign]
    size = HEAD + 64 * WRAP_SIZE
    assert sealed.exactly(objects.open(FIRST), size) == os.pread(content.fileno(), size, 0)
    assert len(sent) == 1 and sent[0] < 10_000, "the head of an object for 64 members, in one answer"


def test_a_name_with_a_line_break_forges_no_line_of_the_log(gate: Gate, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ArchiveError, match="is the name of no sealed copy"):
        WitnessObjects(gate, OTHER_KEY).remove("lab/x\nrefused the sealed copy lab/y of robot2")
    assert not any("\n" in record.getMessage() for record in caplog.records)
