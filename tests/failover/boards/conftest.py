"""A place for a board below /dev/shm, one for each test, and programs that use it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where no board is yet; `failover.board()` makes it there. Nothing may be left of it."""
    parent = Path(tempfile.mkdtemp(prefix="failover-test-", dir="/dev/shm"))
    monkeypatch.setenv("FAILOVER_BOARD", str(parent / "board"))
    yield parent / "board"
    left = list(parent.rglob("*"))
    shutil.rmtree(parent)
    assert left == []
