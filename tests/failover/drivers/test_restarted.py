"""A driver without kept state ends or is killed while messages wait in its mailbox: none is lost, none comes twice in silence."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here, lives
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import MailboxFullError, NameUnknownError, NoAnswerError
from tests.failover.drivers.serving import LIMIT_S, Lab, until

ROOT = Path(__file__).parents[3]
PROGRAM = Path(__file__).parent / "noting.py"
PATH = "Lab/robot1/Noting"
DEATHS = 8
BETWEEN = 150
"""Messages that are carried out between two deaths."""


class Device:
    """The driver's process on one robot, and what it has noted."""

    def __init__(self, here: Here, folder: Path, **environment: str) -> None:
        self.here, self.file = here, folder / "noted"
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), **environment}

    @contextlib.contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        with subprocess.Popen([sys.executable, PROGRAM, self.file], env=self.environment, stderr=subprocess.DEVNULL) as one:
            try:
                until(lambda: self.here.file(PATH, "calls").exists() and lives(self.here, PATH))
                yield one
            finally:
                one.kill()

    def noted(self) -> list[int]:
        """What it has carried out, in order."""
        return [int(line) for line in self.file.read_text().split()]


@pytest.fixture(params=["one robot", "two robots"])
def device(request: pytest.FixtureRequest, folder: Path, here: Here) -> Iterator[tuple[Device, Here]]:
    """The driver, and the robot of those who call it."""
    if request.param == "one robot":
        yield Device(here, folder), here
    else:
        lab = Lab(folder, "robot1", "robot2")
        one = lab.here("robot1")
        yield (
            Device(one, folder, **{TEAM: str(lab.write("robot1")), DIRECTORY: str(one.directory), ROBOT: "robot1"}),
            lab.here("robot2"),
        )


def reached(here: Here) -> Proxy:
    found: list[Proxy] = []

    def is_found() -> bool:
        with contextlib.suppress(NameUnknownError):
            found.append(Proxy(here, lookup(here, "noting")))
        return bool(found)

    until(is_found)
    return found[0]


def end_again_and_again(
    device: Device, caller: Here, end: Callable[[subprocess.Popen[bytes]], None]
) -> tuple[list[int], list[Future[int]]]:
    """Post while the driver ends again and again, with messages in its mailbox; what it has carried out, and the posts."""
    with device.running():
        proxy = reached(caller)
    done: list[Future[int]] = []
    with proxy:
        for life in range(1, DEATHS + 2):
            with device.running() as driver:
                while len(done) < min(life + 1, DEATHS + 1) * BETWEEN:
                    with contextlib.suppress(MailboxFullError):
                        done.append(proxy.post("note", number=len(done)))
                wanted = life * BETWEEN - BETWEEN // 2 if life <= DEATHS else len(done)
                until(lambda wanted=wanted: done[wanted - 1].done())  # type: ignore[misc]
                end(driver)
        proxy.flush(LIMIT_S)
    return device.noted(), done


def test_a_driver_that_is_ended_in_order_carries_each_message_out_once(device: tuple[Device, Here]) -> None:
    def end(driver: subprocess.Popen[bytes]) -> None:
        driver.send_signal(signal.SIGTERM)
        assert driver.wait(LIMIT_S) == 0

    noted, done = end_again_and_again(*device, end)
    assert [one.result() for one in done] == noted == list(range((DEATHS + 1) * BETWEEN))


def test_a_driver_that_is_killed_begins_no_message_twice_and_its_sender_is_told_which_one_is_in_doubt(
    device: tuple[Device, Here],
) -> None:
    noted, done = end_again_and_again(*device, subprocess.Popen.kill)
    doubtful = {number for number, one in enumerate(done) if isinstance(one.exception(), NoAnswerError)}
    print("in doubt:", doubtful)
    assert noted == sorted(set(noted)), "in order, none twice"
    assert {*range(len(done))} - {*noted} <= doubtful and len(doubtful) <= DEATHS
    for number, one in enumerate(done):
        if number in doubtful:
            assert "ended while it carried out note; it may have been carried out" in str(one.exception())
        else:
            assert one.result() == number, "each answer is that of its message"
