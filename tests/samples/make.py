"""Write the sample file of the current format version: ``python -m tests.samples.make`` (only when the version changes)."""

from __future__ import annotations

from pathlib import Path

from checkpoint import format, layout
from checkpoint.model import Snapshot
from tests.checkpoint.snapshots import history

SAMPLE = Path(__file__).parent / f"version-{layout.VERSION}.snapshot"


def sample() -> Snapshot:
    """A delta with a carried page, a cleared page and output."""
    return history(2)[1]


if __name__ == "__main__":
    with SAMPLE.open("wb") as file:
        format.encode(sample(), file)
