"""Write the sample files of the format's versions: ``python -m tests.samples.make`` (only when a version changes)."""

from __future__ import annotations

from pathlib import Path

from checkpoint import format, layout
from checkpoint.model import Snapshot
from tests.checkpoint.snapshots import family, history

SAMPLE = Path(__file__).parent / f"version-{layout.VERSION}.snapshot"
TREE_SAMPLE = Path(__file__).parent / f"version-{layout.TREE_VERSION}.snapshot"


def sample() -> Snapshot:
    """A delta with a carried page, a cleared page and output."""
    return history(2)[1]


def tree_sample() -> Snapshot:
    """A delta of two processes, and of one that has ended, with pages of each that lives."""
    return family(2)[1]


if __name__ == "__main__":
    for path, made in ((SAMPLE, sample()), (TREE_SAMPLE, tree_sample())):
        with path.open("wb") as file:
            format.encode(made, file)
