"""Two sites at the ends of a long wire, for a test: robot1 at one, robot3 and a witness with sealed copies at the other.

robot1 has the site harbour, robot3 the site hall. The witness gate is beside robot3, at a site of its own: with it robot3 would
be one of two that vote.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from failover.archive import keys, signature
from failover.cli import key_pairs
from failover.cli.demo.robots import RobotMachine, ip_inside, run, wait_for_network
from failover.config import team
from failover.config.team import Robot, Role, Team
from tests.e2e import robots
from tests.e2e.apart import tc_command
from tests.e2e.long_wire import ADDRESS, NAME, LongWire, long_wire
from tests.e2e.teams import TeamStage

ROLES: dict[str, Role] = {"robot1": "robot", "robot3": "robot", "gate": "witness"}
SITES = {"robot1": "harbour", "robot3": "hall", "gate": "vault"}
NEAR = ("robot1",)
"""At the first end of the wire; all others are at the second."""

PUTS = '[store]\nwitness = "gate"\ns3_every_s = {every_s}\ns3_keep = 30\n'
"""A copy that is fetched over the wire stays there meanwhile."""

KEEPS = '[store]\nsealed_size = "1GB"\n'
SETTINGS = 'boot_patience_s = 20\npatience_s = 2\nsnapshots_over = "any"\n'
"""A TUN device counts as a radio: what is behind a tunnel is not known."""

PATIENCE_S = 300.0
RATE_LATENCY = "1s"
"""How long a packet waits for its turn at most, where the wire has a rate."""


class TwoSites(TeamStage):
    """Members at both ends of a long wire. The networks outlive the robots, as those of two houses do."""

    wire: LongWire

    def __init__(self, directory: Path, settings: str, every_s: int) -> None:
        puts = PUTS.format(every_s=every_s)
        super().__init__(directory, ROLES, settings, {"robot1": puts, "robot3": puts, "gate": KEEPS})
        self._laid = contextlib.ExitStack()
        self._networks: dict[str, RobotMachine] = {}

    def __exit__(self, *what: object) -> None:
        super().__exit__(*what)
        self._laid.close()

    def start(self) -> None:
        self._networks = {end: self._laid.enter_context(network(end, self.directory)) for end in ("near", "far")}
        self.wire = self._laid.enter_context(long_wire(list(self._networks.values())))
        super().start()

    def limit(self, rate: str) -> None:
        """Let the wire carry no more than that in each direction, as ``2mbit``."""
        for network in self._networks.values():
            inside = ["nsenter", "--net", f"--target={network.process.pid}"]
            limits = ["tbf", "rate", rate, "burst", "16kb", "latency", RATE_LATENCY]
            run([*inside, tc_command(), "qdisc", "add", "dev", NAME, "root", *limits])

    def inside(self, name: str) -> list[str]:
        """What to put before a command that is to run in a member's network."""
        return ["nsenter", "--net", f"--target={self._networks['near' if name in NEAR else 'far'].process.pid}"]

    def command(self, name: str, config: Path) -> list[str]:
        return [*self.inside(name), *super().command(name, config)]

    def failover_agent(self, name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """What a verb of failover-agent does at a member whose agent is stopped."""
        config = self.directory / name / "agent.toml"
        command = [*self.inside(name), sys.executable, "-m", "agent.main", *arguments, "--config", str(config)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)

    def _write_team(self) -> None:
        members = Team("demo")
        for index, (name, role) in enumerate(ROLES.items()):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            host, port = ADDRESS.format(1 if name in NEAR else 2), 7420 + 10 * index
            members = team.enrol(members, name, Robot((f"{host}:{port}",), f"{host}:{port + 1}", role, public, site=SITES[name]))
        for name in ROLES:
            team.write(self.directory / name / "team", members)
        self._give_keys()

    def _give_keys(self) -> None:
        """The archive key to each robot, which opens copies by its own key, and its public half to the witness."""
        first = self.directory / "robot1" / "team"
        shutil.copy2(keys.new_key(first), self.directory / "robot3" / "team" / "keys")
        keys.recovery_path(first).unlink()
        signature.write_public(self.directory / "gate" / "team", keys.read_key(first))


@contextlib.contextmanager
def network(end: str, directory: Path) -> Iterator[RobotMachine]:
    """A network namespace, for as long as a process holds it."""
    process = subprocess.Popen(["unshare", "--net", "--", "sleep", "1000000"])
    holder = RobotMachine(end, directory, process)
    try:
        wait_for_network(holder)
        run(ip_inside(holder, "link", "set", "lo", "up"))
        yield holder
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def stage(tmp_path: Path, settings: str = SETTINGS, every_s: int = 1) -> Iterator[TwoSites]:
    with TwoSites(tmp_path / "stage", settings, every_s) as made:
        made.directory.mkdir()
        try:
            made.start()
            robots.until(
                lambda: all(is_connected(member) for member in made.members.values()), "the members to be connected", PATIENCE_S
            )
            yield made
            for member in made.members.values():
                assert not robots.mistake(member), f"a mistake in the agent of {member.name}:\n{robots.mistake(member)}"
        finally:
            for member in made.members.values():
                lines = member.log.read_text(errors="replace").splitlines() if member.log.exists() else []
                print(f"--- {member.name} said:", *lines[-robots.LOG_LINES :], sep="\n")


def is_connected(member: RobotMachine) -> bool:
    """Whether the replication links to all members of other sites stand."""
    return all(one["lane"] == "connected" for one in member.status()["far"])
