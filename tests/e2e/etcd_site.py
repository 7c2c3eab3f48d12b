"""Two robots, and an etcd of one member or three, each in a network of its own: a cable leads from each to one router."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from failover.cli.demo.robots import Pace, RobotMachine, ip_command, ip_inside, run
from failover.errors import AgentRefusedError
from tests.agent.coordinator.etcd_server import EtcdServer, three_members
from tests.e2e import robots
from tests.robot_processes import naming

ROUTER: Final = "10.71.9.254"
HOSTS: Final = ("10.71.9.11", "10.71.9.12", "10.71.9.13")
PORT, PEER_PORT = 2379, 2380
PACE: Final = Pace(20, 1_800)

COUNTS: Final = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.02)\n"


@dataclass
class Site:
    """``router``: a process in the network between; ``places``: one in each member's."""

    first: RobotMachine
    second: RobotMachine
    members: list[EtcdServer]
    router: int
    places: list[int]

    @property
    def etcd(self) -> EtcdServer:
        """The only member."""
        (one,) = self.members
        return one

    def reach(self, robot: RobotMachine, *, is_on: bool) -> None:
        """Let a robot reach etcd, or cut it off."""
        run(ip_inside(robot, "link", "set", "etcd", "up" if is_on else "down"))
        if is_on:
            for host in HOSTS[: len(self.members)]:
                run(ip_inside(robot, "route", "replace", host, "via", ROUTER, "dev", "etcd", "onlink"))

    def pull_cable(self, robot: RobotMachine) -> None:
        """Between the robots."""
        run(ip_inside(robot, "link", "set", "wire", "down"))

    def lay_cable(self, robot: RobotMachine) -> None:
        run(ip_inside(robot, "link", "set", "wire", "up"))

    def part(self, member: int, *, is_on: bool) -> None:
        """Cut a member off from the others, or let it reach them again; the robots reach it all the time."""
        for host in HOSTS[: len(self.members)]:
            if host != HOSTS[member]:
                words = ("route", "replace" if is_on else "del", "blackhole", host, "metric", "1")
                run([*within(self.places[member]), ip_command() or "ip", *words])

    def asked(self, method: str, body: dict[str, Any], member: int = 0) -> dict[str, Any]:
        """A member's answer to a request from the router; empty where it is an error."""
        script = (
            "import sys, urllib.request as u; "
            "print(u.urlopen(u.Request(sys.argv[1], sys.argv[2].encode()), timeout=30).read().decode())"
        )
        command = [*within(self.router), sys.executable, "-c", script, f"http://{HOSTS[member]}:{PORT}/v3/{method}"]
        ran = subprocess.run([*command, json.dumps(body)], capture_output=True, text=True, check=False)
        told: dict[str, Any] = json.loads(ran.stdout) if ran.returncode == 0 else {}
        return told

    def leader(self) -> int:
        """Which member leads."""

        def found() -> list[int]:
            told = [self.asked("maintenance/status", {}, member) for member in range(len(self.members))]
            return [number for number, one in enumerate(told) if one and one["header"]["member_id"] == one.get("leader")]

        (one,) = robots.until(found, "a member to lead")
        return one

    def spoken_with(self, robot: RobotMachine) -> int:
        """The member that a robot asks."""

        def found() -> list[int]:
            lines = [line.split() for pid in speakers(robot) for line in Path(f"/proc/{pid}/net/tcp").read_text().splitlines()]
            ends = {words[2] for words in lines if words[3] == ESTABLISHED}
            return [number for number, host in enumerate(HOSTS) if f"{_as_proc_writes(host)}:{PORT:04X}" in ends]

        return robots.until(found, f"{robot.name} to ask a member")[0]


ESTABLISHED: Final = "01"
"""The state of a connection in /proc/PID/net/tcp. Source: proc_pid_net(5)."""


def _as_proc_writes(host: str) -> str:
    return bytes(reversed([int(part) for part in host.split(".")])).hex().upper()


@contextmanager
def site(directory: Path, count: int = 1, settings: str = "") -> Iterator[Site]:
    """Both robots reach etcd, and each other."""
    hosts = HOSTS[:count]
    with ExitStack() as stack:
        router = stack.enter_context(_network())
        run([*within(router), "sh", "-c", "echo 1 >/proc/sys/net/ipv4/ip_forward"])
        places = []
        for number, host in enumerate(hosts):
            place = stack.enter_context(_network())
            _lay(router, place, f"member{number}", host)
            run([*within(place), ip_command() or "ip", "route", "add", "default", "via", ROUTER, "dev", "etcd", "onlink"])
            places.append(place)
        befores = [within(place) for place in places]
        if count == 1:
            members = [EtcdServer(directory / "etcd", hosts[0], PORT, PEER_PORT, before=befores[0])]
        else:
            members = three_members(directory / "etcd", hosts, [PORT, PEER_PORT] * count, befores)
        for member in members:
            stack.callback(member.kill)
            member.start()
        endpoints = ", ".join(f'"{member.endpoint}"' for member in members)
        keys = f'rule = "etcd"\n{settings}[coordinator]\nendpoints = [{endpoints}]\n'
        first, second = stack.enter_context(robots.two_robots(directory, keys, pace=PACE))
        made = Site(first, second, members, router, places)
        for number, robot in enumerate((first, second), start=1):
            _lay(router, robot.process.pid, robot.name, f"10.71.9.{number}")
            made.reach(robot, is_on=True)
        robots.until(lambda: reaches(first) and reaches(second), "both robots to reach etcd")
        yield made


@contextmanager
def _network() -> Iterator[int]:
    """A network of its own; the process that holds it."""
    holder = subprocess.Popen(
        ["unshare", "--net", "--", "sh", "-c", "ip link set lo up; echo; exec sleep 1000000"], stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    try:
        holder.stdout.readline()
        yield holder.pid
    finally:
        holder.kill()
        holder.wait()


def within(place: int) -> list[str]:
    """Words of the command line in front of a command that runs in a network."""
    return ["nsenter", "--net", f"--target={place}"]


def _lay(router: int, place: int, end: str, address: str) -> None:
    """Lay a cable from a network to the router, called ``etcd`` there and ``end`` here."""
    ip = ip_command() or "ip"
    run([ip, "link", "add", "etcd", "netns", str(place), "type", "veth", "peer", "name", end, "netns", str(router)])
    for words in (("address", "add", f"{address}/32", "dev", "etcd"), ("link", "set", "etcd", "up")):
        run([*within(place), ip, *words])
    for words in (
        ("address", "add", f"{ROUTER}/32", "dev", end),
        ("link", "set", end, "up"),
        ("route", "add", address, "dev", end),
    ):
        run([*within(router), ip, *words])


def coordinator(robot: RobotMachine) -> dict[str, Any]:
    told: dict[str, Any] = robot.status()["coordinator"]
    return told


def reaches(robot: RobotMachine) -> bool:
    return bool(coordinator(robot)["state"] == "live")


def until_told(robot: RobotMachine, *words: str) -> None:
    """Until the status says all of it, and that not all is well."""

    def is_told() -> bool:
        status = robot.status()
        told = " ".join((status["promise"], *status["notes"]))
        return not status["healthy"] and all(word in told for word in words)

    robots.until(is_told, f"the status to say {words}")


def started(site: Site, argv: Sequence[str] = ("/usr/bin/python3", "-S", "-c", COUNTS)) -> None:
    """The program runs at the first robot, protected."""

    def runs() -> bool:
        try:
            robots.run(site.first, "count", *argv)
        except AgentRefusedError:
            return False
        return True

    robots.until(runs, "the first robot to be bound by nothing that it may have said before its start")
    robots.until_protected(site.first)


def counts_on(robot: RobotMachine) -> None:
    """What it has written there grows: it runs."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    before = log.stat().st_size
    robots.until(lambda: log.stat().st_size > before, "the program to count on")


def state(robot: RobotMachine) -> str:
    return str(robots.component(robot, "count").get("state"))


def role(robot: RobotMachine) -> str:
    return str(robots.component(robot, "count").get("role"))


def epoch(robot: RobotMachine) -> int:
    return int(robots.component(robot, "count")["epoch"])


def speakers(robot: RobotMachine) -> list[int]:
    """The processes of the robot that speak with etcd."""
    return naming(robot, "agent.coordinator.process")
