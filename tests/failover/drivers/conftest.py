"""A place where the drivers of one test meet."""

from __future__ import annotations

from pathlib import Path

import pytest

from failover.drivers.here import Here
from tests.failover.drivers.serving import robot_alone


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short name: the address of a unix socket has 107 bytes."""
    return tmp_path_factory.mktemp("d")


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """See `robot_alone`."""
    return robot_alone(folder, monkeypatch)
