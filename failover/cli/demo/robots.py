"""The robots of the demo: directories, keys, namespaces, agents; and the power cut.

Nothing of a robot outlives its host process (`failover.cli.demo.host`), and network namespaces have no names, so that they go
with their last process: however the demo ends, at most a temporary directory can be left.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Self

from msgspec import Struct

from failover.cli import key_pairs
from failover.cli.demo.host import descendants
from failover.cli.demo.interruption import Interruption
from failover.cli.demo.waiting import Tell, Waiting
from failover.client.control import Control
from failover.config import team
from failover.config.team import Robot, Team
from failover.errors import FailoverError, LostAgentError, NoAgentError

NAMES: Final = ("robot1", "robot2")
BEAT_MS: Final = 20
LEASE_MS: Final = 120
BOOT_PATIENCE_S: Final = 3
"""These robots' networks are there when they boot."""

START_S: Final = 60.0
"""How long an agent may take until it answers; a second is usual, a busy machine takes more."""

ADDRESS: Final = "10.71.7.{}"
"""Of the robots in network namespaces of their own; nothing outside them sees these addresses."""

CABLES: Final = (("wire", ADDRESS),)
"""Between the two, where they have networks of their own: each cable's name at both ends, and its addresses."""

PORTS_FROM: Final = 10_000
"""Of ports of the loopback for robots without a network of their own; the lower ones have names."""

POLL_S: Final = 0.005

LAST_LINES: Final = 5
"""Of an agent's log, shown when something goes wrong."""

GUARDS_CGROUP: Final = "failover-"
"""How the names of the guards' cgroups begin (`agent.guard.freezer`)."""

GO: Final = b"g"
"""The byte that a host waits for before it starts its agent."""


class Pace(Struct, frozen=True):
    """How often the robots send heartbeats, and how long one is good for."""

    beat_ms: int
    lease_ms: int


USUAL_PACE: Final = Pace(BEAT_MS, LEASE_MS)


class Means(Struct, frozen=True):
    """The means that this machine allows: each True makes the robots more like two machines."""

    own_pids: bool
    own_network: bool

    def sentence(self) -> str:
        """The things that each robot has of its own, and why not more."""
        pids = "own PIDs" if self.own_pids else "shared PIDs (this system forbids user namespaces)"
        network = "own network, joined by a cable" if self.own_network else f"loopback ports ({why_no_network()})"
        return f"{pids}, {network}"


def means() -> Means:
    """Find out which means can be had here."""
    probe = subprocess.run(host_command(True, ["/bin/true"]), input=GO, capture_output=True, check=False)
    own_network = os.geteuid() == 0 and ip_command() is not None and can_unshare_network()
    return Means(own_pids=probe.returncode == 0, own_network=own_network)


def why_no_network() -> str:
    """Why robots cannot have a network of their own here."""
    if os.geteuid() != 0:
        return "a network of their own needs root"
    return "this system forbids networks of their own" if ip_command() else "a network of their own needs iproute2"


def ip_command() -> str | None:
    """The path of ip(8), also when sbin is not on the PATH."""
    return shutil.which("ip", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")


def can_unshare_network() -> bool:
    """Whether root may do here what root usually may (not so in many containers)."""
    return subprocess.run(["unshare", "--net", "true"], capture_output=True, check=False).returncode == 0


def host_command(own_pids: bool, command: list[str]) -> list[str]:
    """The command line of a host process around ``command``."""
    return [sys.executable, "-P", "-m", "failover.cli.demo.host", *(["--pids"] if own_pids else []), "--", *command]


class RobotMachine(Struct):
    """One robot: its host process and how to talk to its agent.

    Attributes:
        directory: its configuration, state and sockets.
    """

    name: str
    directory: Path
    process: subprocess.Popen[bytes]

    @property
    def socket(self) -> Path:
        """Its agent's control socket."""
        return self.directory / "run" / "control.sock"

    @property
    def log(self) -> Path:
        """The output of its agent."""
        return self.directory / "agent.log"

    @property
    def start_s(self) -> float:
        """How long its agent may take until it answers."""
        return START_S

    def switch_on(self) -> None:
        """Let the host start the agent."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already: `control` says why
            self.process.stdin.write(GO)
            self.process.stdin.close()

    def control(self, tell: Tell = lambda _: None) -> Control:
        """A connection to its agent, as soon as it answers.

        Args:
            tell: gets a line every few seconds in which it does not answer.

        Raises:
            FailoverError: it ended, with the last lines of its log, or does not answer in time.
        """
        waiting = Waiting(f"the agent of {self.name} to answer", self.start_s, tell)
        while True:
            try:
                link = Control.open(self.socket)
                link.ask("ping")
                return link
            except (NoAgentError, LostAgentError) as error:
                if self.process.poll() is not None:
                    raise FailoverError(f"the agent of {self.name} ended at once: {self.last_words()}") from error
                if waiting.is_over():
                    raise FailoverError(f"the agent of {self.name} did not answer in {self.start_s:.0f} s") from error
                time.sleep(POLL_S)

    def status(self) -> dict[str, Any]:
        """The present status, from its agent."""
        with Control.open(self.socket) as link:
            return link.ask("status")

    def processes(self) -> list[int]:
        """All of the robot, its host's own children first."""
        return descendants(self.process.pid)

    def cut_power(self) -> int:
        """Freeze every process of the robot, then kill them all at once; returns how many there were.

        Frozen first, so that no one of them can notice that another has gone: to the outside it is silent from one instant on.
        """
        count = self.freeze()
        self.end()
        return count

    def freeze(self) -> int:
        """Stop every process of the robot; returns how many there are."""
        frozen: set[int] = set()
        while fresh := set(self.processes()) - frozen:  # until no new one appears
            for pid in fresh:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGSTOP)
            frozen |= fresh
        return len(frozen)

    def end(self) -> None:
        """Kill all processes left, wait until none is, and remove the cgroups that only its guards would have removed."""
        cgroups = {place for pid in self.processes() if (place := cgroup_of(pid)) is not None}
        while left := self.processes():
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(POLL_S)
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        for place in cgroups:
            with contextlib.suppress(OSError):  # another robot uses it as well, or the guard was quicker
                place.rmdir()

    def last_words(self) -> str:
        """The end of its agent's log, for a message."""
        with contextlib.suppress(OSError):
            return " / ".join(self.log.read_text(errors="replace").strip().splitlines()[-LAST_LINES:]) or "it said nothing"
        return "it left no log"


def cgroup_of(pid: int) -> Path | None:
    """The cgroup that a guard has made for a process; None where it stands in another one."""
    with contextlib.suppress(OSError):
        points = [line.split()[1] for line in Path("/proc/self/mounts").read_text().splitlines() if line.split()[2] == "cgroup2"]
        paths = [line[3:] for line in Path(f"/proc/{pid}/cgroup").read_text().splitlines() if line.startswith("0::")]
        if points and paths and Path(paths[0]).name.startswith(GUARDS_CGROUP):
            return Path(points[0], paths[0].lstrip("/"))
    return None


class Stage:
    """Both robots and the place where they stand. A context manager: leaving it ends them and removes the place."""

    def __init__(
        self,
        directory: Path,
        allowed: Means,
        settings: str = "",
        interruption: Interruption | None = None,
        cables: Sequence[tuple[str, str]] = CABLES,
        pace: Pace = USUAL_PACE,
        *,
        tell: Tell = lambda _: None,
    ) -> None:
        """
        Args:
            tell: gets a line every few seconds in which an agent does not answer.
            settings: lines of TOML added to each robot's configuration.
            interruption: held while a robot is begun, so that no robot goes unnoted.
            cables: as `CABLES`; beats go over all of them, snapshots over the first.
        """
        self._cables = cables
        patience = "" if "boot_patience_s" in settings else f"boot_patience_s = {BOOT_PATIENCE_S}\n"
        self._pace = f"beat_ms = {pace.beat_ms}\nlease_ms = {pace.lease_ms}\n{patience}"
        self.directory = directory
        self._settings = settings
        self._tell = tell
        self.means = allowed
        self.interruption = interruption or Interruption()
        self.robots: list[RobotMachine] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for robot in self.robots:
            robot.end()
        shutil.rmtree(self.directory, ignore_errors=True)

    def start(self) -> None:
        """Write keys and configuration, start both agents, join their networks, wait until both answer."""
        self._write_team()
        for name in NAMES:
            with self.interruption.held():
                self.robots.append(self.start_robot(name))
        if self.means.own_network:
            self.join()
        for robot in self.robots:
            robot.switch_on()
        for robot in self.robots:
            robot.control(self._tell).close()

    def keep_logs(self) -> Path | None:
        """Copy the agents' logs to a directory that outlives this stage; None where there are none, or no room."""
        with contextlib.suppress(OSError):
            if logs := [robot for robot in self.robots if robot.log.exists()]:
                place = Path(tempfile.mkdtemp(prefix="failover-demo-logs-"))
                for robot in logs:
                    shutil.copyfile(robot.log, place / f"{robot.name}.log")
                return place
        return None

    def _write_team(self) -> None:
        formats = [address for _, address in self._cables] if self.means.own_network else ["127.0.0.1"]
        ports = [7420, 7421, 7420, 7421] if self.means.own_network else free_ports(4)
        members = Team("demo")
        for index, name in enumerate(NAMES):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            beat_port, bulk_port = ports[2 * index : 2 * index + 2]
            hosts = [address.format(index + 1) for address in formats]
            beats = tuple(f"{host}:{beat_port}" for host in hosts)
            members = team.enrol(members, name, Robot(beats, f"{hosts[0]}:{bulk_port}", "robot", public))
        for name in NAMES:
            team.write(self.directory / name / "team", members)

    def start_robot(self, name: str) -> RobotMachine:
        """The host of a robot, with its configuration; it waits to be switched on. Its disk is as it was left, if it had one."""
        directory = self.directory / name
        for part in ("state", "run"):
            (directory / part).mkdir(exist_ok=True)  # a test may have put a disk of its own there
        config = directory / "agent.toml"
        config.write_text(self.configuration(name, directory))
        command = self.command(name, config)
        if self.means.own_network:
            assert shutil.which("unshare")
            command = ["unshare", "--net", "--", *command]
        with (directory / "agent.log").open("wb") as log:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True)
        return RobotMachine(name, directory, process)

    def configuration(self, name: str, directory: Path) -> str:
        """The text of a robot's agent.toml, whose things lie in this directory."""
        return (
            f'robot = "{name}"\n'
            f'team_directory = "{directory / "team"}"\n'
            f'state_directory = "{directory / "state"}"\n'
            f'runtime_directory = "{directory / "run"}"\n'
            f"{self._pace}{self._settings}"
        )

    def command(self, _name: str, config: Path) -> list[str]:
        """The command line of a robot's host, with its agent."""
        return host_command(self.means.own_pids, agent_command(config))

    def join(self) -> None:
        """Lay the cables between the two network namespaces."""
        for robot in self.robots:
            wait_for_network(robot)
            run(ip_inside(robot, "link", "set", "lo", "up"))
        for cable, address in self._cables:
            lay(self.robots, cable, address)


def lay(robots: Sequence[RobotMachine], cable: str, address: str) -> None:
    """Lay a cable between two robots; an end of it is in each network namespace, with that robot's address, and up."""
    first, second = (str(robot.process.pid) for robot in robots)
    kind = ["type", "veth", "peer", "name", cable, "netns", second]
    run([ip_command() or "ip", "link", "add", cable, "netns", first, *kind])
    for index, robot in enumerate(robots, start=1):
        run(ip_inside(robot, "address", "add", address.format(index) + "/24", "dev", cable))
        run(ip_inside(robot, "link", "set", cable, "up"))


def ip_inside(robot: RobotMachine, *words: str) -> list[str]:
    """An ip(8) command in a robot's network namespace."""
    return ["nsenter", "--net", f"--target={robot.process.pid}", ip_command() or "ip", *words]


def agent_command(config: Path) -> list[str]:
    """The command line of an agent."""
    return [sys.executable, "-P", "-m", "agent.system.child_main", "agent.main", "--config", str(config)]


def wait_for_network(robot: RobotMachine) -> None:
    """Wait until a robot's host has left our network namespace."""
    ours = os.readlink("/proc/self/ns/net")
    deadline = time.monotonic() + START_S
    while os.readlink(f"/proc/{robot.process.pid}/ns/net") == ours:
        if robot.process.poll() is not None or time.monotonic() > deadline:
            raise FailoverError(f"{robot.name} got no network of its own: {robot.last_words()}")
        time.sleep(POLL_S)


def run(command: list[str]) -> None:
    """Run one set-up command.

    Raises:
        FailoverError: it failed; quotes its message.
    """
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise FailoverError(f"{' '.join(command)} failed: {ran.stderr.strip() or ran.returncode}")


def free_ports(count: int) -> list[int]:
    """Ports of the loopback that are free now, as TCP and as UDP, and that the system lends to no program that asks for any.

    So a robot that was away for a while finds its own free when it comes back.
    """
    held: list[socket.socket] = []
    ports: list[int] = []
    try:
        while len(ports) < count:
            stream = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            held.append(stream)
            datagram = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            held.append(datagram)
            with contextlib.suppress(OSError):  # another process has this one
                stream.bind(("127.0.0.1", _any_port()))
                datagram.bind(stream.getsockname())
                ports.append(stream.getsockname()[1])
    finally:
        for one in held:
            one.close()
    return ports


def _any_port() -> int:
    """One that is not lent, by chance; 0, which has the system choose, where it lends nearly all. Source: ip(7)."""
    lent_from = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    return random.randrange(PORTS_FROM, lent_from) if lent_from >= 2 * PORTS_FROM else 0
