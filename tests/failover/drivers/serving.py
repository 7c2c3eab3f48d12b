"""Drivers in threads of the test's process, and teams of robots on this machine's loopback addresses."""

from __future__ import annotations

import contextlib
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from agent.worker.network.replication_link import new_keys
from failover.config.team import Robot, Team, write, write_secret_key
from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.drivers.server import Serving

S = TypeVar("S", bound=Serving)

LIMIT_S = 60
"""Until a test gives up waiting for a condition."""


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


@contextlib.contextmanager
def taking_messages(one: S) -> Iterator[S]:
    """Open sockets, behind which a thread takes messages until the body ends."""
    with one:
        thread = threading.Thread(target=one.serve)
        thread.start()
        try:
            yield one
        finally:
            one.stop()
            thread.join()


def serving(cls: type, here: Here) -> contextlib.AbstractContextManager[Serving]:
    """A driver that takes messages until the body ends."""
    return taking_messages(Serving(cls, here))


def robot_alone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """A robot without a team; also for programs and commands that the test starts."""
    for name in (TEAM, ROBOT):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(DIRECTORY, str(folder / "m"))
    monkeypatch.setenv(ROBOT, "robot1")
    (folder / "m").mkdir(mode=0o700)
    return Here("robot1", folder / "m", alone="this test has no team")


def called(here: Here, name: str) -> Proxy:
    """A proxy for a name."""
    return Proxy(here, lookup(here, name))


class Lab:
    """A team of robots with keys, each at a loopback address of its own; each has a directory of its own."""

    def __init__(self, folder: Path, *robots: str) -> None:
        self.folder = folder
        network = f"127.{random.randrange(1, 255)}.{random.randrange(255)}"
        pairs = {robot: new_keys() for robot in robots}
        self.secrets = {robot: secret for robot, (_, secret) in pairs.items()}
        self.team = Team(
            "lab",
            {
                robot: Robot((f"{network}.{number}:7420",), f"{network}.{number}:7421", public_key=pairs[robot][0])
                for number, robot in enumerate(robots, 1)
            },
        )

    def here(self, robot: str, secret: str = "") -> Here:
        """That robot, as its programs see it."""
        directory = self.folder / robot
        directory.mkdir(mode=0o700, exist_ok=True)
        return Here(robot, directory, self.team, secret or self.secrets[robot], rules=self.place(robot))

    def place(self, robot: str) -> Path:
        """Where the team's files lie on that robot, if they were written."""
        return self.folder / f"{robot}-team"

    def write(self, robot: str) -> Path:
        """The team's files, as they lie on that robot."""
        place = self.place(robot)
        write(place, self.team)
        write_secret_key(place, robot, self.secrets[robot])
        return place
