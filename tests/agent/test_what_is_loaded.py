"""An agent that protects nothing yet is small: what only snapshots or people need is not loaded before they come."""

from __future__ import annotations

import subprocess
import sys

import pytest


def loaded_by(*modules: str) -> set[str]:
    """The modules in a fresh interpreter that has imported these."""
    script = (
        f"from agent import lean; lean.begin(); import {', '.join(modules)}, sys; print(*filter(sys.modules.get, sys.modules))"
    )
    return set(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split())


def test_the_heart_loads_neither_asyncio_nor_what_reads_pages() -> None:
    assert not loaded_by("agent.main", "agent.loop") & {
        "asyncio",
        "ssl",
        "numpy",
        "zmq",
        "importlib.metadata",
        "unicodedata",
        "_hashlib",
    }


@pytest.mark.parametrize("lanes", ["agent.lanes", "agent.witness"])
def test_the_lanes_load_no_numpy_before_a_snapshot_comes(lanes: str) -> None:
    assert not loaded_by(lanes) & {"numpy", "importlib.metadata", "_ssl", "_hashlib", "unicodedata"}
