"""The phases of a takeover, as the benchmark reads them from a standby's event log."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import cuts
from benchmarks.cuts import CASES, Cut, told
from benchmarks.running import BenchmarkError
from failover.errors import FailoverError

STORY = [
    {"at": 99.0, "did": "robot1 was silent for 60 ms on every link (wire): it counts as dead"},
    {"at": 100.055, "did": "robot1 was silent for 60 ms on every link (wire): it counts as dead"},
    {"at": 100.055, "did": "robot2 claims epoch 2, to run it from its newest checkpoint: no robot runs it"},
    {
        "at": 100.085,
        "did": "it acts again 85.0 ms after the last word of the robot that ran it: silence 60.5 ms, asking and clearing away "
        "0.5 ms, opening 3 snapshots 0.5 ms, its descriptors, timers and registers 7.0 ms, letting it go 3.0 ms; protecting it "
        "again 15.0 ms",
    },
]


def test_the_phases_add_up_and_what_was_before_the_cut_does_not_count() -> None:
    cut = told(STORY, 100.0, 100.075)
    assert cut.whole == pytest.approx(75)
    assert cut.phases == pytest.approx((55, 4, 16), abs=0.01)
    assert cut.stages == {
        "asking and clearing away": 0.5,
        "opening the snapshots": 0.5,
        "its descriptors, timers and registers": 7.0,
        "letting it go": 3.0,
        "protecting it again": 15.0,
    }


def test_a_story_without_a_takeover_is_no_figure() -> None:
    with pytest.raises(FailoverError, match="no takeover"):
        told(STORY[:3], 100.0, 100.075)


ONE = Cut(75.0, (55.0, 4.0, 16.0), {})


@pytest.mark.parametrize("before", [0, 2])
def test_a_robot_that_was_taken_over_before_its_cut_is_counted_and_another_one_cut(
    before: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def cut(_case: object, directory: Path) -> Cut | None:
        made.append(directory)
        return None if len(made) <= before else ONE

    monkeypatch.setattr(cuts, "_cut", cut)
    assert cuts._cuts(CASES[0], 5, tmp_path) == ([ONE] * 5, before)
    assert len(set(made)) == 5 + before  # each one in a directory of its own


def test_a_machine_on_which_too_many_are_taken_over_early_gives_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuts, "_cut", lambda *_: None)
    with pytest.raises(BenchmarkError, match="this machine is too busy"):
        cuts._cuts(CASES[0], 5, tmp_path)
