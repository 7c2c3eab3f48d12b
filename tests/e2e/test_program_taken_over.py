"""A host of a program is lost with its robot: the standby's host goes on with the version that was active, and with its state.

The standby never had the program's bundle: it comes with the state, and is checked there.
"""

from __future__ import annotations

import getpass
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine, Stage
from failover.core.naming.tree import Place
from failover.drivers.here import DIRECTORY, ROBOT, TEAM, Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import NameUnknownError, NoAnswerError
from failover.programs.store import PLACE, Store
from tests.e2e import robots
from tests.failover.programs.senders import Lab, engine, switched

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or not robots.means().own_pids,
    reason="needs root: each robot has a store of its own in its mount namespace",
)

ROOT = Path(__file__).parents[2]
SENDERS = 4
EACH_S = 0.05
"""Between two messages of all senders together."""

MORE = 40
"""Messages that are answered before the robot is lost, and again after it."""

WITHIN_S = 90.0

RESUMED = """numbers: list[int] = failover.kept(default=[])
    told = ""
    def on_resume(self, resumed):
        self.told = f"{resumed.why} from {resumed.robot}"
"""


class OwnFolders(Stage):
    """Robots that see at the same path a folder of their own: ``store`` for programs, and ``drivers``, where their drivers meet.

    The test sees there the one of the robot to which `reach` has pointed last.
    """

    def command(self, name: str, config: Path) -> list[str]:
        """See `Stage.command`."""
        (self.of(name) / "store").mkdir(parents=True)
        (self.of(name) / "drivers").mkdir(mode=0o700)
        if not self.at.exists():
            self.reach(name)
        lay = 'mount --make-rprivate / && mount --bind "$0" "$1" && shift 1 && exec "$@"'
        return ["unshare", "--mount", "sh", "-c", lay, str(self.of(name)), str(self.at), *super().command(name, config)]

    @property
    def at(self) -> Path:
        """The path."""
        return self.directory / "at"

    def of(self, robot: str) -> Path:
        """A robot's own folder, as the test sees it."""
        return self.directory / f"of-{robot}"

    def reach(self, robot: str) -> None:
        """From now on the test calls this robot's drivers."""
        aside = self.directory / "aside"
        aside.symlink_to(self.of(robot))
        aside.replace(self.at)


@contextmanager
def two_robots(directory: Path) -> Iterator[tuple[OwnFolders, RobotMachine, RobotMachine]]:
    """The stage, robot1 and robot2."""
    with OwnFolders(directory, robots.means()) as stage:
        stage.directory.mkdir()
        stage.start()
        first, second = stage.robots
        try:
            robots.until(lambda: robots.connected(first) and robots.connected(second), "the robots to hear each other")
            yield stage, first, second
            for robot in stage.robots:
                assert not robots.mistake(robot), robots.mistake(robot)
        finally:
            for robot in stage.robots:
                if robots.answers(robot):  # what the host said
                    print(robots.failover(robot, "logs", "engine"))
                print(
                    f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n"
                )


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short name: the address of a unix socket has 107 bytes."""
    return tmp_path_factory.mktemp("p")


def reached(here: Here) -> Proxy:
    def found() -> Place | None:
        try:
            return lookup(here, "engine")
        except NameUnknownError:
            return None

    return Proxy(here, robots.until(found, "the program to be registered"))


class Sender(threading.Thread):
    """Sends its numbers, one after the other; its proxy sends again what has no answer yet."""

    def __init__(self, here: Here, first: int) -> None:
        super().__init__(daemon=True)
        self.sent: list[int] = []
        self.answers: list[int] = []
        self.trouble: list[BaseException] = []
        self.is_over = False
        self._here, self._first = here, first

    def run(self) -> None:
        """Until told to stop."""
        due = time.monotonic() + self._first * EACH_S
        try:
            with reached(self._here) as proxy:
                while not self.is_over:
                    time.sleep(max(due - time.monotonic(), 0))
                    due = max(due + SENDERS * EACH_S, time.monotonic())
                    self.sent.append(self._first + SENDERS * len(self.sent))
                    self.answers.append(proxy.call("step", number=self.sent[-1], timeout=WITHIN_S))
        except (NoAnswerError, AssertionError) as error:
            self.trouble.append(error)


def test_the_standbys_host_goes_on_with_the_active_version_and_its_state_and_doubles_no_message(folder: Path) -> None:
    pytest.importorskip("cryptography")
    here = Here("field", folder / "e/at/drivers")
    lab = Lab(folder, here, getpass.getuser())
    with two_robots(folder / "e") as (stage, first, second):
        lab.store = Store(stage.of("robot1") / "store").open()
        for version in ("1", "2"):
            lab.send(version, engine(kept=RESUMED, extra="return self.told"))
        environment = {DIRECTORY: str(here.directory), ROBOT: here.robot, TEAM: "", "PYTHONPATH": str(ROOT)}
        environment[PLACE] = str(stage.at / "store")
        words = ["-m", "failover", "program", "run", "engine", "1", "--directory", str(lab.team)]
        robots.run(first, "engine", sys.executable, *words, engine="cooperative", env=environment)
        with reached(here) as proxy:
            assert switched(proxy, "2")["active"] == "2"
        senders = [Sender(here, number) for number in range(SENDERS)]
        for sender in senders:
            sender.start()

        def answered(least: int) -> bool:
            assert not [one.trouble for one in senders if one.trouble]
            return sum(len(one.answers) for one in senders) >= least

        try:
            robots.until_protected(first, "engine")
            robots.until(lambda: answered(MORE), "answers")
            assert list((stage.of("robot2") / "store").glob("bundles/*")) == [], "no person has sent it there"
            before = sum(len(one.answers) for one in senders)
            first.cut_power()
            stage.reach("robot2")
            robots.until_taken_over(second, "engine")
            robots.until(lambda: answered(before + MORE), "answers of the standby")
        finally:
            for sender in senders:
                sender.is_over = True
            for sender in senders:
                sender.join(WITHIN_S)
        with reached(here) as proxy:
            numbers = proxy.call("read", timeout=WITHIN_S)
            standing = proxy.call("_versions", timeout=WITHIN_S)
            assert (standing["active"], standing["on_trial"]) == ("2", False)
            assert proxy.call("fly", timeout=WITHIN_S) == "taken over from robot1"
        for number, sender in enumerate(senders):
            assert not sender.trouble and sender.answers == sender.sent
            assert [one for one in numbers if one % SENDERS == number] == sender.sent, "each was carried out once, in order"
        shelf = Store(stage.of("robot2") / "store").shelf("engine")
        assert [(one.version, str(one.state)) for one in shelf.versions] == [("1", "retired"), ("2", "active")]
        assert shelf.floor == "2"
