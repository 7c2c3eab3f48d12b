"""Two robots with ``rule = "etcd"`` and a real etcd: the primary is lost, etcd is gone, the primary does not reach etcd."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import Pace, RobotMachine, ip_command, ip_inside, run
from failover.errors import AgentRefusedError
from tests.agent.coordinator.etcd_server import EtcdServer, why_not
from tests.e2e import robots

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: a robot must be cut off from etcd alone"),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "etcd is here"),
]

ETCD_HOST, ETCD_PORT = "10.71.9.1", 2379
SETTINGS = f'rule = "etcd"\n[coordinator]\nendpoints = ["http://{ETCD_HOST}:{ETCD_PORT}"]\n'
PACE = Pace(20, 1_800)
LEAPS_S = 8
"""Longer than a takeover takes where nothing hinders it."""

COUNTS = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.02)\n"


@dataclass
class Site:
    """Two robots, and an etcd that each of them reaches over a cable of its own; ``place``: a process in its network."""

    first: RobotMachine
    second: RobotMachine
    etcd: EtcdServer
    place: int

    def reach(self, robot: RobotMachine, *, is_on: bool) -> None:
        """Let a robot reach etcd, or cut it off."""
        run(ip_inside(robot, "link", "set", "etcd", "up" if is_on else "down"))
        if is_on:
            run(ip_inside(robot, "route", "replace", ETCD_HOST, "dev", "etcd"))

    def pull_cable(self, robot: RobotMachine) -> None:
        """Between the robots."""
        run(ip_inside(robot, "link", "set", "wire", "down"))

    def lay_cable(self, robot: RobotMachine) -> None:
        run(ip_inside(robot, "link", "set", "wire", "up"))


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    place = subprocess.Popen(
        ["unshare", "--net", "--", "sh", "-c", "ip link set lo up; echo; exec sleep 1000000"], stdout=subprocess.PIPE
    )
    assert place.stdout is not None
    place.stdout.readline()
    within = ("nsenter", "--net", f"--target={place.pid}")
    etcd = EtcdServer(tmp_path / "etcd", ETCD_HOST, ETCD_PORT, 2380, before=within)
    etcd.start()
    try:
        with robots.two_robots(tmp_path, SETTINGS, pace=PACE) as (first, second):
            for number, robot in enumerate((first, second), start=1):
                lay_to(place.pid, robot, number)
            robots.until(lambda: all(reaches(robot) for robot in (first, second)), "both robots to reach etcd")
            yield Site(first, second, etcd, place.pid)
    finally:
        etcd.kill()
        place.kill()
        place.wait()


def lay_to(etcd: int, robot: RobotMachine, number: int) -> None:
    """Lay a cable from a robot to etcd's network."""
    end, theirs, own = f"robot{number}", str(robot.process.pid), f"10.71.9.{number + 1}"
    kind = ["type", "veth", "peer", "name", end, "netns", str(etcd)]
    run([ip_command() or "ip", "link", "add", "etcd", "netns", theirs, *kind])
    run(ip_inside(robot, "address", "add", f"{own}/32", "dev", "etcd"))
    run(ip_inside(robot, "link", "set", "etcd", "up"))
    run(ip_inside(robot, "route", "add", ETCD_HOST, "dev", "etcd"))
    inside = ["nsenter", "--net", f"--target={etcd}", ip_command() or "ip"]
    run([*inside, "address", "add", f"{ETCD_HOST}/32", "dev", end])
    run([*inside, "link", "set", end, "up"])
    run([*inside, "route", "add", own, "dev", end])


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


def started(site: Site) -> None:
    robots.until(lambda: runs(site.first), "the first robot to be bound by nothing that it may have said before its start")
    robots.until_protected(site.first)


def runs(robot: RobotMachine) -> bool:
    try:
        robots.run(robot, "count", "/usr/bin/python3", "-S", "-c", COUNTS)
    except AgentRefusedError:
        return False
    return True


def counts_on(robot: RobotMachine) -> None:
    """What it has written there grows: it runs."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    before = log.stat().st_size
    robots.until(lambda: log.stat().st_size > before, "the program to count on")


def state(robot: RobotMachine) -> str:
    return str(robots.component(robot, "count").get("state"))


def role(robot: RobotMachine) -> str:
    return str(robots.component(robot, "count").get("role"))


def test_a_primary_that_is_lost_is_replaced_with_etcds_vote(site: Site) -> None:
    started(site)
    epoch = robots.component(site.first, "count")["epoch"]
    robots.counts_on_elsewhere(site.first, site.second, 10)
    assert robots.component(site.second, "count")["epoch"] > epoch
    assert "reaches etcd; 2 of 3 votes decide" in site.second.status()["promise"]


def test_while_etcd_is_gone_programs_run_on_and_nobody_is_taken_over(site: Site) -> None:
    started(site)
    epoch = robots.component(site.first, "count")["epoch"]
    site.etcd.kill()
    until_told(site.first, "does not reach etcd", "nobody is taken over", "no etcd answers")
    assert robots.failover(site.first, "status").returncode == 1
    assert "no etcd answers" in robots.failover(site.first, "check").stdout
    for _ in range(3):
        counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")
    assert robots.component(site.first, "count")["epoch"] == epoch

    site.first.cut_power()
    until_told(site.second, "stand still until it hears more")
    assert role(site.second) == "standby", "a robot alone cannot know that the other one is lost"
    site.etcd.start()
    robots.until_taken_over(site.second)


def test_a_primary_that_does_not_reach_etcd_runs_on_as_long_as_it_hears_its_neighbour(site: Site) -> None:
    started(site)
    epoch = robots.component(site.first, "count")["epoch"]
    site.reach(site.first, is_on=False)
    until_told(site.first, "does not reach etcd")
    counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")
    assert robots.component(site.first, "count")["epoch"] == epoch

    site.pull_cable(site.first)
    robots.until(lambda: state(site.first) == "frozen", "it to stand still: its standby may reach etcd")
    robots.until_taken_over(site.second)
    site.reach(site.first, is_on=True)
    site.lay_cable(site.first)
    robots.until(lambda: role(site.first) == "standby", "it to follow the one that etcd voted for")
    robots.until_protected(site.second)


def test_a_lease_clock_of_etcd_that_leaps_moves_nothing(site: Site) -> None:
    """etcd ends every lease too soon, as after a leap of its clock, again and again for longer than a takeover takes."""
    started(site)
    epoch = robots.component(site.first, "count")["epoch"]
    site.pull_cable(site.first)
    until_told(site.second, "hears 0 of 1 other members and reaches etcd")
    within = ["nsenter", "--net", f"--target={site.place}"]
    until_s = time.monotonic() + LEAPS_S
    while time.monotonic() < until_s:
        for lease in asked(within, "lease/leases", {}).get("leases", ()):
            asked(within, "lease/revoke", {"ID": lease["ID"]})
        assert role(site.second) == "standby"
    counts_on(site.first)
    assert (role(site.first), robots.component(site.first, "count")["epoch"]) == ("primary", epoch)


def speakers(robot: RobotMachine) -> list[int]:
    """The processes of the robot that speak with etcd."""
    return [pid for pid in robot.processes() if b"agent.coordinator.process" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_another_process_takes_the_place_of_one_that_speaks_with_etcd_and_ends(site: Site) -> None:
    (ended,) = speakers(site.first)
    os.kill(ended, signal.SIGKILL)
    told = "the process that speaks with etcd has ended"
    robots.until(lambda: told in " ".join(site.first.status()["notes"]), "the status to tell of it")
    robots.until(lambda: speakers(site.first) not in ([], [ended]), "another one")
    robots.until(lambda: reaches(site.first) and not site.first.status()["notes"], "etcd to be reached again")
    site.first.cut_power()
    robots.until(lambda: not site.first.processes(), "nothing of the robot to be left")


def asked(within: list[str], method: str, body: dict[str, str]) -> dict[str, Any]:
    """etcd's answer to a request from its own network."""
    script = (
        "import sys, urllib.request as u; "
        "print(u.urlopen(u.Request(sys.argv[1], sys.argv[2].encode()), timeout=30).read().decode())"
    )
    url = f"http://{ETCD_HOST}:{ETCD_PORT}/v3/{method}"
    ran = subprocess.run(
        [*within, sys.executable, "-c", script, url, json.dumps(body)], capture_output=True, text=True, check=False
    )
    told: dict[str, Any] = json.loads(ran.stdout) if ran.returncode == 0 else {}  # a lease may be gone already
    return told


def test_a_primary_that_hears_no_neighbour_runs_on_with_etcds_vote(site: Site) -> None:
    started(site)
    epoch = robots.component(site.first, "count")["epoch"]
    site.pull_cable(site.first)
    until_told(site.first, "hears 0 of 1 other members and reaches etcd; 2 of 3 votes decide")
    counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")

    site.etcd.stop()
    robots.until(lambda: state(site.first) == "frozen", "it to stand still while etcd hangs")
    site.etcd.go_on()
    robots.until(lambda: state(site.first) in ("running", "degraded"), "it to go on: its epoch still stands")
    assert robots.component(site.first, "count")["epoch"] == epoch
    counts_on(site.first)
