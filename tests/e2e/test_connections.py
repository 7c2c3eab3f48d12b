"""TCP connections with peers outside the team: a handover takes them along and brings them back; a crash resets them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import ip_inside
from tests.checkpoint.resources.sockets.test_tcp_handover import PYTHON, TALKERS, run
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.means().own_network, reason="needs the right to make network namespaces"),
]

PEER, MOVES = "10.88.0.1", "10.88.0.9"
SETTINGS = f"""
[components."/demo/robot1/talk"]
connections = "carry"
[components."/demo/robot1/talk".hooks]
after_resume = ["ip", "address", "add", "{MOVES}/24", "dev", "out"]
"""


class Outside:
    """A machine that is no member of the team, at one wire with both robots."""

    def __init__(self, directory: Path, members: tuple[RobotMachine, RobotMachine]) -> None:
        self.name = f"failover-{os.getpid()}-outside"
        self._directory = directory
        self._members = members

    @contextmanager
    def wired(self) -> Iterator[None]:
        """The wire, for the body."""
        run("ip", "netns", "add", self.name)
        try:
            run("ip", "-n", self.name, "link", "add", "wire", "type", "bridge")
            run("ip", "-n", self.name, "link", "set", "wire", "up")
            run("ip", "-n", self.name, "address", "add", f"{PEER}/24", "dev", "wire")
            for index, robot in enumerate(self._members, start=2):
                ends = ["type", "veth", "peer", "name", "out", "netns", str(robot.process.pid)]
                run("ip", "-n", self.name, "link", "add", robot.name, *ends)
                run("ip", "-n", self.name, "link", "set", robot.name, "master", "wire", "up")
                run(*ip_inside(robot, "address", "add", f"10.88.0.{index}/24", "dev", "out"))
                run(*ip_inside(robot, "link", "set", "out", "up"))
            run(*ip_inside(self._members[0], "address", "add", f"{MOVES}/24", "dev", "out"))
            yield
        finally:
            subprocess.run(["ip", "netns", "del", self.name], capture_output=True, check=False)

    def start(self) -> subprocess.Popen[bytes]:
        """The program's peer."""
        with (self._directory / "called").open("ab") as output:
            words = [PYTHON, str(TALKERS), "called", PEER, "7000", MOVES]
            command = ["nsenter", f"--net=/run/netns/{self.name}", *words]
            return subprocess.Popen(
                command, cwd=self._directory, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )

    def said(self) -> list[str]:
        return (self._directory / "called").read_text().splitlines()

    def hears_of_move(self, left: RobotMachine) -> None:
        """The address has left a robot, as whoever moves addresses sees to."""
        run(*ip_inside(left, "address", "del", f"{MOVES}/24", "dev", "out"))
        run("ip", "-n", self.name, "neigh", "flush", "all")


def talking(robot: RobotMachine) -> dict[str, Any]:
    return robots.component(robot, "talk")


def said(robot: RobotMachine) -> list[str]:
    """By the program, as that robot has it."""
    return robots.output(robot, "talk").decode().splitlines()


def moved(left: RobotMachine, taken: RobotMachine, order: str, outside: Outside) -> None:
    """Have the program moved, and its address with it."""
    robots.until(lambda: robots.failover(left, order, "talk").returncode == 0, f"a {order}")
    robots.until(lambda: talking(taken).get("state") == "running", "it to run there")
    outside.hears_of_move(left)
    robots.until_protected(taken, "talk")


@contextmanager
def conversation(directory: Path) -> Iterator[tuple[RobotMachine, RobotMachine, Outside, subprocess.Popen[bytes]]]:
    """A component of robot1 and a peer outside, with a connection that is full in both directions."""
    with robots.two_robots(directory, SETTINGS) as (first, second):
        outside = Outside(directory, (first, second))
        with outside.wired():
            called = outside.start()
            try:
                robots.until(lambda: outside.said() == ["listens"], "the peer to listen")
                words = [PYTHON, "-S", str(TALKERS), "caller", PEER, "7000", MOVES]
                robots.run(first, "talk", *words, cwd=str(directory))
                robots.until(lambda: outside.said()[-1:] == ["ready"], "the peer to be full")
                robots.until_protected(first, "talk")
                robots.until(lambda: said(first)[-1:] == ["ready"], "the program to be full")
                yield first, second, outside, called
            finally:
                called.kill()
                called.wait()


def test_a_connection_goes_there_and_comes_back(tmp_path: Path) -> None:
    with conversation(tmp_path) as (first, second, outside, called):
        moved(first, second, "handover", outside)
        moved(second, first, "failback", outside)
        (tmp_path / "go").touch()
        robots.until(lambda: called.poll() is not None, "the peer's end")
        assert outside.said()[-1] == "ok"
        robots.until(lambda: said(first)[1:], "the program's verdict")
        assert said(first) == ["ready", "ok"]


def test_a_crash_resets_it(tmp_path: Path) -> None:
    with conversation(tmp_path) as (first, second, _, _):
        first.cut_power()
        robots.until(lambda: talking(second).get("role") == "primary", "it to go on there")
        (tmp_path / "go").touch()
        robots.until(lambda: said(second)[1:], "the program's verdict")
        assert said(second)[-1] == "Connection reset by peer (104)"
