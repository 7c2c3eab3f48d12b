"""The test team: five robots, a server, a witness, each simulated as a computer of its own on one machine, and the actuator.

Each has its own network and PIDs and a small disk of its own. Everything is inside one PID, mount and network namespace
(`tests.chaos.__main__`), so that no end of the team leaves anything behind.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

from failover.cli import key_pairs
from failover.cli.demo.robots import RobotMachine, agent_command, cgroup_of, host_command, wait_for_network
from failover.client.control import Control
from failover.config import team
from failover.config.team import Robot, Role, Team
from failover.errors import AgentRefusedError, LostAgentError, NoAgentError
from tests.chaos import actuator
from tests.chaos.network import Network, address_of
from tests.robot_processes import parts

MEMBERS: Final[tuple[tuple[str, Role, tuple[int, ...]], ...]] = (
    ("robot1", "robot", (0, 1)),
    ("robot2", "robot", (0, 1)),
    ("robot3", "robot", (0, 1)),
    ("robot4", "robot", (0,)),
    ("robot5", "robot", (0,)),
    ("server1", "server", (0, 1)),
    ("witness1", "witness", (0,)),
)
"""Name, role, and the links (switches) that it is plugged into."""

BEAT_MS: Final = 50
LEASE_MS: Final = 500
PERIOD_MS: Final = 200
"""Seven agents share two processors with each other and with all other programs: slower than on robots, so that it is
the faults that are seen and not the machine."""

SETTINGS: Final = f'beat_ms = {BEAT_MS}\nlease_ms = {LEASE_MS}\nsnapshot_period_ms = {PERIOD_MS}\nrule = "majority"\n'

DISK: Final = "size=96m"
PATIENCE_S: Final = 300.0
"""A generous bound for every wait: after a blackout seven agents begin at once, which takes some forty seconds of
processor time, and the machine may be slow or busy."""

POLL_S: Final = 0.02
LOOK_S: Final = 0.25
"""Between two questions to all members for their status."""
STEP_MS: Final = 50
"""Between two commands of a program."""

PROGRAMS: Final = Path(__file__).parent / "programs"

AWAY: Final = (NoAgentError, LostAgentError)
"""Errors for a member whose agent is not there, or stands still."""

T = TypeVar("T")


class StuckError(AssertionError):
    """Something that had to happen did not, within a generous bound."""


def until(condition: Callable[[], T], what: Callable[[], str] | str, poll_s: float = POLL_S) -> T:
    """The first true value of the condition.

    Args:
        poll_s: between two looks: longer where a look costs the members work.

    Raises:
        StuckError: there was none in time.
    """
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise StuckError(f"waited {PATIENCE_S:.0f} s in vain for {what if isinstance(what, str) else what()}")
        time.sleep(poll_s)
    return value


@dataclass(frozen=True, slots=True)
class Program:
    """One component: where it begins, and how."""

    name: str
    home: str
    engine: str
    argv: tuple[str, ...]


@dataclass(slots=True, eq=False)
class Member:
    """One computer, with power or without.

    Attributes:
        machine: None while it has no power.
        stopped: processes that stand still (SIGSTOP).
    """

    number: int
    name: str
    role: Role
    links: tuple[int, ...]
    directory: Path
    machine: RobotMachine | None = None
    stopped: list[int] = field(default_factory=list)

    @property
    def disk(self) -> Path:
        """The directory that survives a power cut."""
        return self.directory / "state"

    def status(self) -> dict[str, Any]:
        """The status of its agent now.

        Raises:
            NoAgentError, LostAgentError: it does not answer.
        """
        with self.control() as link:
            return link.ask("status")

    def control(self) -> Control:
        """A connection to its agent, which gives up on an agent that stands still.

        Raises:
            NoAgentError: there is none.
        """
        if self.machine is None:
            raise NoAgentError(f"{self.name} has no power")
        return impatient(Control.open(self.machine.socket))

    def parts(self, name: str) -> list[int]:
        """PIDs of its processes that play this part of an agent."""
        return parts(self.machine, name) if self.machine is not None else []

    def stop(self, pids: list[int]) -> None:
        """Have processes stand still."""
        send(pids, signal.SIGSTOP)
        self.stopped += pids

    def go_on(self) -> None:
        """Let all go on that stand still."""
        send(self.stopped, signal.SIGCONT)
        self.stopped = []


def send(pids: Iterable[int], number: int) -> None:
    """A signal to each that is still there."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


ANSWER_S: Final = 3
"""Longer than any answer takes; an agent that stands still is not waited for."""


def impatient(link: Control) -> Control:
    """The connection, whose reads fail after a while."""
    with socket.socket(fileno=os.dup(link.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", ANSWER_S, 0))
    return link


class House:
    """All of it. A context manager; leaving it ends everything."""

    def __init__(self, directory: Path, programs: tuple[Program, ...]) -> None:
        """
        Args:
            directory: empty; the files left in it afterwards are the evidence.
        """
        self.directory = directory
        self.programs = programs
        self.network = Network(2)
        self.members = [Member(number, name, role, links, directory / name) for number, (name, role, links) in enumerate(MEMBERS)]
        self._actuator: subprocess.Popen[str] | None = None
        self._cgroups: set[Path] = set()

    def __enter__(self) -> House:
        return self

    def __exit__(self, *_: object) -> None:
        for member in self.members:
            member.go_on()
            if member.machine is not None:
                member.machine.end()
        if self._actuator is not None:
            self._actuator.kill()
            self._actuator.wait()
        for place in self._cgroups:
            with contextlib.suppress(OSError):  # its guard was quicker
                place.rmdir()

    def note_cgroups(self, member: Member) -> None:
        """Remember those of a member whose guards are about to be killed: they are removed when all is over."""
        pids = member.machine.processes() if member.machine is not None else ()
        self._cgroups |= {place for pid in pids if (place := cgroup_of(pid)) is not None}

    @property
    def robots(self) -> list[Member]:
        """Those that run components."""
        return [member for member in self.members if member.role == "robot"]

    @property
    def powered(self) -> list[Member]:
        """Those that have power."""
        return [member for member in self.members if member.machine is not None]

    def member(self, name: str) -> Member:
        """By name."""
        return next(member for member in self.members if member.name == name)

    def start(self) -> None:
        """Build the network, begin all members and then all programs."""
        Path("/proc/sys/net/unix/max_dgram_qlen").write_text("1000")
        self.network.build()
        self._actuator = self._start_actuator()
        self._enrol()
        for member in self.members:
            member.disk.mkdir()
            self.new_disk(member)
            self.power_on(member)
        until(self.is_connected, "all members to hear each other", LOOK_S)
        for program in self.programs:
            self._run(program)

    def _start_actuator(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.chaos.actuator", str(self.directory), *(one.name for one in self.programs)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n", "the actuator did not start"
        return process

    def _enrol(self) -> None:
        everybody = Team("house")
        for member in self.members:
            public, secret = key_pairs.new_pair()
            place = member.directory / "team"
            place.mkdir(parents=True)
            team.write_secret_key(place, member.name, secret)
            hosts = [address_of(member.number, link) for link in member.links]
            beats = tuple(f"{host}:{team.DEFAULT_BEAT_PORT}" for host in hosts)
            entry = Robot(beats, f"{hosts[0]}:{team.DEFAULT_BULK_PORT}", member.role, public)
            everybody = team.enrol(everybody, member.name, entry)
            self._configuration(member).write_text(
                f'robot = "{member.name}"\nteam_directory = "{place}"\nstate_directory = "{member.disk}"\n'
                f'runtime_directory = "{member.directory / "run"}"\n{SETTINGS}'
            )
        for member in self.members:
            team.write(member.directory / "team", everybody)

    def _configuration(self, member: Member) -> Path:
        return member.directory / "agent.toml"

    def new_disk(self, member: Member) -> None:
        """An empty one, in place of the old one if there was one."""
        if os.path.ismount(member.disk):
            subprocess.run(["umount", "--lazy", str(member.disk)], check=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, f"disk-{member.name}", str(member.disk)], check=True)

    def power_on(self, member: Member) -> None:
        """Start a member; its disk is as it was left, and what was in memory is gone."""
        shutil.rmtree(member.directory / "run", ignore_errors=True)
        (member.directory / "run").mkdir()
        command = ["unshare", "--net", "--", *host_command(True, agent_command(self._configuration(member)))]
        with (member.directory / "agent.log").open("ab") as log:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True)
        machine = RobotMachine(member.name, member.directory, process)
        wait_for_network(machine)
        for link in member.links:
            self.network.plug(member.number, link, process.pid)
        machine.switch_on()
        member.machine = machine
        until(lambda: machine.processes(), f"{member.name} to start")
        self._inside(member, "sleep", "1000000")  # its host ends with its last process, and agents die here

    def power_off(self, member: Member) -> None:
        """Cut its power: silent from one instant on, then gone."""
        assert member.machine is not None
        for link in member.links:
            self.network.pull([(member.number, link)])
        member.machine.cut_power()
        self.network.unplug(member.number)
        self.network.push([(member.number, link) for link in member.links])
        member.machine, member.stopped = None, []

    def start_agent(self, member: Member) -> None:
        """Start its agent again, as its service would."""
        self._inside(member, *agent_command(self._configuration(member)))

    def _inside(self, member: Member, *command: str) -> None:
        """Start a process of a member that has no parent there."""
        assert member.machine is not None
        script = f'"$@" </dev/null >>{member.directory / "agent.log"} 2>&1 &'
        init = member.machine.processes()[0]
        enter = ["nsenter", f"--target={init}", "--all", "setsid", "sh", "-c", script, "sh"]
        subprocess.run([*enter, *command], check=True)

    def _run(self, program: Program) -> None:
        member = self.member(program.home)
        assert member.machine is not None, "it is powered before anything fails"
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C"}
        with Control.open(member.machine.socket) as link:  # a start takes as long as the machine is busy
            link.ask(
                "run",
                argv=list(program.argv),
                name=f"/house/{program.name}",
                env=environment,
                wait=False,
                engine=program.engine,
                output="committed",
            )

    def order_handover(self, component: str, source: Member, target: Member) -> None:
        """Order a component to move, without waiting for the answer."""
        with contextlib.suppress(*AWAY):
            link = source.control()
            threading.Thread(target=_ask, args=(link, component, target.name), daemon=True).start()

    def pictures(self) -> dict[str, dict[str, Any]]:
        """The status of every member that answers."""
        found = {}
        for member in self.powered:
            with contextlib.suppress(*AWAY):
                found[member.name] = member.status()
        return found

    def is_connected(self) -> bool:
        """Whether every member hears every other and has a replication link to it."""
        pictures = self.pictures()
        peers = [peer for picture in pictures.values() for peer in picture["peers"]]
        heard = all(peer["state"] == "live" and peer["hears_us"] and peer["lane"] == "connected" for peer in peers)
        return heard and len(pictures) == len(self.members)


def _ask(link: Control, component: str, target: str) -> None:
    with contextlib.suppress(*AWAY, AgentRefusedError), link:
        link.ask("handover", name=f"/house/{component}", to=target)


def programs(directory: Path, compiler: str | None, awk: str | None) -> Iterator[Program]:
    """The programs of the campaign: as many kinds as this machine has.

    Args:
        directory: of the actuator; a C program is built there.
    """
    place, period = str(directory / actuator.SOCKET), str(STEP_MS)
    if compiler is not None:
        subprocess.run([compiler, "-O1", "-o", directory / "count", PROGRAMS / "count.c"], check=True)
        yield Program("c", "robot1", "ptrace", (str(directory / "count"), "c", place, period))
    python = ("/usr/bin/python3", "-S", str(PROGRAMS / "count.py"))
    yield Program("python", "robot2", "ptrace", (*python, "python", place, period))
    keep = (sys.executable, str(PROGRAMS / "keep.py"))
    yield Program("keeps", "robot3", "cooperative", (*keep, "keeps", place, period))
    if awk is not None:
        words = ("-v", "name=awk", "-v", f"pipe={actuator.pipe_of(directory, 'awk')}", "-v", f"period={STEP_MS / 1_000}")
        yield Program("awk", "robot4", "ptrace", (awk, *words, "-f", str(PROGRAMS / "count.awk")))
    yield Program("auto", "robot5", "auto", (*keep, "auto", place, period))
