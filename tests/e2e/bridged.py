"""Robots with networks of their own on one switch: a bridge of this kernel, in a network namespace that goes with its process."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from failover.cli import key_pairs
from failover.cli.demo.robots import USUAL_PACE, Pace, RobotMachine, Stage, ip_command, ip_inside, run, wait_for_network
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.frames.media import Cast
from failover.errors import AgentRefusedError
from tests.e2e import robots, teams
from tests.e2e.frames_seen import Seen

ADDRESS = "10.71.8.{}"
CABLE = "wire"
BOARD = """
[board.items.ball]
type = { x = "f4", y = "f4" }
"""


class SwitchStage(Stage):
    """Robots on one switch, with a board."""

    def __init__(self, directory: Path, count: int, settings: str = "", board: str = BOARD, pace: Pace = USUAL_PACE) -> None:
        super().__init__(directory, robots.means(), settings, pace=pace)
        self.names = [f"robot{number}" for number in range(1, count + 1)]
        self._board = board
        self._switch: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the switch and all robots; returns when all hear each other."""
        self._write_team()
        self._switch = subprocess.Popen(["unshare", "--net", "--", "sleep", "1000000"], start_new_session=True)
        self.robots = [self.start_robot(name) for name in self.names]
        self.join()
        for robot in self.robots:
            robot.switch_on()
        robots.until(lambda: all(map(robots.answers, self.robots)), "all agents to answer")
        robots.until(lambda: all(map(teams.hears_all, self.robots)), "the team to hear each other")

    def __exit__(self, *exception: object) -> None:
        super().__exit__(*exception)
        if self._switch is not None:
            self._switch.kill()
            self._switch.wait()

    def on_switch(self, *words: str) -> None:
        """Run a command in the switch."""
        assert self._switch is not None
        run(["nsenter", "--net", f"--target={self._switch.pid}", *words])

    def join(self) -> None:
        """Lay a cable from each robot to the switch, whose ports are called as the robots."""
        assert self._switch is not None
        ip = ip_command() or "ip"
        wait_for_network(RobotMachine("the switch", self.directory, self._switch))
        self.on_switch(ip, "link", "add", "switch", "type", "bridge")
        self.on_switch(ip, "link", "set", "switch", "up")
        for number, robot in enumerate(self.robots, 1):
            wait_for_network(robot)
            run(ip_inside(robot, "link", "set", "lo", "up"))
            ends = ["netns", str(robot.process.pid), "type", "veth", "peer", "name", robot.name, "netns", str(self._switch.pid)]
            run([ip, "link", "add", CABLE, *ends])
            run(ip_inside(robot, "address", "add", ADDRESS.format(number) + "/24", "dev", CABLE))
            run(ip_inside(robot, "link", "set", CABLE, "up"))
            self.on_switch(ip, "link", "set", robot.name, "master", "switch", "up")

    def _write_team(self) -> None:
        members = Team("demo")
        for number, name in enumerate(self.names, 1):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            host = ADDRESS.format(number)
            members = team.enrol(members, name, Robot((f"{host}:7420",), f"{host}:7421", "robot", public))
        for name in self.names:
            directory = self.directory / name / "team"
            team.write(directory, members)
            path = directory / team.TEAM_FILE
            path.write_text(path.read_text() + self._board)


@contextmanager
def on_one_switch(
    directory: Path, count: int, settings: str = "", board: str = BOARD, pace: Pace = USUAL_PACE
) -> Iterator[SwitchStage]:
    """So many robots, beating and connected."""
    places: set[Path] = set()
    with SwitchStage(directory / "stage", count, settings, board, pace) as stage:
        stage.directory.mkdir()
        try:
            stage.start()
            places = {(robot.socket.parent / "board").resolve() for robot in stage.robots}
            yield stage
            for robot in stage.robots:
                assert not robots.mistake(robot), f"a mistake in the agent of {robot.name}:\n{robots.mistake(robot)}"
        finally:
            for robot in stage.robots:  # shown by pytest where a test fails
                print(
                    f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n"
                )
            for place in places:
                shutil.rmtree(place, ignore_errors=True)


def medium(robot: RobotMachine) -> dict[str, object]:
    """How its frames leave over its cable."""
    (one,) = robot.status()["media"]
    return dict(one)


def is_cast_to_all(robot: RobotMachine, cast: Cast = Cast.MULTICAST) -> bool:
    """Whether each of its frames is one datagram."""
    now = medium(robot)
    return now["cast"] == cast and not now["by_unicast"]


def settled(stage: SwitchStage, patience_s: float = robots.PATIENCE_S) -> None:
    """Wait until each robot reaches all others by multicast alone."""
    robots.until(lambda: all(map(is_cast_to_all, stage.robots)), "multicast everywhere", patience_s)


def run_at_last(robot: RobotMachine, name: str, *argv: str) -> None:
    """Start a program under protection, as soon as the robot's votes of an earlier life bind it no more."""

    def is_begun() -> bool:
        try:
            robots.run(robot, name, *argv)
        except AgentRefusedError as refusal:
            if "ask again in a moment" not in str(refusal):
                raise
            return False
        return True

    robots.until(is_begun, f"{robot.name} to start {name}")


def sent(robot: RobotMachine) -> int:
    """Packets that left by its cable, as the kernel counted them."""
    told = subprocess.run(ip_inside(robot, "-s", "link", "show", CABLE), capture_output=True, text=True, check=True).stdout
    lines = told.splitlines()
    return int(lines[next(number for number, line in enumerate(lines) if "TX:" in line) + 1].split()[1])


def rate(robot: RobotMachine, span_s: float = 1.0) -> float:
    """Packets a second that leave by its cable."""
    before, began = sent(robot), time.monotonic()
    time.sleep(span_s)
    return (sent(robot) - before) / (time.monotonic() - began)


def frames_at(robot: RobotMachine, span_s: float) -> list[Seen]:
    """The frames that come to a robot by its cable in so many seconds."""
    inside = ["nsenter", "--net", f"--target={robot.process.pid}"]
    program = [sys.executable, "-m", "tests.e2e.frames_seen", CABLE, str(span_s)]
    told = subprocess.run([*inside, *program], capture_output=True, text=True, check=True).stdout
    return list(map(Seen.read, told.splitlines()))
