"""The file beside a C program: the power is cut after any call to the disk, or calls to the disk fail."""

from __future__ import annotations

import os
import random
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from checkpoint.errors import SegmentError
from tests.include.programs import committed_in, environment, number_told, output, telling_with_log

pytestmark = pytest.mark.compiler

CUTS = int(os.environ.get("FAILOVER_POWER_CUTS", "250"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
SECTOR = 512
"""What a disk writes whole or not at all."""
CALL = struct.Struct("<ciQQ")


@dataclass(frozen=True, slots=True)
class Call:
    """One call to the disk, or "!", the moment at which commit number ``offset`` was called safe."""

    kind: str
    file: int
    offset: int
    content: bytes


def calls_in(log: bytes) -> Iterator[Call]:
    place = 0
    while place < len(log):
        kind, file, offset, size = CALL.unpack_from(log, place)
        place += CALL.size
        yield Call(kind.decode(), file, offset, log[place : place + size])
        place += size


@dataclass(slots=True)
class Drive:
    """A disk with one folder: what is safe, and what is under way."""

    size: dict[int, int] = field(default_factory=dict)
    safe: dict[int, bytearray] = field(default_factory=dict)
    pending: dict[int, list[Call]] = field(default_factory=dict)
    in_place: int | None = None
    renamed: int | None = None
    newest: int | None = None
    promised: int = 0

    def take(self, call: Call) -> None:
        """Go on by one call."""
        match call.kind:
            case "!":
                self.promised = call.offset
            case "t":
                self.size[call.file] = call.offset
                self.safe[call.file], self.pending[call.file] = bytearray(call.offset), []
                self.newest = call.file
            case "w":
                self.pending[call.file].append(call)
            case "s" if call.file in self.safe:
                for write in self.pending[call.file]:
                    self.safe[call.file][write.offset : write.offset + len(write.content)] = write.content
                self.pending[call.file] = []
            case "s":
                self.in_place = self.renamed
            case "r":
                self.renamed = self.newest

    def after_a_cut(self, dice: random.Random) -> bytes:
        """What the file holds when the power comes back: of each write that was under way some sectors, often all or none."""
        file = self.renamed if dice.random() < 0.5 else self.in_place
        if file is None:
            return b""
        found = bytearray(self.safe[file])
        part = dice.choice([0.0, 1.0, dice.random()])
        for write in self.pending[file]:
            place = write.offset
            while place < write.offset + len(write.content):
                end = min((place // SECTOR + 1) * SECTOR, write.offset + len(write.content))
                if dice.random() < part:
                    found[place:end] = write.content[place - write.offset : end - write.offset]
                place = end
        return bytes(found)


def logged(state: Path, *words: str) -> list[Call]:
    """The calls of a run."""
    log = state.parent / "calls"
    with log.open("ab") as file:
        done = subprocess.run(
            [telling_with_log(), *words],
            env=environment(state, DISK_LOG=str(file.fileno())),
            pass_fds=[file.fileno()],
            capture_output=True,
            check=True,
        )
    assert b"safe" in done.stdout
    calls = list(calls_in(log.read_bytes()))
    log.unlink()
    return calls


def test_after_a_power_cut_at_any_call_a_whole_commit_is_there_no_older_than_the_last_waited_one(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    state, after = tmp_path / "state", tmp_path / "after"
    state.mkdir()
    after.mkdir()
    calls = logged(state, "30", "wait")
    assert sum(call.kind == "!" for call in calls) == 30
    for turn in range(CUTS):
        drive, cut = Drive(), turn % len(calls) if turn < len(calls) // 2 else dice.randrange(len(calls) + 1)
        for call in calls[:cut]:
            drive.take(call)
        path = after / "telling.segment"
        path.write_bytes(drive.after_a_cut(dice))
        found = committed_in(path) if path.stat().st_size else None
        number = number_told(found) if found else 0
        assert number >= drive.promised, f"cut {cut} of {len(calls)}, seed {SEED}"
        if turn % 5 == 0:
            told = output(telling_with_log(), after, "1", "wait").splitlines()
            assert f"began {number}" in told and told[-1] == f"safe {number + 1}", (told, cut, SEED)


def test_a_cut_would_be_seen_if_the_word_were_written_before_the_bank_was_safe(tmp_path: Path) -> None:
    """The test above can fail: without the calls that wait for the disk some cut leaves less than was promised."""
    dice = random.Random(1)
    state, after = tmp_path / "state", tmp_path / "after"
    state.mkdir()
    after.mkdir()
    calls = [call for number, call in enumerate(logged(state, "30", "wait")) if call.kind != "s" or number < 100]
    wrong = 0
    for _ in range(60):
        drive = Drive()
        for call in calls[: dice.randrange(200, len(calls))]:
            drive.take(call)
        path = after / "telling.segment"
        path.write_bytes(drive.after_a_cut(dice))
        try:
            found = committed_in(path) if path.stat().st_size else None
            wrong += (number_told(found) if found else 0) < drive.promised
        except (AssertionError, SegmentError):
            wrong += 1
    assert wrong


@pytest.mark.parametrize("which", [1, 2, 3, 5, 8, 9, 10, 11, 12, 14, 20])
def test_a_call_that_fails_is_told_and_made_up_for(which: int, tmp_path: Path) -> None:
    told = output(telling_with_log(), tmp_path, "6", "wait", DISK_FAIL=str(which)).splitlines()
    assert told == ["began 0", *(f"safe {number}" for number in range(1, 7))]
    found = committed_in(tmp_path / "telling.segment")
    assert found is not None and number_told(found) == 6
    assert not (tmp_path / "telling.segment.new").exists()


def test_an_error_while_the_state_is_read_leaves_no_region_partly_filled(tmp_path: Path) -> None:
    output(telling_with_log(), tmp_path, "6", "wait")
    refusals = 0
    for which in range(1, 250):  # three reads a page, and some
        told = output(telling_with_log(), tmp_path, READ_FAIL=str(which)).splitlines()
        if told[-1].startswith("cannot resume"):
            assert len(told) == 1, "its regions are as they were"
            refusals += 1
        else:
            assert told[-1] in ("began 6", "began 5"), told
    assert refusals > 3, "the calls that fail are those that read the state"


def test_a_folder_that_does_not_take_anything_costs_age_and_is_told(tmp_path: Path) -> None:
    (tmp_path / "telling.segment.new").mkdir()
    done = output(telling_with_log(), tmp_path, "3")
    assert done == "began 0\n"
    (tmp_path / "telling.segment.new").rmdir()
    assert output(telling_with_log(), tmp_path, "1", "wait").splitlines() == ["began 0", "safe 1"]


def summed(start: int, content: bytes) -> int:
    """S of SEGMENT.md, "A file beside a program"."""
    for (word,) in struct.iter_unpack("<Q", content):
        start ^= word
        start = ((start << 27 | start >> 37) & 0xFFFFFFFFFFFFFFFF) * 0x9FB21C651E98DF25 % 2**64
    return start


def test_the_sum_of_a_bank_is_that_of_the_document(tmp_path: Path) -> None:
    output(telling_with_log(), tmp_path, "9", "wait")
    content = (tmp_path / "telling.segment").read_bytes()
    regions, banks = struct.unpack_from("<II", content, 16)
    (pages,) = struct.unpack_from("<Q", content, 24)
    bank = content[256]
    record = content[512 + 64 * bank :][:64]
    table = content[4096 : 4096 + 256 * regions]
    versions = -(-8 * pages // 4096) * 4096
    start = 4096 + -(-256 * regions // 4096) * 4096 + banks * versions + bank * 4096 * pages
    total = summed(0, content[:56] + table + content[384:392] + record[:56])
    for page in range(pages):
        total += summed((page + 1) * 0x9E3779B97F4A7C15 % 2**64, content[start + 4096 * page :][:4096])
    assert struct.unpack_from("<Q", record, 56) == (total % 2**64,)
    assert struct.unpack_from("<Q", content, 384) == (1,)
