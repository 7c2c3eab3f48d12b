"""MCAP files: what a killed writer leaves is read to its last whole record, by us and by others, and made whole again."""

from __future__ import annotations

import random
import struct
import sys
from pathlib import Path

import pytest

pytest.importorskip("mcap")

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from failover.core.board.recording import Schema
from failover.errors import RecordingError
from failover.recording.mcap_file import NewFile, Recorded, recover

CHUNKS = 5


def written(path: Path, close: bool = True) -> NewFile:
    """A file of five chunks of ten messages."""
    file = NewFile(path, "test")
    channel = file.channel("/r/i", Schema("s", b"{}"), {"k": "v"})
    for number in range(CHUNKS * 10):
        file.add(channel, number, number, number, b'{"n":%d}' % number)
        if number % 10 == 9:
            file.flush()
    file.close() if close else file.abandon()
    return file


def numbers(recorded: Recorded) -> list[int]:
    return [message.sequence for _, _, message in recorded.messages()]


def by_mcap(path: Path) -> list[int]:
    """As the library's own reader reads a file, by its index."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.chunk_indexes
        return [message.sequence for _, _, message in reader.iter_messages()]


def test_a_finished_file_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    recorded = Recorded(path)
    assert numbers(recorded) == by_mcap(path) == list(range(50))
    assert recorded.loss.is_finished and recorded.loss.sentence(path) == ""
    before = path.read_bytes()
    done = recover(path, "test")
    assert done.kept is None and done.messages == 50 and path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


def test_every_length_of_a_file_is_read_to_its_last_whole_record(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    written(path)
    whole = path.read_bytes()
    found = []
    for length in range(8, len(whole), 3):
        cut.write_bytes(whole[:length])
        recorded = Recorded(cut)
        got = numbers(recorded)
        assert got == list(range(len(got))) and len(got) % 10 == 0
        assert not recorded.loss.is_finished and recorded.loss.chunks == 0
        assert recorded.loss.tail < length and "it was not finished" in recorded.loss.sentence(cut)
        found.append(len(got))
    assert found == sorted(found) and set(found) == {0, 10, 20, 30, 40, 50}


def test_an_unfinished_file_is_recovered_and_kept_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path, close=False)
    torn = path.read_bytes()[:-20]
    path.write_bytes(torn)
    done = recover(path, "test")
    assert done.kept == tmp_path / "a.mcap.before" and done.kept.read_bytes() == torn
    assert done.loss.tail > 0
    assert by_mcap(path) == numbers(Recorded(path)) == list(range(done.messages))
    path.unlink()
    path.write_bytes(torn)
    with pytest.raises(RecordingError, match="from an earlier recovery"):
        recover(path, "test")
    assert path.read_bytes() == torn


def test_a_file_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = NewFile(path, "test")
    file.add(file.channel("/r/i", None, {}), 1, 1, 1, b"{}")
    file.flush()
    with pytest.raises(RecordingError, match="is being recorded now"):
        recover(path, "test")
    assert numbers(Recorded(path)) == [1] and len(list(tmp_path.iterdir())) == 1
    recorded = Recorded(path)
    file.add(file.channel("/r/new", None, {}), 2, 2, 2, b"{}")
    file.flush()
    assert numbers(recorded) == [1], "what it had when it was opened"
    assert recorded.loss.is_written and recorded.loss.tail == 0 and "it is being recorded" in recorded.loss.sentence(path)
    file.close()
    assert numbers(recorded) == [1] and by_mcap(path) == [1, 2]


def test_a_damaged_chunk_is_left_out_and_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    octets = bytearray(path.read_bytes())
    at = octets.index(b"zstd") + 40
    octets[at] ^= 0xFF
    path.write_bytes(octets)
    recorded = Recorded(path)
    assert numbers(recorded) == []  # the channel was told in the first chunk alone
    assert recorded.loss.chunks == 1 and "1 damaged chunks are left out" in recorded.loss.sentence(path)


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
@pytest.mark.parametrize("change", [0, 1, -1])
def test_a_chunk_that_unpacks_to_another_size_than_it_says_is_left_out(tmp_path: Path, codec: str, change: int) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[codec.upper()])
        writer.start()
        writer.add_message(writer.register_channel("/r/i", "json", 0), 1, b"{}" * 500, 1)
        writer.finish()
    octets = bytearray(path.read_bytes())
    at = octets.index(codec.encode()) - 16
    (size,) = struct.unpack_from("<Q", octets, at)
    struct.pack_into("<Q", octets, at, size + change)
    path.write_bytes(octets)
    recorded = Recorded(path)
    assert len(numbers(recorded)) == (change == 0) and recorded.loss.chunks == (change != 0)


def test_any_damage_is_read_around_or_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    whole = path.read_bytes()
    seed = 29
    dice = random.Random(seed)
    for _ in range(600):
        octets = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            octets[dice.randrange(8, len(octets))] = dice.randrange(256)
        path.write_bytes(octets)
        recorded = Recorded(path)
        assert set(numbers(recorded)) <= set(range(50)), seed


@pytest.mark.parametrize("content", [b"", b"x", b"\x89MCAP1\r\n" + bytes(99), bytes(4096)])
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="is no MCAP file"):
        recover(path, "test")
    assert path.read_bytes() == content and len(list(tmp_path.iterdir())) == 1


def test_a_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with pytest.raises(RecordingError, match="exists, and a recording is never overwritten"):
        NewFile(path, "test")
    assert path.read_text() == "mine"


def test_without_the_library_it_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    for act in (lambda: NewFile(tmp_path / "a.mcap", "test"), lambda: Recorded(tmp_path / "a.mcap")):
        with pytest.raises(RecordingError, match=r"needs the library mcap, .* pip install 'failover\[record\]'"):
            act()
    assert list(tmp_path.iterdir()) == []
