"""The pictures of the benchmarks: drawn from a record, the same from the same figures, and nothing from nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import increments, plots, results, soak
from benchmarks.figures import Figure, Findings

STILL = "the program stands still (its own clock)"
FIGURES = (
    Figure(STILL, "10 MB", "ms", (1.0, 2.0, 3.0)),
    Figure(STILL, "100 MB", "ms", (2.0, 2.5)),
    Figure(STILL, "10 MB", "ms", (15.0,), "CRIU"),
    Figure(increments.STILL, "10 MB, 400 KB written since the last", "ms", (1.0, 2.0)),
    Figure(increments.STILL, "10 MB, 400 KB written since the last", "ms", (5.0, 6.0), increments.FULL),
    Figure(increments.SENT_OF_ONE, "0.4 MB written since the last", "KB", (40.0, 50.0)),
    Figure(increments.SENT_OF_ONE, "0.4 MB written since the last", "KB", (9000.0,), increments.FULL),
    Figure("freeze of a delta", "100 MB, 400 KB written each 50 ms", "ms", (0.7, 0.8, 0.9)),
    Figure("restore", "10 MB", "ms", (60.0, 66.0)),
    Figure("takeover from a ready copy", "10 MB", "ms", (6.0, 7.0)),
    Figure("power cut to next output", "1 at once", "ms", (210.0, 230.0)),
    Figure(soak.WHEN, "each sample", "min", (0.0, 1.0, 2.0)),
    Figure(soak.MEMORY, "robot1: worker", "MB", (90.0, 95.0, 94.0)),
    Figure(soak.DESCRIPTORS, "robot1: worker", "", (130.0, 132.0, 131.0)),
    Figure("one more thread", "of 64", "µs", (90.0, 100.0)),
    Figure("work done a second", "10 snapshots a second", "steps", (97.0,)),
    Figure("work done a second", "10 snapshots a second", "steps", (100.0,), "unprotected"),
)


def record(place: Path, *figures: Figure) -> Path:
    results.write(place, "python -m benchmarks", {}, "", (Findings("All", "Of everything.", figures),))
    return place / results.RECORD


def drawn(place: Path, *figures: Figure) -> dict[str, str]:
    read = plots.figures_of(record(place, *figures))
    assert read == list(figures)
    return {path.stem: path.read_text() for path in plots.draw(read, place / "plots")}


def test_each_picture_tells_what_it_was_drawn_of(tmp_path: Path) -> None:
    pictures = drawn(tmp_path, *FIGURES)
    assert pictures.keys() == plots.PICTURES.keys()
    for name, (title, _) in plots.PICTURES.items():
        assert title in pictures[name]
    for word in ("failover", "CRIU", "resident memory, MB"):
        assert word in pictures["stands-still"]
    assert "failover, from a ready copy" in pictures["resumes"]
    assert "1 at once" in pictures["outages"]


def test_the_same_figures_are_the_same_pictures(tmp_path: Path) -> None:
    assert drawn(tmp_path / "one", *FIGURES) == drawn(tmp_path / "other", *FIGURES)


def test_another_figure_is_another_picture_and_leaves_the_rest_as_they_are(tmp_path: Path) -> None:
    once, changed = drawn(tmp_path / "once", *FIGURES), drawn(tmp_path / "changed", *FIGURES[:-2], *FIGURES[-1:], FIGURES[-2])
    assert once == changed, "the order of others does not matter"
    slower = Figure(STILL, "100 MB", "ms", (4.0, 5.0))
    changed = drawn(tmp_path / "slower", FIGURES[0], slower, *FIGURES[2:])
    assert {name for name, picture in once.items() if changed[name] != picture} == {"stands-still"}


def test_what_was_not_measured_is_not_drawn(tmp_path: Path) -> None:
    assert drawn(tmp_path, FIGURES[7]).keys() == {"freezes"}
    assert drawn(tmp_path / "unprotected-alone", FIGURES[-1]).keys() == set()


@pytest.mark.parametrize("content", ["", "[]", '{"findings": [{"figures": [{"benchmark": "x"}]}]}', "{"])
def test_a_record_that_is_none_is_told(tmp_path: Path, content: str) -> None:
    broken = tmp_path / "results.json"
    broken.write_text(content)
    command = [sys.executable, "-m", "benchmarks.plots", "--record", broken, "--output", tmp_path / "plots"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"cannot draw {broken}: " in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "plots").exists()
