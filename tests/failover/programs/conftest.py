"""A robot with a store of programs and a team directory, and programs to send."""

from __future__ import annotations

import getpass
from pathlib import Path

import pytest

from failover.drivers.here import Here
from failover.programs.store import PLACE
from tests.failover.drivers.serving import robot_alone
from tests.failover.programs.senders import Lab


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short name: the address of a unix socket has 107 bytes."""
    return tmp_path_factory.mktemp("p")


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """See `robot_alone`; with a store."""
    monkeypatch.setenv(PLACE, str(folder / "s"))
    return robot_alone(folder, monkeypatch)


@pytest.fixture
def lab(folder: Path, here: Here) -> Lab:
    """A robot, a person who may send programs to it, and that person's key."""
    pytest.importorskip("cryptography")
    return Lab(folder, here, getpass.getuser())
