"""Robots that have no team yet: each gets it by the commands that a person types."""

from __future__ import annotations

import contextlib
import io
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msgspec.structs import replace

from failover.cli import main
from failover.cli.demo.robots import RobotMachine, free_ports
from failover.config import team
from failover.config.team import Team
from tests.e2e import robots
from tests.e2e.bridged import SwitchStage


class GrowingStage(SwitchStage):
    """Machines with an agent.toml each, on one switch, or, without networks of their own, on the loopback."""

    def __init__(self, directory: Path, count: int, *, own_network: bool, settings: str = "") -> None:
        super().__init__(directory, count, settings)
        self.means = replace(self.means, own_network=own_network)
        self._ports = free_ports(2 * count) if not own_network else []

    def start(self) -> None:
        """Have the machines ready; no agent runs."""
        for name in self.names:
            (self.directory / name).mkdir(parents=True)
        if self.means.own_network:
            self._switch = subprocess.Popen(["unshare", "--net", "--", "sleep", "1000000"], start_new_session=True)
        self.robots = [self.start_robot(name) for name in self.names]
        if self.means.own_network:
            self.join()

    def machine(self, name: str) -> RobotMachine:
        return self.robots[self.names.index(name)]

    def place(self, name: str) -> Path:
        """Its team directory."""
        return self.directory / name / "team"

    def members(self, name: str) -> Team:
        """The team, as this machine's file has it."""
        return team.read(self.place(name))

    def command(self, name: str, config: Path) -> list[str]:
        """See `Stage.command`."""
        return super(SwitchStage, self).command(name, config)

    def words(self, name: str, act: str, *words: str) -> list[str]:
        """A command of ``failover team``, as a person gives it on that machine."""
        inside = ["nsenter", "--net", f"--target={self.machine(name).process.pid}"] if self.means.own_network else []
        has_agent = act in ("invite", "list", "remove", "rotate")
        socket = ["--socket", str(self.machine(name).socket)] if has_agent else []
        where = ["--directory", str(self.place(name)), *socket]
        return [*inside, sys.executable, "-m", "failover.cli.main", "team", act, *words, *where]

    def typed(self, name: str, act: str, *words: str, apart: bool = False) -> subprocess.CompletedProcess[str]:
        """Give a command there, and wait for its end: in this process, where that makes no difference, unless ``apart``."""
        command = self.words(name, act, *words)
        if self.means.own_network or apart:
            return subprocess.run(command, capture_output=True, text=True, check=False, timeout=robots.PATIENCE_S)
        said, wrong = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = main.main(command[command.index("failover.cli.main") + 1 :])
        return subprocess.CompletedProcess(command, status, said.getvalue(), wrong.getvalue())

    def own_addresses(self, name: str) -> list[str]:
        """What a person must say of a machine's addresses: nothing, where it has a network of its own."""
        if self.means.own_network:
            return []
        beats, bulk = self._ports[2 * self.names.index(name) :][:2]
        return ["--address", f"127.0.0.1:{beats}", "--bulk", f"127.0.0.1:{bulk}"]

    def create(self, name: str, board: str = "") -> None:
        """Begin a team there, with this table of its board, and start its agent."""
        ran = self.typed(name, "create", "lab", *self.own_addresses(name))
        assert ran.returncode == 0, ran.stderr
        with (self.place(name) / team.TEAM_FILE).open("a") as file:
            file.write(board)
        self.switch_on(name)

    def switch_on(self, name: str, *, answers: bool = True) -> None:
        """Start the agent of a machine; after a power cut, the machine as well. ``answers``: wait until it does."""
        if self.machine(name).process.poll() is not None:
            self.robots[self.names.index(name)] = self.start_robot(name)
            if self.means.own_network:
                raise NotImplementedError("its cable is gone")
        self.machine(name).switch_on()
        if answers:
            robots.until(lambda: robots.answers(self.machine(name)), f"{name} to answer")

    @contextmanager
    def invited(self, by: str, name: str, *words: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
        """An invitation that is open: its line, and the command that keeps it so."""
        port = [] if self.means.own_network else ["--port", "0"]
        command = self.words(by, "invite", name, *port, *words)
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as invites:
            try:
                assert invites.stdout is not None and invites.stderr is not None
                told = invites.stdout.readline()
                assert f"{name}@" in told, told + invites.stderr.read()
                yield told.strip(), invites
            finally:
                invites.kill()

    def brought(self, by: str, name: str, *words: str) -> None:
        """Bring a machine into the team, and start its agent."""
        with self.invited(by, name, *words) as (line, invites):
            ran = self.typed(name, "join", line, *self.own_addresses(name))
            assert ran.returncode == 0, ran.stderr
            _, said = invites.communicate(timeout=robots.PATIENCE_S)
            assert invites.returncode == 0 and f"{name} belongs to the team now" in said, said
        self.switch_on(name)

    def show(self) -> None:
        """The agents' last words, for a test that fails."""
        for robot in self.robots:
            lines = robot.log.read_text(errors="replace").splitlines() if robot.log.exists() else []
            print(f"--- {robot.name} said:", *lines[-robots.LOG_LINES :], sep="\n")


@contextmanager
def machines(directory: Path, count: int, *, own_network: bool = False, settings: str = "") -> Iterator[GrowingStage]:
    """So many machines without a team."""
    with GrowingStage(directory / "stage", count, own_network=own_network, settings=settings) as stage:
        try:
            stage.start()
            yield stage
            for robot in stage.robots:
                if robot.log.exists():
                    assert not robots.mistake(robot), f"a mistake in the agent of {robot.name}:\n{robots.mistake(robot)}"
        finally:
            stage.show()
            for robot in stage.robots:
                if (board := robot.socket.parent / "board").is_symlink():
                    shutil.rmtree(board.resolve(), ignore_errors=True)


def together(stage: GrowingStage, *names: str) -> None:
    """Wait until these hear each other, can send snapshots, and know no other member that lives."""

    def heard(name: str) -> bool:
        machine = stage.machine(name)
        peers = {peer["name"] for peer in machine.status()["peers"] if peer["state"] == "live"}
        return peers == set(names) - {name} and all(
            peer["lane"] == "connected" and peer["hears_us"] for peer in machine.status()["peers"] if peer["name"] in peers
        )

    robots.until(lambda: all(map(heard, names)), f"{', '.join(names)} to hear each other")
