"""Two robots that never hear each other: each reaches an etcd and a server of S3 over a slow cable, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from failover.archive import keys
from failover.cli.demo.robots import ADDRESS, NAMES, Pace, RobotMachine, Stage, ip_command, ip_inside, run, wait_for_network
from failover.core.types import PEERS_MAX
from tests import s3_servers
from tests.agent.coordinator.etcd_server import EtcdServer
from tests.e2e import robots

ETCD: Final = "10.71.9.1"
STORE: Final = "10.71.9.2"
RATE: Final = "20mbit"
EVERY_S: Final = 2
PACE: Final = Pace(20, 1_800)
NAME: Final = "count"

START_S: Final = 240.0
"""An agent may take that long to answer: many lives make a machine busy."""

SETTINGS: Final = f"""rule = "etcd"
patience_s = 300
bring = false
[coordinator]
endpoints = ["http://{ETCD}:2379"]
[store]
s3 = "s3://{s3_servers.BUCKET}/robots"
s3_endpoint = "http://{STORE}:5000"
s3_every_s = {EVERY_S}
s3_keep = 3
"""
"""The wait without the archive is longer than any test: what is seen here came by the archive."""

ACTS: Final = """
import os, sys, time
number = 0
while True:
    with open("/proc/1/stat") as stat:
        life = stat.read().rpartition(")")[2].split()[19]
    line = f"{life} {number} {time.time_ns()}\\n".encode()
    file = os.open(sys.argv[1], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, line)
    os.close(file)
    number += 1
    time.sleep(0.02)
"""
"""Each step is one line of one file that all robots share: its order is the order of the acts, whatever a clock says.

CLOCK_REALTIME is one for the machine; a program that was restored has a CLOCK_MONOTONIC of its own, which leaves its outage out.
"""


@dataclass(frozen=True)
class Act:
    """One line: which copy wrote it (the start of its first process), what, and when (CLOCK_REALTIME)."""

    life: str
    number: int
    at_ns: int


@dataclass
class Site:
    """Two robots, what they share, and the file in which their programs act."""

    stage: Stage
    etcd: EtcdServer
    place: int
    record: Path
    deaths: int = 0
    robots: dict[str, RobotMachine] = field(default_factory=dict)

    def lay(self, robot: RobotMachine) -> None:
        """A cable from a robot to the shared network; none leads on from there."""
        number = NAMES.index(robot.name) + 1
        end, own = f"r{number}-{self.deaths}", ADDRESS.format(number)
        wait_for_network(robot)
        run(ip_inside(robot, "link", "set", "lo", "up"))
        kind = ["type", "veth", "peer", "name", end, "netns", str(self.place)]
        run([ip_command() or "ip", "link", "add", "wire", "netns", str(robot.process.pid), *kind])
        run(ip_inside(robot, "address", "add", f"{own}/32", "dev", "wire"))
        run(ip_inside(robot, "link", "set", "wire", "up"))
        within = within_place(self.place)
        run([*within, ip_command() or "ip", "link", "set", end, "up"])
        run([*within, ip_command() or "ip", "route", "replace", own, "dev", end])
        for inside, device in ((["nsenter", "--net", f"--target={robot.process.pid}"], "wire"), (within, end)):
            limits = ["rate", RATE, "burst", "64kb", "latency", "50ms"]
            run([*inside, tc_command(), "qdisc", "add", "dev", device, "root", "tbf", *limits])
        for host in (ETCD, STORE):
            self.reach(robot, host, is_on=True)

    def reach(self, robot: RobotMachine, host: str, *, is_on: bool) -> None:
        """Let a robot reach etcd or the store, or cut it off."""
        run(ip_inside(robot, "route", "replace", *(() if is_on else ("blackhole",)), host, *(("dev", "wire") if is_on else ())))
        if is_on:
            subprocess.run(ip_inside(robot, "route", "del", "blackhole", host), capture_output=True, check=False)

    def boot(self, name: str) -> RobotMachine:
        """Switch a robot on, with the disk that it has."""
        robot = self.robots[name] = self.stage.start_robot(name)
        self.stage.robots = list(self.robots.values())
        self.lay(robot)
        robot.switch_on()
        robots.until(lambda: robots.answers(robot), f"the agent of {name} to answer", START_S)
        self.deaths += 1
        return robot

    def other(self, robot: RobotMachine) -> RobotMachine:
        return next(one for one in self.robots.values() if one.name != robot.name)

    def acts(self) -> list[Act]:
        """All that any program did, in the order in which it was done."""
        return acts_in(self.record)


def acts_in(record: Path) -> list[Act]:
    """What `ACTS` wrote there."""
    if not record.exists():
        return []
    words = (line.split() for line in record.read_text().splitlines())
    return [Act(life, int(number), int(at_ns)) for life, number, at_ns in words]


def tc_command() -> str:
    return shutil.which("tc", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin") or "tc"


def within_place(place: int) -> list[str]:
    return ["nsenter", "--net", f"--target={place}"]


def overlaps(acts: Sequence[Act]) -> int:
    """How often a copy acted again after another one had acted."""
    over: Counter[str] = Counter()
    found, last = 0, ""
    for act in acts:
        if act.life != last:
            found += over[act.life] > 0
            over[last] += 1
            last = act.life
    return found


@contextmanager
def site(directory: Path, settings: str = SETTINGS) -> Iterator[Site]:
    """Both robots reach etcd; the bucket is empty, the archive key is at both."""
    os.environ.update(s3_servers.environment())
    place = subprocess.Popen(
        ["unshare", "--net", "--", "sh", "-c", "ip link set lo up; echo; exec sleep 1000000"], stdout=subprocess.PIPE
    )
    assert place.stdout is not None
    place.stdout.readline()
    within = within_place(place.pid)
    for host in (ETCD, STORE):
        run([*within, ip_command() or "ip", "address", "add", f"{host}/32", "dev", "lo"])
    etcd = EtcdServer(directory / "etcd", ETCD, 2379, 2380, before=within)
    etcd.start()
    moto = [str(s3_servers.PROGRAMS / "moto_server"), "-H", "0.0.0.0", "-p", "5000"]
    with (directory / "moto.log").open("wb") as log:
        store = subprocess.Popen([*within, *moto], stdout=log, stderr=log, stdin=subprocess.DEVNULL)
    stage = Stage(directory / "stage", robots.means(), settings, cables=(("wire", ADDRESS),), pace=PACE)
    made = Site(stage, etcd, place.pid, directory / "acts")
    try:
        make_bucket(within)
        with stage:
            stage.directory.mkdir()
            stage._write_team()
            key = keys.new_key(stage.directory / NAMES[0] / "team")
            shutil.copy2(key, keys.key_path(stage.directory / NAMES[1] / "team"))
            keys.recovery_path(stage.directory / NAMES[0] / "team").unlink()
            try:
                for name in NAMES:
                    made.boot(name)
                for robot in made.robots.values():
                    robots.until(lambda robot=robot: reaches(robot), f"{robot.name} to reach etcd")  # type: ignore[misc]
                yield made
                for robot in made.robots.values():
                    assert not robots.mistake(robot), f"a mistake in the agent of {robot.name}:\n{robots.mistake(robot)}"
            finally:
                for robot in made.robots.values():
                    said = robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :]
                    print(f"--- {robot.name} said:", *said, sep="\n")
    finally:
        etcd.kill()
        for process in (store, place):
            process.kill()
            process.wait()


def make_bucket(within: Sequence[str]) -> None:
    script = (
        f"import urllib.request as u; u.urlopen(u.Request('http://{STORE}:5000/{s3_servers.BUCKET}', method='PUT'), timeout=9)"
    )
    command = [*within, sys.executable, "-c", script]
    robots.until(lambda: not subprocess.run(command, capture_output=True, check=False).returncode, "the server of S3 to answer")


def reaches(robot: RobotMachine) -> bool:
    return bool(robots.answers(robot) and robot.status()["coordinator"]["state"] == "live")


def start_program(site: Site, robot: RobotMachine) -> None:
    """Once the first robot is bound by nothing that it may have said before its start."""
    from failover.errors import AgentRefusedError

    def is_run() -> bool:
        try:
            robots.run(robot, NAME, "/usr/bin/python3", "-S", "-c", ACTS, str(site.record))
        except AgentRefusedError:
            return False
        return True

    robots.until(is_run, "the program to be started")


def role(robot: RobotMachine) -> str:
    return str(robots.component(robot, NAME).get("role", "")) if robots.answers(robot) else ""


def is_held(robot: RobotMachine, beyond: int = 0) -> bool:
    """Whether it stands by with a copy of the archive, of a later state than that number of its order."""
    one = robots.component(robot, NAME)
    return one.get("role") == "standby" and (one.get("sequence") or 0) > beyond


def held_epoch(robot: RobotMachine) -> int:
    """The epoch under which its newest checkpoint was taken; 0 where it has none."""
    return (robots.component(robot, NAME).get("generation") or 0) // (PEERS_MAX + 1)


def acts_more(site: Site, patience_s: float = robots.PATIENCE_S) -> list[Act]:
    """Wait until the program has acted some more; all acts."""
    before = len(site.acts())
    robots.until(lambda: len(site.acts()) > before + 5, "the program to act on", patience_s)
    return site.acts()
