"""The vote record: it survives, and a record that cannot be trusted is refused."""

from __future__ import annotations

import contextlib
import os
import subprocess
from pathlib import Path

import pytest

from agent.errors import BallotError
from agent.main_loop import vote_record
from agent.main_loop.vote_record import FILE_NAME, VoteRecordFile
from failover.core import vote_record as core
from failover.errors import RulesError


def test_what_was_kept_is_there_in_the_next_life_which_counts_one_more(tmp_path: Path) -> None:
    first = VoteRecordFile(tmp_path, "robot1")
    assert first.open().boot == 1
    first.keep(b"epoch 7")
    second = VoteRecordFile(tmp_path, "robot1")
    assert second.open().boot == 2
    assert second.record.core == b"epoch 7"


def test_a_robot_that_the_team_remembers_better_counts_on_from_there(tmp_path: Path) -> None:
    record_file = VoteRecordFile(tmp_path, "robot1")
    record_file.open()
    record_file.outlive(41)
    assert record_file.open().boot == 42 and VoteRecordFile(tmp_path, "robot1").open().boot == 43


@pytest.mark.parametrize("size_left", [0, 1, 20, -1])
def test_a_vote_record_that_was_cut_is_not_trusted(tmp_path: Path, size_left: int) -> None:
    record_file = VoteRecordFile(tmp_path, "robot1")
    record_file.open()
    record_file.keep(b"epoch 7")
    path = tmp_path / FILE_NAME
    os.truncate(path, size_left if size_left >= 0 else path.stat().st_size - 10)
    with pytest.raises(BallotError, match="cannot trust"):
        VoteRecordFile(tmp_path, "robot1").open()


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    VoteRecordFile(tmp_path, "robot1").open()
    path = tmp_path / FILE_NAME
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    with pytest.raises(BallotError, match="cannot trust"):
        VoteRecordFile(tmp_path, "robot1").open()


def test_another_robots_vote_record_is_refused_by_name(tmp_path: Path) -> None:
    VoteRecordFile(tmp_path, "robot1").open()
    with pytest.raises(BallotError, match="belongs to robot1"):
        VoteRecordFile(tmp_path, "robot2").open()


def test_a_half_written_vote_record_beside_the_old_one_changes_nothing(tmp_path: Path) -> None:
    record_file = VoteRecordFile(tmp_path, "robot1")
    record_file.open()
    record_file.keep(b"epoch 7")
    (tmp_path / FILE_NAME).with_suffix(".new").write_bytes(b'{"version":1,"robot":"ro')
    again = VoteRecordFile(tmp_path, "robot1")
    again.open()
    assert again.record.core == b"epoch 7"


def test_a_disk_that_refuses_leaves_the_old_record(tmp_path: Path) -> None:
    record_file = VoteRecordFile(tmp_path / "gone", "robot1")
    with pytest.raises(BallotError, match="gives no vote"):
        record_file.open()


@pytest.mark.root
def test_a_vote_finds_room_on_a_disk_that_became_full(tmp_path: Path) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "disk", str(tmp_path)], check=True)
    try:
        kept = VoteRecordFile(tmp_path, "robot1")
        kept.open()
        with (tmp_path / "film").open("wb", buffering=0) as film, contextlib.suppress(OSError):
            while film.write(bytes(4096)):
                pass
        kept.keep(b"epoch 7")
        with pytest.raises(BallotError, match="No space left"):
            kept.keep(bytes(128 << 10))  # more than was kept free
        assert kept.record.core == b"epoch 7"
        (tmp_path / "film").unlink()
        kept.keep(b"epoch 8")
        assert (tmp_path / "ballot.reserve").stat().st_blocks * 512 >= 64 << 10
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


@pytest.mark.parametrize("body", [b'{"version":1,"robot":"\xff"}', b'{"version":' + b"[" * 12_000])
def test_a_vote_record_with_a_right_digest_that_is_no_record_is_not_trusted(tmp_path: Path, body: bytes) -> None:
    (tmp_path / FILE_NAME).write_bytes(body + b"\n" + vote_record._digest(body).encode() + b"\n")
    with pytest.raises(BallotError, match="cannot trust"):
        VoteRecordFile(tmp_path, "robot1").open()


@pytest.mark.parametrize("body", [b"{", b'{"records":"\xff"}', b'{"x":' + b"[" * 12_000])
def test_rules_that_are_no_vote_record_are_refused(body: bytes) -> None:
    with pytest.raises(RulesError, match="cannot read the vote record"):
        core.decode(body)
