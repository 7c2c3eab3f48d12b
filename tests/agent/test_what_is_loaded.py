"""An agent that protects nothing yet is small: what only snapshots or people need is not loaded before they come."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine


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


def test_a_heart_and_its_lanes_do_without_openssl_and_the_tables_of_names(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, _):
        parts = {name: mapped_by(first, name) for name in ("agent.main", "agent.lanes")}
        for mapped in parts.values():
            assert "_blake2" in mapped
            assert not [name for name in ("libcrypto", "libssl", "liblzma", "multiarray") if name in mapped]
        assert "unicodedata" not in parts["agent.main"], "there it is locked"


def mapped_by(robot: RobotMachine, part: str) -> str:
    """The mappings of a part of its agent, by what stands in the command line."""
    command = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().decode() for pid in robot.processes()}
    pid = next(pid for pid, line in command.items() if part in line.split("\0")[1:4])
    return Path(f"/proc/{pid}/maps").read_text()
