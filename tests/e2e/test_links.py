"""Two links between two robots: snapshots use the wire, heartbeats both; a cable that is out degrades and moves nothing.

This kernel has no radio for tests, so one of the two cables is declared to lead to one, as an operator would for a radio behind
an Ethernet port. The kernel's own facts about real radios: `tests.agent.worker.network.test_links`.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import ip_inside, lay, run
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: a cable must be laid and pulled"),
]

TWO = (("wire", "10.71.7.{}"), ("air", "10.71.8.{}"))
AIR_IS_WIRELESS = 'wireless = ["air"]\n'
WIRE_IS_WIRELESS = 'wireless = ["wire"]\n'
ALLOWED = 'snapshots_over = "any"\n'

BUSY = (
    "import os, time\nroom = bytearray(1 << 21)\ni = 0\n"
    "while True:\n    room[:] = os.urandom(len(room))\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.02)\n"
)
"""Counts, and writes two megabytes that no compression makes smaller between two snapshots."""

ENOUGH = 10 << 20
"""Bytes of snapshots after which it is clear where they travel."""

BEATS_MAX = 100_000
"""Bytes a second that beats alone do not reach, and a program like this exceeds by far."""

Pair = tuple[RobotMachine, RobotMachine]


def traffic(robot: RobotMachine, link: str) -> int:
    """Bytes that left over a link, as the kernel counted them."""
    enter = ["nsenter", "--net", f"--target={robot.process.pid}", "cat", "/proc/net/dev"]
    shown = subprocess.run(enter, capture_output=True, text=True, check=True).stdout
    (line,) = (line for line in shown.splitlines() if line.strip().startswith(f"{link}:"))
    return int(line.partition(":")[2].split()[8])


@contextlib.contextmanager
def only_beats_over_the_air(robot: RobotMachine) -> Iterator[None]:
    """See that nothing else travels there meanwhile, however long a busy machine takes for it."""
    before, began = traffic(robot, "air"), time.monotonic()
    yield
    sent, took_s = traffic(robot, "air") - before, time.monotonic() - began
    assert sent < BEATS_MAX * max(took_s, 1.0), f"{sent} bytes in {took_s:.1f} s"


def links(robot: RobotMachine) -> dict[str, dict[str, Any]]:
    return {link["name"]: link for link in robot.status()["links"]}


def start(pair: Pair) -> None:
    robots.run(pair[0], "count", "/usr/bin/python3", "-S", "-c", BUSY)
    robots.until_protected(pair[0])


def prefer_the_air(pair: Pair) -> None:
    """Have the kernel's own choice of a way to the other robot's wired address lead over the radio."""
    for robot, other in zip(pair, (2, 1), strict=True):
        subprocess.run(ip_inside(robot, "route", "add", TWO[0][1].format(other) + "/32", "dev", "air"), check=True)


def links_heard(robot: RobotMachine) -> list[str]:
    (peer,) = robot.status()["peers"]
    return list(peer["links"])


def counts_on(robot: RobotMachine) -> None:
    """What it writes there is captured and shown only while it is protected; what it has written shows that it runs."""
    (log,) = (robot.directory / "state" / "logs").glob("*/stdout.log")
    before = log.stat().st_size
    robots.until(lambda: log.stat().st_size > before, "the program to count on")


def test_a_cable_that_is_out_while_the_radio_lives_degrades_and_moves_nothing(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, AIR_IS_WIRELESS, cables=TWO) as pair:
        first, second = pair
        assert {name: link["medium"] for name, link in links(first).items()} == {"wire": "wired", "air": "wireless"}
        for robot in pair:  # a beat is believed once, and yet each link that brings it is known to carry
            robots.until(lambda at=robot: links_heard(at) == ["air", "wire"], "both links to be heard")  # type: ignore[misc]
        prefer_the_air(pair)
        start(pair)
        wire = traffic(first, "wire")
        with only_beats_over_the_air(first):
            robots.until(lambda: traffic(first, "wire") - wire > ENOUGH, "snapshots to travel")

        epoch = robots.component(first, "count")["epoch"]
        with only_beats_over_the_air(first):
            robots.cable(first, "down")
            robots.until_status(first, 1, "degraded", "wire, which carries snapshots, has no carrier: is its cable out?")
            counts_on(first)
            assert robots.component(first, "count")["epoch"] == epoch
            assert robots.component(second, "count")["role"] == "standby"
            for robot in pair:
                robots.until(lambda at=robot: heard(at) and links_heard(at) == ["air"], "it to be heard over the radio")  # type: ignore[misc]
                brief = ("why", "--brief", "--robot", robot.name)
                robots.until(
                    lambda at=robot, asked=brief: "wire has no carrier any more" in robots.failover(at, *asked).stdout,  # type: ignore[misc]
                    "the event log to tell of it",
                )

        robots.cable(first, "up")
        robots.until_status(first, 0)
        robots.until_protected(first)
        assert robots.component(first, "count")["epoch"] == epoch
        wire = traffic(first, "wire")
        robots.until(lambda: traffic(first, "wire") - wire > ENOUGH, "snapshots to travel again")

        for name, _ in TWO:
            robots.cable(first, "down", name)
        robots.until(lambda: robots.component(second, "count").get("role") == "primary", "robot2 to take over what is silent")


@pytest.mark.parametrize("allowed", ["", ALLOWED], ids=["wired", "any"])
def test_where_the_only_link_is_a_radio_snapshots_travel_only_if_the_operator_allows_it(tmp_path: Path, allowed: str) -> None:
    with robots.two_robots(tmp_path, WIRE_IS_WIRELESS + allowed) as pair:
        first, second = pair
        if allowed:
            start(pair)
            return
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", BUSY)
        robots.until_status(
            first, 1, "wire, which carries snapshots, is wireless (the configuration says so)", 'snapshots_over = "any"'
        )
        counts_on(first)
        assert not robots.checkpoints(second, "count")


def test_a_robot_whose_own_link_is_a_radio_takes_no_snapshots_over_it(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        path = second.directory / "agent.toml"
        path.write_text(path.read_text() + WIRE_IS_WIRELESS)
        robots.keep_on(second)
        robots.stop_agent(second)
        robots.start_agent(second)
        robots.until(lambda: robots.answers(second) and robots.connected(first), "robot2 to be back")
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", BUSY)
        robots.until_status(first, 1, "at robot2 wire, which carries snapshots, is wireless")
        assert not robots.checkpoints(second, "count")


def test_a_card_that_is_unplugged_and_plugged_in_again_carries_snapshots_again(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, cables=TWO) as pair:
        first, second = pair
        start(pair)
        run(ip_inside(first, "link", "delete", "wire"))  # both ends are gone, and their addresses with them
        robots.until_status(first, 1, "degraded", "no interface of this robot has its bulk address 10.71.7.1")
        lay(pair, *TWO[0])
        robots.until_status(first, 0)
        robots.until_protected(first)
        wire = traffic(first, "wire")
        robots.until(lambda: traffic(first, "wire") - wire > ENOUGH, "snapshots to travel again")
        assert robots.component(second, "count")["role"] == "standby"


def test_an_agent_that_restarts_while_the_cable_is_out_is_heard_again_over_the_radio_and_nothing_moves(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, AIR_IS_WIRELESS, cables=TWO) as pair:
        first, second = pair
        start(pair)
        epoch = robots.component(first, "count")["epoch"]
        robots.cable(first, "down")
        robots.until_status(first, 1, "has no carrier")
        robots.keep_on(second)
        robots.stop_agent(second)
        robots.start_agent(second)
        robots.until(lambda: robots.answers(second), "the agent of robot2 to be back")
        for robot in pair:
            robots.until(lambda at=robot: heard(at), "beats under fresh keys")  # type: ignore[misc]
        robots.until(lambda: robots.component(second, "count").get("role") == "standby", "robot2 to know who runs it")
        counts_on(first)
        assert robots.component(first, "count")["epoch"] == epoch
        with only_beats_over_the_air(first):
            robots.until(lambda: all_answer(second), "everybody's event log: questions travel over the radio")
            assert "has ended" in robots.failover(second, "stop", "count").stdout, "and orders"


def all_answer(robot: RobotMachine) -> bool:
    """Whether each robot told its event log in time when it was asked there."""
    return all(one["answered"] for one in json.loads(robots.failover(robot, "why", "--json").stdout)["robots"])


def heard(robot: RobotMachine) -> bool:
    (peer,) = robot.status()["peers"]
    return bool(peer["state"] == "live" and peer["hears_us"])
