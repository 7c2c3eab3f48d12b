"""The shared segment: a reader always gets one commit, whichever process is killed, stuck or hostile."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from checkpoint.errors import SegmentBusyError, SegmentError
from checkpoint.segment import layout as segment_layout
from checkpoint.segment.layout import ARRAY, BANKS, NEWEST_OFFSET, PAGE, PENDING, STATE, Layout, Region, lock_of
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.writer import SegmentWriter
from tests.checkpoint.segments import LINEAGE, Telling, committing_child, layout, number_read, source

KILLS = int(os.environ.get("FAILOVER_SEGMENT_KILLS", "300"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))


@contextmanager
def opened(made: Layout) -> Iterator[tuple[SegmentWriter, SegmentReader]]:
    writer = SegmentWriter(made)
    reader = SegmentReader(writer.descriptor)
    try:
        yield writer, reader
    finally:
        reader.close()
        writer.close()


def pages_read(reader: SegmentReader, since: int) -> list[int]:
    found = reader.read(since)
    return [] if found is None else found.pages.tolist()


def test_nothing_is_read_before_the_first_commit() -> None:
    with opened(layout()) as (_, reader):
        assert reader.read() is None
        assert reader.newest() == 0


def test_a_commit_is_read_as_it_was_written() -> None:
    with opened(layout(100, 3 * PAGE, 2 * PAGE + 5)) as (writer, reader):
        assert writer.commit([source(b"state"), source(b"a" * 3 * PAGE), source(b"b" * (2 * PAGE + 5))])
        found = reader.read()
        assert found is not None
        assert found.number == 1
        assert bytes(found.region(0)) == b"state".ljust(100, b"\0")
        assert bytes(found.region(1)) == b"a" * 3 * PAGE
        assert bytes(found.region(2)) == b"b" * (2 * PAGE + 5)
        assert abs(found.clocks.realtime_ns - time.time_ns()) < 60e9


@pytest.mark.parametrize("outputs", [None, (0, 0), (7, 9), PENDING])
def test_a_commit_says_what_its_program_had_written(outputs: segment_layout.Outputs) -> None:
    with opened(layout()) as (writer, reader):
        writer.commit([source(b"state"), source(b"")], outputs)
        found = reader.read()
        assert found is not None and found.outputs == outputs


def test_only_what_changed_since_the_last_reading_is_read_again() -> None:
    array = bytearray(8 * PAGE)
    with opened(layout(PAGE, 8 * PAGE)) as (writer, reader):
        writer.commit([source(b"1"), source(array)])
        array[5 * PAGE] = 1
        writer.commit([source(b"1"), source(array)])
        assert pages_read(reader, 1) == [6]
        array[0] = 1
        writer.commit([source(b"2"), source(array)])
        assert pages_read(reader, 2) == [0, 1]
        assert pages_read(reader, 1) == [0, 1, 6]
        assert pages_read(reader, 3) == []


def test_the_program_may_say_itself_which_pages_it_wrote() -> None:
    array = bytearray(8 * PAGE)
    with opened(layout(PAGE, 8 * PAGE)) as (writer, reader):
        array[2 * PAGE] = 9
        writer.commit([source(b"1"), source(array, [2])])
        assert pages_read(reader, 0) == [0, 3]
        array[3 * PAGE] = 9
        writer.commit([source(b"1"), source(array, [3])])
        assert pages_read(reader, 1) == [4]
        found = reader.read()
        assert found is not None and found.region(1) == array


def test_whatever_a_program_commits_every_reader_has_it_exactly() -> None:
    """Random states of every size, read whole and as differences by readers that are late by different amounts."""
    dice = random.Random(SEED)
    room = 6 * PAGE
    print(f"FAILOVER_SEED={SEED}")
    with opened(layout(room, room)) as (writer, reader):
        copies = {lateness: (0, bytearray(2 * room)) for lateness in (1, 2, 5, 9)}
        array = bytearray(room)
        for turn in range(400):
            state = dice.choice([b"\0", b"x", bytes([dice.randrange(3)])]) * dice.randrange(room)
            array[dice.randrange(room)] = dice.randrange(3)
            assert writer.commit([source(state), source(array)])
            for lateness, (since, copy) in copies.items():
                if turn % lateness:
                    continue
                found = reader.read(since)
                assert found is not None
                for place, page in enumerate(found.pages.tolist()):
                    copy[page * PAGE : (page + 1) * PAGE] = found.contents[place * PAGE : (place + 1) * PAGE]
                assert copy == state.ljust(room, b"\0") + array, f"turn {turn}, late by {lateness}, seed {SEED}"
                copies[lateness] = found.number, copy


def test_a_reader_that_never_lets_go_stops_no_commit() -> None:
    state = Telling()
    with opened(layout()) as (writer, reader):
        assert writer.commit(state.sources(1))
        with reader._held(0) as is_held:
            assert is_held
            for number in range(2, 50):
                assert writer.commit(state.sources(number))
        found = reader.read()
        assert found is not None and number_read(found) == 49


def test_banks_are_written_in_turn_so_that_none_has_missed_much() -> None:
    state = Telling()
    with opened(layout()) as (writer, reader):
        for number in range(1, 8):
            assert writer.commit(state.sources(number))
            assert reader._word(NEWEST_OFFSET) % 256 == (number - 1) % BANKS
        with reader._held(4 % BANKS):
            assert writer.commit(state.sources(8))
            assert reader._word(NEWEST_OFFSET) % 256 == 5 % BANKS, "the next in turn is held: the one after it"


def test_when_readers_hold_every_other_bank_a_commit_is_made_up_for_by_the_next() -> None:
    state = Telling()
    with opened(layout()) as (writer, reader):
        for number in (1, 2, 3):
            assert writer.commit(state.sources(number))
        with reader._held(0), reader._held(1):
            assert not writer.commit(state.sources(4))
            found = reader.read()
            assert found is not None and number_read(found) == 3
        state.array[:] = 0
        assert writer.commit(state.sources(4))
        found = reader.read()
        assert found is not None and number_read(found) == 4


def test_a_bank_that_is_being_written_is_said_to_be_busy() -> None:
    with opened(layout()) as (writer, reader):
        writer.commit(Telling().sources(1))
        fcntl.fcntl(writer.descriptor, fcntl.F_OFD_SETLK, lock_of(fcntl.F_WRLCK, 0))
        with pytest.raises(SegmentBusyError):
            reader.read()
        fcntl.fcntl(writer.descriptor, fcntl.F_OFD_SETLK, lock_of(fcntl.F_UNLCK, 0))
        assert reader.read() is not None


def test_a_bank_that_was_torn_between_the_look_and_the_lock_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer names another bank, begins this one again and is killed: all while the reader has only looked."""
    state = Telling()
    with opened(layout()) as (writer, reader):
        writer.commit(state.sources(1))
        honest = SegmentReader._held

        def overtaken(self: SegmentReader, bank: int) -> contextlib.AbstractContextManager[bool]:
            monkeypatch.undo()
            writer.commit(state.sources(2))
            writer._words[(segment_layout.RECORDS_OFFSET + bank * segment_layout.RECORD_SIZE) // 8] = 0
            return honest(self, bank)

        monkeypatch.setattr(SegmentReader, "_held", overtaken)
        found = reader.read()
        assert found is not None and number_read(found) == 2


def test_a_commit_that_is_not_named_yet_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer comes round to the bank that the reader has looked at, has written it, and is killed before it says so."""
    state = Telling()
    with opened(layout()) as (writer, reader):
        writer.commit(state.sources(1))
        honest = SegmentReader._held

        def overtaken(self: SegmentReader, bank: int) -> contextlib.AbstractContextManager[bool]:
            monkeypatch.undo()
            for number in range(2, BANKS + 1):
                writer.commit(state.sources(number))
            named = reader._word(NEWEST_OFFSET)
            writer.commit(state.sources(BANKS + 1))
            assert reader._word(NEWEST_OFFSET) % 256 == bank, "it has come round"
            writer._words[NEWEST_OFFSET // 8] = named
            return honest(self, bank)

        monkeypatch.setattr(SegmentReader, "_held", overtaken)
        for _ in range(2):
            found = reader.read()
            assert found is not None and number_read(found) == found.number == BANKS


@pytest.mark.slow
def test_a_writer_killed_at_any_instant_leaves_one_whole_commit_no_older_than_what_was_read() -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    torn_banks = 0
    for _ in range(KILLS):
        with committing_child() as (pid, descriptor):
            reader = SegmentReader(descriptor)
            seen, until = 0, time.monotonic() + dice.random() * 0.01
            while time.monotonic() < until:
                found = reader.read(0)
                assert found is not None and number_read(found) >= seen
                seen = found.number
            os.kill(pid, signal.SIGKILL)
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
            found = reader.read(0)
            assert found is not None and number_read(found) >= seen
            records = [reader._word(segment_layout.RECORDS_OFFSET + bank * segment_layout.RECORD_SIZE) for bank in range(3)]
            torn_banks += found.number > 3 and 0 in records
            reader.close()
    assert torn_banks > KILLS // 20, "kills must hit commits, or this test shows nothing"


def test_a_segment_grows_without_forgetting_what_was_committed() -> None:
    array = bytearray(b"a" * 2 * PAGE)
    with opened(layout(PAGE, 2 * PAGE)) as (writer, old_reader):
        writer.commit([source(b"1"), source(array)])
        larger = writer.grown(layout(3 * PAGE, 2 * PAGE))
        reader = SegmentReader(larger.descriptor)
        writer.supersede()
        assert old_reader.is_superseded and not reader.is_superseded
        found = reader.read()
        assert found is not None and found.number == 1 and found.region(1) == array
        assert larger.commit([source(b"2" * 2 * PAGE), source(array)])
        assert pages_read(reader, 1) == [0, 1]
        found = reader.read()
        assert found is not None and found.region(1) == array and found.region(0) == b"2" * 2 * PAGE + bytes(PAGE)
        reader.close()
        larger.close()


# --- Hostile segments ---------------------------------------------------------------------------------------------------


def file_holding(content: bytes, folder: Path) -> int:
    path = folder / "segment"
    path.write_bytes(content)
    return os.open(path, os.O_RDONLY)


def whole_segment() -> bytes:
    with opened(layout(PAGE, 2 * PAGE)) as (writer, _):
        writer.commit([source(b"state"), source(b"a" * 2 * PAGE)])
        return os.pread(writer.descriptor, writer.layout.file_size, 0)


def read_from(content: bytes, folder: Path) -> int:
    descriptor = file_holding(content, folder)
    try:
        reader = SegmentReader(descriptor)
        try:
            found = reader.read()
            return -1 if found is None else found.number
        finally:
            reader.close()
    finally:
        os.close(descriptor)


def test_a_segment_may_be_a_file(tmp_path: Path) -> None:
    assert read_from(whole_segment(), tmp_path) == 1


@pytest.mark.parametrize(
    ("region", "why"),
    [
        (Region("x", 9, PAGE, 1), "kind 9"),
        (Region("", STATE, PAGE, 1), "name"),
        (Region("x" * 225, STATE, PAGE, 1), "name"),
        (Region("x", STATE, 1, 1), "address"),
        (Region("x", STATE, PAGE, 0), "0 bytes"),
        (Region("x", STATE, PAGE, 1 << 60), "bytes"),
        (Region("x", STATE, 1 << 63, 1), "address"),
    ],
)
def test_a_region_that_cannot_be_is_refused_by_name(region: Region, why: str) -> None:
    with pytest.raises(SegmentError, match=why):
        Layout((region,), LINEAGE).check()


def test_regions_that_overlap_or_share_a_name_are_refused() -> None:
    with pytest.raises(SegmentError, match="begins before"):
        Layout((Region("a", ARRAY, PAGE, PAGE + 1), Region("b", ARRAY, 2 * PAGE, 1)), LINEAGE).check()
    with pytest.raises(SegmentError, match="same name"):
        Layout((Region("a", ARRAY, PAGE, 1), Region("a", ARRAY, 2 * PAGE, 1)), LINEAGE).check()


def test_a_pipe_is_no_segment() -> None:
    ends = os.pipe()
    with pytest.raises(SegmentError, match="not a file"):
        SegmentReader(ends[0])
    for end in ends:
        os.close(end)


def test_a_segment_cut_off_anywhere_is_refused(tmp_path: Path) -> None:
    whole = whole_segment()
    for size in (0, 7, 55, 300, PAGE, PAGE + 128, 2 * PAGE, 5 * PAGE, len(whole) - 1):
        with pytest.raises(SegmentError):
            read_from(whole[:size], tmp_path)


def test_a_segment_that_shrinks_while_it_is_read_is_refused_and_kills_nobody(tmp_path: Path) -> None:
    descriptor = file_holding(whole_segment(), tmp_path)
    reader = SegmentReader(descriptor)
    os.truncate(tmp_path / "segment", 2 * PAGE)
    with pytest.raises(SegmentError, match="ends at byte"):
        reader.read()
    reader.close()
    os.close(descriptor)


def test_any_altered_byte_of_the_description_is_refused_or_means_the_same(tmp_path: Path) -> None:
    whole = bytearray(whole_segment())
    last = PAGE + 3 * segment_layout.ENTRY.size
    places = [*range(segment_layout.HEAD.size), *range(segment_layout.NEWEST_OFFSET, segment_layout.NEWEST_OFFSET + 8)]
    places += [*range(segment_layout.RECORDS_OFFSET, segment_layout.RECORDS_OFFSET + 8), *range(PAGE, last)]
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    for place in places:
        altered = bytearray(whole)
        altered[place] ^= 1 << dice.randrange(8)
        try:
            assert read_from(bytes(altered), tmp_path) >= -1
        except SegmentError:
            continue


def test_random_bytes_are_refused(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    for _ in range(200):
        garbage = dice.randbytes(dice.randrange(3 * PAGE))
        with pytest.raises(SegmentError):
            read_from(garbage, tmp_path)
        with pytest.raises(SegmentError):
            read_from(segment_layout.MAGIC + garbage, tmp_path)


def test_a_page_of_a_later_commit_than_its_bank_is_refused(tmp_path: Path) -> None:
    whole = bytearray(whole_segment())
    whole[layout(PAGE, 2 * PAGE).versions_offset(0)] = 7
    with pytest.raises(SegmentError, match="commit 7"):
        read_from(bytes(whole), tmp_path)


def test_a_program_that_writes_a_bank_in_spite_of_the_reader_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(layout()) as (writer, reader):
        writer.commit(Telling().sources(1))
        honest = SegmentReader._contents

        def overtaken(self: SegmentReader, bank: int, numbers: np.ndarray) -> memoryview:
            writer._words[(segment_layout.RECORDS_OFFSET + bank * segment_layout.RECORD_SIZE) // 8] = 9
            return honest(self, bank, numbers)

        monkeypatch.setattr(SegmentReader, "_contents", overtaken)
        with pytest.raises(SegmentError, match="does not keep the rules"):
            reader.read()
