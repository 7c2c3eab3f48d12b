"""failover lost: copies that lost are listed, looked at, removed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from checkpoint.store import lost_copies
from failover.cli import main

SNAPSHOT = Path(__file__).parents[3] / "samples" / "version-4.snapshot"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for epoch in (2, 3):
        lost_copies.keep(tmp_path / lost_copies.FOLDER, "/lab/r1/mapper", epoch, SNAPSHOT.read_bytes())
    return tmp_path


def told(capsys: pytest.CaptureFixture[str], place: Path, *words: str) -> str:
    status = main.main(["lost", *words, "--state", str(place)])
    said = capsys.readouterr()
    assert status == 0, said.err
    return said.out


def test_they_are_listed_and_one_that_was_inspected_counts_as_looked_at(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, place, "list").count("not looked at") == 2
    assert "Snapshot" in told(capsys, place, "inspect", "mapper", "--epoch", "3")
    listed = json.loads(told(capsys, place, "list", "--json"))
    assert {one["epoch"]: one["seen"] for one in listed["copies"]} == {2: False, 3: True}


def test_one_is_removed_and_its_name_is_refused_then(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "/lab/r1/mapper, epoch 2: removed" in told(capsys, place, "remove", "/lab/r1/mapper", "--epoch", "2")
    assert main.main(["lost", "remove", "mapper", "--epoch", "2", "--state", str(place)]) == 1
    assert "has no copy of 'mapper' of epoch 2 that lost" in capsys.readouterr().err
    assert [one.epoch for one in lost_copies.found(place / lost_copies.FOLDER)] == [3]


def test_a_name_that_fits_two_components_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lost_copies.keep(place / lost_copies.FOLDER, "/lab/r2/mapper", 1, b"")
    assert main.main(["lost", "inspect", "mapper", "--state", str(place)]) == 1
    assert "could be /lab/r1/mapper, /lab/r2/mapper" in capsys.readouterr().err


def test_where_none_is_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no copy has lost at this robot" in told(capsys, tmp_path, "list")
