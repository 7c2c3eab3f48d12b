"""Writes the sample files of the format's versions: ``python -m tests.samples.make`` (only when a version changes)."""

from __future__ import annotations

from pathlib import Path

from msgspec.structs import replace

from checkpoint.model import Snapshot
from checkpoint.snapshot import format, layout
from checkpoint.store.xor_cache import Sender
from tests.checkpoint.snapshots import family, history, page, runs_of, snapshot

SAMPLE = Path(__file__).parent / f"version-{layout.VERSION}.snapshot"
TREE_SAMPLE = Path(__file__).parent / f"version-{layout.TREE_VERSION}.snapshot"
DIFFERENCES_SAMPLE = Path(__file__).parent / f"version-{layout.VERSION + layout.DIFFERENCES}.snapshot"
TREE_DIFFERENCES_SAMPLE = Path(__file__).parent / f"version-{layout.TREE_VERSION + layout.DIFFERENCES}.snapshot"


def sample() -> Snapshot:
    """A delta with a carried page, a cleared page and output."""
    return history(2)[1]


def tree_sample() -> Snapshot:
    """A delta of two processes, and of one that has ended, with pages of each that lives."""
    return family(2)[1]


def differences_sample() -> Snapshot:
    """A delta with a page told as a difference and one told whole."""
    base = snapshot({0: page("before"), 1: page("both")})
    delta = snapshot({0: page("after!"), 1: page("both"), 2: page("new")}, parent=base.position, sequence=2)
    return _told(base, replace(delta, runs=runs_of({0, 2}), contents=page("after!") + page("new")))


def tree_differences_sample() -> Snapshot:
    """The same of two processes."""
    base, delta = family(2)
    return _told(base, delta)


def _told(base: Snapshot, delta: Snapshot) -> Snapshot:
    sender = Sender()
    sender.told(base, 1 << 20)
    sender.acknowledge(base.position)
    return sender.told(delta, 1 << 20)[0]


SAMPLES = {
    SAMPLE: sample,
    TREE_SAMPLE: tree_sample,
    DIFFERENCES_SAMPLE: differences_sample,
    TREE_DIFFERENCES_SAMPLE: tree_differences_sample,
}

if __name__ == "__main__":
    for path, made in ((path, make()) for path, make in SAMPLES.items()):
        with path.open("wb") as file:
            format.encode(made, file)
