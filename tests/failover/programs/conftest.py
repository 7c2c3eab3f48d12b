"""A robot with a store of programs and a team directory, and programs to send."""

from __future__ import annotations

import getpass
from pathlib import Path

import pytest

from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here
from failover.programs.store import PLACE
from tests.failover.programs.senders import Lab


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short name: the address of a unix socket has 107 bytes."""
    return tmp_path_factory.mktemp("p")


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """A robot without a team; also for programs and commands that the test starts."""
    for name in (TEAM, ROBOT):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(DIRECTORY, str(folder / "m"))
    monkeypatch.setenv(ROBOT, "robot1")
    monkeypatch.setenv(PLACE, str(folder / "s"))
    (folder / "m").mkdir(mode=0o700)
    return Here("robot1", folder / "m", alone="this test has no team")


@pytest.fixture
def lab(folder: Path, here: Here) -> Lab:
    """A robot, a person who may send programs to it, and that person's key."""
    pytest.importorskip("cryptography")
    return Lab(folder, here, getpass.getuser())
