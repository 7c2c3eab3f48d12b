"""A driver that keeps its state is lost with its robot: the standby resumes it; each message was carried out once, in order."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

from failover.core.naming.tree import Place
from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import NameUnknownError, NoAnswerError
from tests.e2e import robots

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "tests/failover/drivers/counter.py"
MESSAGES = 200
WITHIN_S = 90.0


@pytest.fixture
def here(tmp_path_factory: pytest.TempPathFactory) -> Here:
    """Where both robots and the test meet: this driver's files are on neither robot alone."""
    directory = tmp_path_factory.mktemp("d") / "m"
    directory.mkdir(mode=0o700)
    return Here("field", directory)


def reached(here: Here) -> Proxy:
    def found() -> Place | None:
        try:
            return lookup(here, "counter")
        except NameUnknownError:
            return None

    return Proxy(here, robots.until(found, "the driver to be registered"))


class Sender:
    """Sends numbers, one after the other; one that had no answer yet is sent again by its proxy."""

    def __init__(self, here: Here) -> None:
        self.answers: list[int] = []
        self.trouble: list[BaseException] = []
        self._here = here
        self.thread = threading.Thread(target=self._send)
        self.thread.start()

    def _send(self) -> None:
        try:
            with reached(self._here) as proxy:
                for number in range(MESSAGES):
                    self.answers.append(proxy.call("add", sender="s", number=number, timeout=WITHIN_S))
        except (NoAnswerError, AssertionError) as error:
            self.trouble.append(error)


def test_each_message_is_carried_out_once_although_the_drivers_robot_is_lost(tmp_path: Path, here: Here) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        environment = {DIRECTORY: str(here.directory), ROBOT: here.robot, TEAM: "", "PYTHONPATH": str(ROOT)}
        robots.run(first, "counter", sys.executable, str(PROGRAM), engine="cooperative", env=environment)
        sender = Sender(here)
        try:
            robots.until(lambda: len(sender.answers) > 10 or sender.trouble, "some answers")
            robots.until_protected(first, "counter")
            before = len(sender.answers)
            first.cut_power()
            robots.until_taken_over(second, "counter")
            robots.until(lambda: len(sender.answers) > before + 10 or sender.trouble, "answers of the standby")
        finally:
            sender.thread.join(WITHIN_S + 30)
        assert not sender.trouble
        with reached(here) as proxy:
            found = proxy.call("read", timeout=WITHIN_S)
    assert found["resumed"] == "taken over"
    assert [number for _, number in found["log"]] == list(range(MESSAGES)), "none is lost, none is there twice, all are in order"
    assert sender.answers == list(range(1, MESSAGES + 1)), "each answer is that of its message"
