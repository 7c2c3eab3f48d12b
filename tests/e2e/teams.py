"""A team of any members for a test: robots, servers and witnesses on this machine's loopback, each with PIDs of its own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from msgspec.structs import replace

from failover.cli import key_pairs
from failover.cli.demo.robots import RobotMachine, Stage, agent_command, free_ports, host_command
from failover.config import team
from failover.config.team import Robot, Role, Team
from tests.e2e import robots

ORDINARY_USER = ("/usr/bin/env", "unshare", "--user", "--map-user=1000", "--map-group=1000", "--")
"""In a user namespace of its own as somebody who is not root there: no capability is left, here or there."""

TWO_AND_A_SERVER: Mapping[str, Role] = {"robot1": "robot", "robot2": "robot", "hall": "server"}

NOTHING: Mapping[str, str] = {}


class TeamStage(Stage):
    """The members and the place where they stand; each can be cut off from its power and switched on again."""

    def __init__(self, directory: Path, roles: Mapping[str, Role], settings: str = "", own: Mapping[str, str] = NOTHING) -> None:
        super().__init__(directory, replace(robots.means(), own_network=False), settings)
        self._roles = roles
        self._own = own
        self.members: dict[str, RobotMachine] = {}

    def start(self) -> None:
        """Write keys and configuration, start all agents, wait until they answer and hear each other."""
        self._write_team()
        for name in self._roles:
            self.switch_on(name)
        robots.until(lambda: all(hears_all(member) for member in self.members.values()), "the team to hear each other")

    def switch_on(self, name: str, *, empty: bool = False) -> RobotMachine:
        """Start a member, with its disk as it was left or ``empty``; returns when its agent answers.

        An empty one must find somebody who remembers it: it answers in the life that it begins then.
        """
        if empty:
            shutil.rmtree(self.directory / name / "state")
        shutil.rmtree(self.directory / name / "run", ignore_errors=True)  # it does not outlive a reboot
        member = self.members[name] = self.start_robot(name)
        self.robots.append(member)
        member.switch_on()
        robots.until(lambda: lives(member) > int(empty), f"{name} to answer")
        return member

    def cut_power(self, *names: str) -> None:
        """Freeze these members and all that runs there, then kill them: neither sees the other one go."""
        for name in names:
            self.members[name].freeze()
        for name in names:
            self.members[name].end()

    def configuration(self, name: str, directory: Path) -> str:
        """The text of a member's agent.toml, with what it has for itself."""
        return super().configuration(name, directory) + self._own.get(name, "")

    def command(self, name: str, config: Path) -> list[str]:
        """The host of a member; of a witness as an ordinary user, without capabilities."""
        if self._roles[name] == "witness":
            return host_command(False, [*ORDINARY_USER, *agent_command(config)])
        return super().command(name, config)

    def _write_team(self) -> None:
        ports = free_ports(2 * len(self._roles))
        members = Team("demo")
        for index, (name, role) in enumerate(self._roles.items()):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            beats, bulk = (f"127.0.0.1:{port}" for port in ports[2 * index : 2 * index + 2])
            members = team.enrol(members, name, Robot((beats,), bulk, role, public))
        for name in self._roles:
            team.write(self.directory / name / "team", members)


def lives(member: RobotMachine) -> int:
    """In which life its agent is; 0 while it does not answer."""
    try:
        return int(member.status()["life"])
    except robots.NO_ANSWER:
        return 0


def hears_all(member: RobotMachine) -> bool:
    """Whether it hears everybody, is heard by everybody, and can send snapshots."""
    peers = member.status()["peers"]
    return all(peer["state"] == "live" and peer["hears_us"] and peer["lane"] == "connected" for peer in peers)


@contextmanager
def acting(
    directory: Path,
    roles: Mapping[str, Role] = TWO_AND_A_SERVER,
    settings: str = "",
    own: Mapping[str, str] = NOTHING,
) -> Iterator[TeamStage]:
    """A team of these members, beating and connected; ``own``: lines of agent.toml that one member alone has."""
    with TeamStage(directory / "stage", roles, settings, own) as stage:
        stage.directory.mkdir(exist_ok=True)  # a test may have put a disk of its own there
        try:
            stage.start()
            yield stage
            for member in stage.members.values():
                assert not robots.mistake(member), f"a mistake in the agent of {member.name}:\n{robots.mistake(member)}"
        finally:
            for member in stage.members.values():  # shown by pytest where a test fails
                lines = member.log.read_text(errors="replace").splitlines() if member.log.exists() else []
                print(f"--- {member.name} said:", *lines[-robots.LOG_LINES :], sep="\n")
