"""A place where the drivers of one test meet."""

from __future__ import annotations

from pathlib import Path

import pytest

from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short name: the address of a unix socket has 107 bytes."""
    return tmp_path_factory.mktemp("d")


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """A robot without a team; also for programs and commands that the test starts."""
    for name in (TEAM, ROBOT):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(DIRECTORY, str(folder / "m"))
    monkeypatch.setenv(ROBOT, "robot1")
    (folder / "m").mkdir(mode=0o700)
    return Here("robot1", folder / "m", alone="this test has no team")
